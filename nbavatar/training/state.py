"""The folder beside a model in the making: what makes training resumable and watchable.

    state.pt        model, optimizer, step and clock of the last checkpoint
    events.jsonl    one line per logged step
    tensorboard/    the same numbers and the previews as event files
    wandb/          the same as an offline run of Weights & Biases, where that is asked for
    key.json        what the state belongs to: configuration, code and inputs
    lock            held while a training writes here (`nbavatar.io.locks`)
    previews/       pictures, named by step

A folder whose key differs belongs to another experiment; it is moved aside, never mixed and never deleted.
"""

import contextlib
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from nbavatar.errors import parsing
from nbavatar.io.atomic import atomic_write, no_links, storage_errors
from nbavatar.io.eventfile import EventFile
from nbavatar.io.images import encode_png
from nbavatar.io.locks import Hold, hold
from nbavatar.io.records import canonical_json, write_json
from nbavatar.io.tensors import read_tensors
from nbavatar.training.offline_run import OfflineRun

__all__ = ["RunFolder"]


class RunFolder:
    """State of one training run on disk; a context manager, whose end frees the folder for another training.

    Args:
        path: the folder; made when missing.
        key: JSON-ready description of the experiment.
        wandb: project of Weights & Biases to log to as well, offline; empty for none.

    Raises:
        DataError: another process trains in this folder.
    """

    def __init__(self, path: str | os.PathLike[str], key: Mapping[str, Any], *, wandb: str = "") -> None:
        self.path = Path(path)
        self._key, self._project = dict(key), wandb
        self._run: OfflineRun | None = None
        self.moved_to: Path | None = None
        self._curves: EventFile | None = None
        self._first = 0
        key_file = self.path / "key.json"
        self._lock = self._claim()
        if not self._belongs(key_file, key):
            stamp = time.strftime("%Y%m%d-%H%M%S")
            for number in range(1000):
                aside = self.path.with_name(f"{self.path.name}.stale-{stamp}" + (f"-{number}" if number else ""))
                if not aside.exists():
                    break
            os.replace(self.path, aside)
            self.moved_to = aside
            self._lock.release()  # it went with the folder
            self._lock = self._claim()
        (self.path / "previews").mkdir(exist_ok=True)
        for leftover in self.path.rglob(".*.tmp*"):  # of a run that was killed while writing
            leftover.unlink(missing_ok=True)
        if not key_file.exists():
            write_json(key_file, dict(key))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._run is not None:
            self._run.close()
        self._lock.release()

    def _claim(self) -> Hold:
        """The lock of the folder, which is made when missing."""
        self.path.mkdir(parents=True, exist_ok=True)
        return hold(self.path / "lock", "another training that writes to it")

    @staticmethod
    def _belongs(key_file: Path, key: Mapping[str, Any]) -> bool:
        try:
            return canonical_json(json.loads(key_file.read_text(encoding="utf-8"))) == canonical_json(dict(key))
        except (OSError, ValueError, RecursionError):
            # A folder without a readable key that holds nothing yet was cut off while it was being made.
            return not (key_file.parent / "state.pt").exists()

    @property
    def begun(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return (self.path / "state.pt").exists()

    def load(self) -> dict[str, Any] | None:
        """Last checkpoint, or None; events that were logged after it are dropped, they will be made again."""
        file = self.path / "state.pt"
        if not self.begun:
            self._rewrite_events([])
            return None
        state = read_tensors(file, "a training state", fix=f"delete {self.path}")
        with parsing(file, "a training state", fix=f"delete {self.path}"):
            step = int(state["step"])
        self._rewrite_events([event for event in self.events() if event["step"] <= step])
        self._first = step + 1
        return state

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint, atomically."""
        # Into a stream, whose errors are the system's: torch's own writer does not name them.
        with atomic_write(self.path / "state.pt") as temporary, open(temporary, "wb") as stream:
            torch.save(dict(state), stream)

    def log(self, event: Mapping[str, Any]) -> None:
        """Append one line to the events, and its numbers to the curves."""
        file = self.path / "events.jsonl"
        with storage_errors(file), open(file, "a", encoding="utf-8", opener=no_links) as stream:
            stream.write(canonical_json(dict(event)) + "\n")
        numbers = {f"train/{name}": value for name, value in event.items() if name != "step" and value is not None}
        self._event_file().scalars(event["step"], numbers)
        if run := self._offline_run():
            run.scalars(event["step"], numbers)

    def events(self) -> list[dict[str, Any]]:
        """All whole lines of the events; one that was cut off by a crash, or damaged, is skipped."""
        file = self.path / "events.jsonl"
        if not file.exists():
            return []
        events = []
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(ValueError, RecursionError):
                event = json.loads(line)
                canonical_json(event).encode()  # refuses NaN, infinity and half characters, which no logged line has
                if isinstance(event, dict) and isinstance(event.get("step"), int):
                    events.append(event)
        return events

    def preview(self, step: int, image: np.ndarray) -> None:
        """Store one picture, uint8 (H, W, 3)."""
        png = encode_png(image)
        with atomic_write(self.path / "previews" / f"step_{step:07d}.png") as temporary:
            temporary.write_bytes(png)
        self._event_file().image(step, "preview", png, image.shape[1], image.shape[0])
        if run := self._offline_run():
            run.image(step, "preview", image)

    def _event_file(self) -> EventFile:
        """The event file of this run, begun when there is something to write."""
        if self._curves is None:
            self._curves = EventFile(self.path / "tensorboard", self._first)
        return self._curves

    def _offline_run(self) -> OfflineRun | None:
        """The run of Weights & Biases, begun when there is something to write; None where none is asked for."""
        if self._project and self._run is None:
            name = "/".join(self.path.parts[-3:-1]) or self.path.name
            self._run = OfflineRun(str(self.path), self._project, name, self._key)
        return self._run

    def _rewrite_events(self, events: list[dict[str, Any]]) -> None:
        file, text = self.path / "events.jsonl", "".join(canonical_json(event) + "\n" for event in events)
        # Compared as text: a line that was cut off is no event, but the next one would be appended to it.
        if file.exists() and file.read_text(encoding="utf-8", errors="replace") == text:
            return
        with atomic_write(file) as temporary:
            temporary.write_text(text, encoding="utf-8")
