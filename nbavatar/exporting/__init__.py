"""Avatars and meshes as other programs take them: arrays for `nbavatar export` to write."""
