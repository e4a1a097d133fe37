"""What there is to look at: avatars of one subject, their meshes, and the cameras that recorded it."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from nbavatar.data.sequences import MeshSequence
from nbavatar.evaluation.orbit import focus
from nbavatar.evaluation.render import check_parts, posed_vertices
from nbavatar.io.framepack import FramePack
from nbavatar.viewer.eye import pose_of, view_angle

__all__ = ["EXACT", "Entry", "FirstView", "Scene"]

EXACT = "exact"
"""Name of the setting in which nothing is left out."""
_FOV = 0.35  # vertical angle of the first view where there is no camera [rad]


class FirstView(NamedTuple):
    """Where one looks from at first: the camera's place and the point that it looks at, world (3,) [m]; its vertical
    angle of view [rad]."""

    position: np.ndarray
    look_at: np.ndarray
    fov: float


class Entry:
    """One avatar, loaded when it is first looked at.

    Args:
        name: shown.
        load: gives the avatar (`nbavatar.methods.base.MeshAvatar`), on the device, and the meshes that it rides on.
        tune: name of a preset -> the avatar under it (`nbavatar.studies.tradeoff.tuned.TunedAvatar`).
        presets: names of the presets that have been measured.
    """

    def __init__(
        self,
        name: str,
        load: Callable[[], tuple[Any, MeshSequence]],
        tune: Callable[[Any, str], Any] | None = None,
        presets: Sequence[str] = (),
    ) -> None:
        self.name, self.presets = name, list(presets)
        self._load, self._tune = load, tune
        self._tuned: dict[str, Any] = {}

    @functools.cached_property
    def _loaded(self) -> tuple[Any, MeshSequence]:
        avatar, sequence = self._load()
        check_parts(avatar, sequence)
        return avatar, sequence

    @property
    def avatar(self) -> Any:
        """The avatar as it was trained.

        Raises:
            DataError: it does not fit its meshes.
        """
        return self._loaded[0]

    @property
    def sequence(self) -> MeshSequence:
        """Its meshes."""
        return self._loaded[1]

    def under(self, preset: str) -> Any:
        """The avatar under a preset; as it is for `EXACT` and for presets that it does not have."""
        if preset not in self.presets or self._tune is None:
            return self.avatar
        if preset not in self._tuned:
            self._tuned[preset] = self._tune(self.avatar, preset)
        return self._tuned[preset]

    def vertices(self, frame: str, device: str) -> tuple[dict[str, Tensor], str | None]:
        """Vertices of a frame by part, and the frame's id where corrections of training frames apply to it."""
        row = self.sequence.index([frame])[0]
        own = frame if "driver" not in self.sequence.extras else None
        return posed_vertices(self.avatar, self.sequence, row, device), own


class Scene:
    """One subject.

    Args:
        entries: avatars, the first is shown first.
        packs: opened frame packs of the capture's cameras, by name; there may be none.
        device: where the avatars compute.
    """

    def __init__(self, entries: Sequence[Entry], packs: Mapping[str, FramePack], device: str = "cpu") -> None:
        self.entries = {entry.name: entry for entry in entries}
        self.packs, self.device = dict(packs), device
        sequence = entries[0].sequence
        self.frames = list(sequence.frames)
        self.up = self._up()
        self.centre = self._centre(sequence)
        extents = (float(np.ptp(part.rest, axis=0).max()) / 2 for part in sequence.parts.values())
        self.radius = max(extents)
        """Half the size of what is shown [m]."""

    def _up(self) -> np.ndarray:
        """What is up, (3,): against the cameras' mean y axis; against the world's y axis without cameras."""
        ups = [-pack.cam_from_world[1, :3] for pack in self.packs.values()] or [np.array([0.0, -1.0, 0.0])]
        up = np.sum(ups, axis=0)
        return up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else ups[0]

    def _centre(self, sequence: MeshSequence) -> np.ndarray:
        """The point to turn about, (3,) [m]."""
        for row in range(len(sequence.frames)):
            try:
                return focus(sequence, row)
            except ValueError:
                continue
        return np.zeros(3)

    def first_view(self, aspect: float = 1.5) -> FirstView:
        """The view from the middle one of the cameras, or along an axis of the world where there is none.

        Args:
            aspect: width to height of the canvas that the camera's picture has to fit into.
        """
        cameras = [self.camera(name, self.frames[0]) for name in self.packs]
        if cameras:
            middle = np.sum([pose_of(pose)[1] for _, pose, _, _ in cameras], axis=0)
            K, pose, width, height = max(cameras, key=lambda camera: float(pose_of(camera[1])[1] @ middle))
            position, forward, _ = pose_of(pose)
            distance = max(float((self.centre - position) @ forward), 0.1)
            return FirstView(position, position + distance * forward, view_angle(K, width, height, aspect))
        side = np.array([0.0, 0.0, 1.0]) if abs(self.up[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        distance = 1.3 * self.radius / np.tan(0.5 * _FOV)
        return FirstView(self.centre + distance * side, self.centre, _FOV)

    def truth(self, camera: str, frame: str, background: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """What a camera recorded, on a background.

        Args:
            camera: name; frame: id; background: RGB (3,) in [0, 1].

        Returns:
            float32 (H, W, 3) in [0, 1], and bool (H, W): where the camera's image says something. None where there is
            no such picture.
        """
        pack = self.packs.get(camera)
        if pack is None or frame not in pack.frames or not {"rgb", "alpha"} <= set(pack.layers):
            return None
        alpha = pack.read("alpha", frame).astype(np.float32)[..., None] / 255.0
        colour = pack.read("rgb", frame).astype(np.float32) / 255.0
        unseen = pack.unseen(frame)
        known = np.ones(alpha.shape[:2], bool) if unseen is None else ~unseen
        return colour * alpha + (1.0 - alpha) * background.astype(np.float32), known

    def camera(self, name: str, frame: str) -> tuple[np.ndarray, np.ndarray, int, int]:
        """A capture's camera: intrinsics (3, 3) [px], world to camera (4, 4), width and height [px]."""
        pack = self.packs[name]
        own = frame if frame in pack.frames else pack.frames[0]
        return pack.intrinsics(own), pack.cam_from_world, int(pack.manifest["width"]), int(pack.manifest["height"])
