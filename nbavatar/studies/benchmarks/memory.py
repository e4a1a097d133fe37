"""What the system says of this process's memory."""

import contextlib

__all__ = ["forget_peak", "memory_mb"]


def memory_mb(entry: str) -> float:
    """VmRSS, now, or VmHWM, at its largest since `forget_peak` [MiB]."""
    try:
        with open("/proc/self/status") as handle:
            return next(int(line.split()[1]) / 1024 for line in handle if line.startswith(entry))
    except (OSError, StopIteration):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def forget_peak() -> None:
    """The largest memory so far counts no more, where the system can forget it."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as handle:
        handle.write("5")
