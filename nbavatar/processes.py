"""Which machine this is, and which of its processes are alive: what a file that outlives its writer is judged by.

Standard library only.
"""
# provenance: neutral, because it names and ends processes.

import contextlib
import hashlib
import os
from functools import cache

__all__ = ["alive", "machine"]


@cache
def machine() -> str:
    """Six hex digits of this machine, or of this container on it: process numbers mean something only there."""
    space = ""
    with contextlib.suppress(OSError):  # no /proc
        space = os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(f"{os.uname().nodename} {space}".encode()).hexdigest()[:6]


def alive(process: int) -> bool:
    """Whether a process of this machine has not ended, whoever's it is."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    with contextlib.suppress(OSError):  # no /proc
        with open(f"/proc/{process}/stat", "rb") as stream:
            # One that nobody has waited for, as in containers without an init process: it has ended all the same.
            return stream.read().rpartition(b")")[2].split()[:1] != [b"Z"]
    return True
