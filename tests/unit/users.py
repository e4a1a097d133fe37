"""Code that runs as another user of the machine: only root can become one."""

import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any

import pytest

OTHER, THIRD = 41234, 41235  # users of no account


def as_user(user: int, work: Callable[[], Any]) -> Any:
    """What `work` returns, or raises, in a child process of that user."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(user)
            os.setuid(user)
            answer = False, work()
        except BaseException as error:
            answer = True, error
        with open(writing, "wb") as stream:
            stream.write(pickle.dumps(answer))
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as stream:
        failed, value = pickle.loads(stream.read())  # noqa: TID251  (made by ourselves, a moment ago)
    os.waitpid(child, 0)
    if failed:
        raise value
    return value


@pytest.fixture
def public_folder() -> Iterator[Path]:
    """A folder such as `/tmp`: everybody may put things there, and remove only their own."""
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    folder = Path(mkdtemp(prefix="nbavatar-test-", dir="/tmp"))
    folder.chmod(0o1777)
    yield folder
    rmtree(folder)
