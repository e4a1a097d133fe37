"""One thread that draws: the latest request of each client wins, small while things move, whole when they rest.

Controls only leave a request and return. A picture that is being drawn when a newer request comes is finished and
shown (it is small, because things move), and whatever came in between is never drawn.
"""

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["RenderWorker", "Work"]

_SETTLE_S = 0.2  # without a new request for so long, things rest
_GOAL_S = 0.08  # a picture of moving things should take no longer
_SMALLEST = 64  # [px]


class Work(NamedTuple):
    """What is drawn for a client: the request, the longer side [px], and whether that is the whole picture."""

    client: int
    request: Any
    side: int
    whole: bool


class _Waiting(NamedTuple):
    request: Any
    side: int
    since: float
    drawn: int  # longer side that has been drawn already


class RenderWorker:
    """Draws requests.

    Args:
        draw: draws one; called by the worker's thread only. What it raises is given to `failed`.
        failed: told about exceptions of `draw`.
    """

    def __init__(self, draw: Callable[[Work], None], failed: Callable[[int, Exception], None]) -> None:
        self._draw, self._failed = draw, failed
        self._waiting: dict[int, _Waiting] = {}
        self._changed = threading.Condition()
        self._stopped = False
        self._per_pixel = 1e-6  # s; learnt
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the picture that is being drawn."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout=30)

    def submit(self, client: int, request: Any, side: int) -> None:
        """Asks for a picture, in place of any that this client still waits for.

        Args:
            client: its number.
            request: for `draw`.
            side: longer side of the whole picture [px].
        """
        with self._changed:
            self._waiting[client] = _Waiting(request, side, time.monotonic(), 0)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """Drops what a client waits for."""
        with self._changed:
            self._waiting.pop(client, None)

    def _run(self) -> None:
        while True:
            with self._changed:
                work = self._next()
                while work is None and not self._stopped:
                    self._changed.wait(self._pause())
                    work = self._next()
                if self._stopped:
                    return
            assert work is not None
            began = time.monotonic()
            try:
                self._draw(work)
            except Exception as error:  # told to the user; the next request may well be drawn
                self._failed(work.client, error)
            # Bounded: once, a picture also takes the time in which kernels are compiled and an avatar is read.
            spent = min((time.monotonic() - began) / work.side**2, 4.0 * self._per_pixel)
            self._per_pixel = 0.5 * self._per_pixel + 0.5 * spent

    def _next(self) -> Work | None:
        """What to draw now: moving things first, oldest first, then whole pictures of what rests."""
        now = time.monotonic()
        for client, waiting in sorted(self._waiting.items(), key=lambda item: item[1].since):
            if waiting.drawn == 0:
                small = int((_GOAL_S / self._per_pixel) ** 0.5) // 8 * 8
                return self._take(client, waiting, min(waiting.side, max(_SMALLEST, small)))
        for client, waiting in self._waiting.items():
            if now - waiting.since >= _SETTLE_S:
                return self._take(client, waiting, waiting.side)
        return None

    def _take(self, client: int, waiting: _Waiting, side: int) -> Work:
        whole = side >= waiting.side
        if whole:
            self._waiting.pop(client)
        else:
            self._waiting[client] = waiting._replace(drawn=side)
        return Work(client, waiting.request, side, whole)

    def _pause(self) -> float | None:
        """How long until something rests [s]; None for as long as it takes."""
        if not self._waiting:
            return None
        return max(0.005, _SETTLE_S - (time.monotonic() - min(w.since for w in self._waiting.values())))
