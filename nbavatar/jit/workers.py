"""Threads that kernels share: as many as torch uses."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

__all__ = ["run_workers"]

_POOL: tuple[int, int, ThreadPoolExecutor] | None = None  # process, threads, executor


def run_workers(work: Callable[[int], Any]) -> list[Any]:
    """Calls `work(worker)` for every worker, one a thread, and returns what each gave back."""
    global _POOL
    threads = torch.get_num_threads()
    if threads == 1:
        return [work(0)]
    # A forked child inherits the executor without its threads; it needs one of its own.
    if _POOL is None or _POOL[:2] != (os.getpid(), threads):
        _POOL = (os.getpid(), threads, ThreadPoolExecutor(threads - 1, thread_name_prefix="nbavatar-kernels"))
    others = [_POOL[2].submit(work, worker) for worker in range(1, threads)]
    return [work(0)] + [other.result() for other in others]
