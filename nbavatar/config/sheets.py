"""The tab-separated sheets of a run: who is there, and what is to be made.

Camera and subject ids are text, always: in YAML `084` is text, `110` a number and `010` eight.
"""

import csv
import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from nbavatar.config.cameras import choose_camera, parse_camera, read_rig, stored_test_camera
from nbavatar.errors import ConfigError, DataError, did_you_mean, parsing
from nbavatar.names import check_name, check_place, name_like

__all__ = ["Row", "Subject", "capture_subjects", "read_rows", "read_subjects"]


@dataclasses.dataclass(frozen=True)
class Subject:
    """One subject: id, cameras it is trained on, camera it is judged on, folder of its data.

    A subject that one camera recorded is trained on that and has no camera it is judged on (empty).
    """

    name: str
    train_cameras: tuple[str, ...]
    test_camera: str
    root: str

    @property
    def cameras(self) -> tuple[str, ...]:
        """All cameras, sorted."""
        return tuple(sorted(filter(None, (*self.train_cameras, self.test_camera))))


@dataclasses.dataclass(frozen=True)
class Row:
    """One number to produce: a subject's avatar of one variant, judged under one protocol."""

    subject: str
    variant: str
    protocol: str


def read_subjects(path: str | os.PathLike[str], root: str) -> dict[str, Subject]:
    """Reads `subject, train_cameras (comma-separated), test_camera`.

    Raises:
        ConfigError: a missing column, a malformed or repeated id, a test camera among the training cameras.
    """
    subjects: dict[str, Subject] = {}
    for line, row in _read(path, ("subject", "train_cameras", "test_camera")):
        where = f"{path}, line {line}"
        train = tuple(part.strip() for part in row["train_cameras"].split(",") if part.strip())
        subject = Subject(row["subject"], train, row["test_camera"], root)
        check_name(subject.name, where, "subject", error=ConfigError)
        for camera in (*train, subject.test_camera):
            check_name(camera, where, "camera", error=ConfigError)
        if subject.name in subjects:
            raise ConfigError.of(where, "subject", expected="each subject once", found=f"{subject.name} again")
        if not train or len(set(subject.cameras)) != len(subject.cameras):
            raise ConfigError.of(
                where, "train_cameras", expected="one or more cameras, each once and without the test camera",
                found=row["train_cameras"] or "none",
            )  # fmt: skip
        subjects[subject.name] = subject
    return subjects


def refuse_namesakes(subjects: Mapping[str, Subject], checks: str | os.PathLike[str]) -> None:
    """Compares the folders of captures with those that results under their names were made of.

    A capture that was moved is the same; one that is still where it was is another.

    Args:
        subjects: by name, from `capture_subjects`.
        checks: folder of results of `nbavatar check`, `<subject>/record.json` in it.

    Raises:
        ConfigError: results of another capture would be replaced.
    """
    for name, subject in subjects.items():
        path = Path(checks, name, "record.json")
        try:
            former = json.loads(path.read_text(encoding="utf-8"))["folder"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            continue
        if isinstance(former, str) and former != os.path.realpath(subject.root) and os.path.isdir(former):
            raise ConfigError.of(
                subject.root, expected="a capture of its own name", found=f"'{name}', of which there are results",
                fix=f"they were made of {former}: rename one of the folders, or run in another place",
            )  # fmt: skip


def capture_subjects(root: str, test_camera: str | int) -> dict[str, Subject]:
    """Finds captures: `root` itself if it holds `cameras.json`, else its sub-folders that do.

    Args:
        root: folder of one capture, or of several.
        test_camera: camera to hold out (a number where its id is one); empty for the one that `splits.json` names, or
            else the one whose two nearest neighbours are nearest (by the farther of the two), so that the judged view
            lies between training views. Of a single camera nothing is held out.
    """
    base = Path(root)
    folders = [base] if (base / "cameras.json").is_file() else sorted(base.glob("*/cameras.json"))
    folders = [folder.parent if folder.name == "cameras.json" else folder for folder in folders]
    if not folders:
        raise ConfigError.of(
            "data_root", expected="a capture (a folder with cameras.json), or a folder of captures",
            found=f"{base} without any" if base.is_dir() else f"{base}, which does not exist",
            fix="name it with --config data_root=/path/to/capture",
        )  # fmt: skip
    subjects = {}
    for folder in folders:
        path = folder / "cameras.json"
        check_place(str(folder), folder, "name of the folder", error=ConfigError)
        try:
            rig = {name: parse_camera(name, entry, path) for name, entry in read_rig(path).items()}
            own = stored_test_camera(folder, rig)
        except DataError as error:
            raise ConfigError(str(error)) from error
        centres = {name: camera.centre for name, camera in rig.items()}
        wanted = own if test_camera == "" else choose_camera(test_camera, rig, "test_camera")
        held_out = "" if len(rig) == 1 else wanted or _best_surrounded(centres)
        train = tuple(sorted(set(centres) - {held_out}))
        name = check_name(name_like(folder.resolve().name), folder, "name of the folder", error=ConfigError)
        if name in subjects:
            raise ConfigError.of(
                folder, expected="a subject of its own",
                found=f"'{name}', which {subjects[name].root} is called already", fix="rename one of the folders",
            )  # fmt: skip
        subjects[name] = Subject(name, train, held_out, str(folder))
    return subjects


def read_rows(path: str | os.PathLike[str], subjects: Sequence[str]) -> list[Row]:
    """Reads `subject, variant, protocol`; subject `*` stands for every subject.

    Raises:
        ConfigError: an unknown subject, a repeated row.
    """
    rows: list[Row] = []
    for line, row in _read(path, ("subject", "variant", "protocol")):
        if row["subject"] != "*" and row["subject"] not in subjects:
            where = f"{path}, line {line}"
            raise ConfigError(f"{where}: unknown subject '{row['subject']}'; {did_you_mean(row['subject'], subjects)}")
        for subject in subjects if row["subject"] == "*" else [row["subject"]]:
            new = Row(subject, row["variant"], row["protocol"])
            if new in rows:
                raise ConfigError.of(f"{path}, line {line}", expected="each row once", found=f"{new} again")
            rows.append(new)
    return rows


def _read(path: str | os.PathLike[str], columns: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    with parsing(path, "a sheet (.tsv)", damaged="text that does not parse", error=ConfigError):
        with open(path, newline="", encoding="utf-8-sig") as stream:
            lines = [line for line in stream if not line.startswith("#")]
        reader = csv.DictReader(lines, delimiter="\t")
        rows = list(enumerate(reader, start=2))
    if list(reader.fieldnames or ()) != list(columns):
        found = ", ".join(reader.fieldnames or ()) or "nothing"
        raise ConfigError.of(path, "header", expected=f"tab-separated {', '.join(columns)}", found=found)
    result = []
    for number, row in rows:
        if None in row or any(value is None for value in row.values()):
            raise ConfigError.of(f"{path}, line {number}", expected=f"{len(columns)} columns", found="another number")
        result.append((number, {key: value.strip() for key, value in row.items()}))
    return result


def _best_surrounded(centres: Mapping[str, Sequence[float]]) -> str:
    def second_nearest(name: str) -> float:
        return sorted(math.dist(centres[name], other) for other in centres.values())[:3][-1]

    return min(sorted(centres), key=second_nearest)
