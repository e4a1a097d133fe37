"""Places that another user of the machine has prepared are refused, and nothing of theirs is changed."""

import os

import pytest

from nbavatar.errors import DataError
from nbavatar.private import open_private, private_folder
from tests.unit.users import OTHER, THIRD, as_user


def test_a_folder_is_made_closed_and_is_found_again(tmp_path):
    before = os.umask(0)
    try:
        folder = private_folder(tmp_path / "a" / "b")
    finally:
        os.umask(before)
    assert [place.stat().st_mode & 0o777 for place in (folder, folder.parent)] == [0o700, 0o700]
    assert private_folder(tmp_path / "a" / "b") == folder


def test_what_another_user_prepared_is_refused(public_folder):
    as_user(OTHER, lambda: (public_folder / "theirs").mkdir(mode=0o777))
    as_user(OTHER, lambda: (public_folder / "open").mkdir())
    as_user(OTHER, lambda: (public_folder / "open").chmod(0o777))
    (public_folder / "victim").mkdir(mode=0o755)
    os.chown(public_folder / "victim", THIRD, THIRD)
    as_user(OTHER, lambda: os.symlink(public_folder / "victim", public_folder / "link"))

    def refused(path, reason):
        with pytest.raises(DataError, match=reason):
            as_user(THIRD, lambda: private_folder(path))

    refused(public_folder / "theirs", f"found one of user {OTHER}")
    refused(public_folder / "link", "found a link")
    refused(public_folder / "link" / "below", f"found {public_folder / 'link'} of user {OTHER} above it")
    refused(public_folder / "open" / "below", f"{public_folder / 'open'} of user {OTHER} above it")
    assert list((public_folder / "victim").iterdir()) == []


def test_a_folder_of_ours_that_others_may_write_to_is_refused(tmp_path):
    loose = tmp_path / "loose"
    loose.mkdir()
    for mode in (0o770, 0o757):
        loose.chmod(mode)
        with pytest.raises(DataError, match="that others may write to"):
            private_folder(loose)
        with pytest.raises(DataError, match="above it, that others may write to"):
            private_folder(loose / "below")
    loose.chmod(0o1777)  # sticky, as /tmp: what is ours there stays ours
    assert private_folder(loose / "below").is_dir()


def test_links_of_our_own_and_of_the_system_are_followed_above_the_folder(tmp_path):
    (tmp_path / "scratch" / "me").mkdir(parents=True)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "cache").symlink_to("../scratch/me")
    folder = private_folder(tmp_path / "home" / "cache" / "kernels")
    assert folder.resolve() == tmp_path.resolve() / "scratch" / "me" / "kernels"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises((DataError, OSError)):
        private_folder(tmp_path / "loop" / "below")


def test_files_are_opened_without_following_links_or_cutting(public_folder):
    precious = public_folder / "precious"
    precious.write_text("everything")
    os.chown(precious, THIRD, THIRD)
    as_user(OTHER, lambda: os.symlink(precious, public_folder / "lock"))
    with pytest.raises(DataError, match="found a link"):
        as_user(THIRD, lambda: open_private(public_folder / "lock"))
    as_user(OTHER, lambda: (public_folder / "theirs").write_text("x"))
    as_user(OTHER, lambda: (public_folder / "theirs").chmod(0o666))
    with pytest.raises((DataError, PermissionError)):
        as_user(THIRD, lambda: open_private(public_folder / "theirs"))
    as_user(OTHER, lambda: os.mkfifo(public_folder / "pipe"))
    as_user(OTHER, lambda: (public_folder / "pipe").chmod(0o666))
    with pytest.raises((DataError, PermissionError)):
        as_user(THIRD, lambda: open_private(public_folder / "pipe"))

    def reopen():
        os.close(open_private(public_folder / "own"))
        (public_folder / "own").write_text("kept")
        os.close(open_private(public_folder / "own"))
        return (public_folder / "own").read_text(), (public_folder / "own").stat().st_mode & 0o777

    assert as_user(THIRD, reopen) == ("kept", 0o600)
    assert precious.read_text() == "everything"
