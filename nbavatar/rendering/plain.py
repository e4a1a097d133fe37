"""What draws on a GPU whose kernels cannot be compiled: the reference, in plain torch, on the same device."""

import sys

__all__ = ["announce_plain_torch"]

_TOLD: set[str] = set()


def announce_plain_torch(what: str, reason: Exception) -> None:
    """Says once in a process that it is right, but slow, and why.

    Args:
        what: such as `billboards`.
        reason: why there are no kernels; its text says what to do.
    """
    if what not in _TOLD:
        _TOLD.add(what)
        text = f"nbavatar: {what} are drawn by plain torch on this GPU, which is right but many times slower: {reason}"
        sys.stderr.write(text + "\n")
