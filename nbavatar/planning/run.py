"""A run as it is planned: its configuration with the sheets and layouts that it names, checked against each other."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from nbavatar.config.compare import compared
from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.config.figures import FigureLayout, read_figures
from nbavatar.config.run import RunConfig, load_run
from nbavatar.config.sheets import Row, Subject, capture_subjects, read_rows, read_subjects, refuse_namesakes
from nbavatar.config.synthetic import refuse_others
from nbavatar.config.tables import TableLayout, read_tables
from nbavatar.errors import ConfigError, did_you_mean
from nbavatar.planning.starts import checked_starts

__all__ = ["Plan", "read_plan"]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that decides which jobs there are.

    Attributes:
        run: the configuration.
        subjects: by name.
        rows: what is to be made and judged, in the order of the sheet.
        starts: subject and variant of the avatars that others start from, whether rows ask for them or not.
        tables, figures: layouts of those that can be made, by name.
    """

    run: RunConfig
    subjects: dict[str, Subject]
    rows: list[Row]
    starts: list[tuple[str, str]]
    tables: dict[str, TableLayout]
    figures: dict[str, FigureLayout]

    @property
    def captured(self) -> bool:
        """Whether the data is a capture, which brings its own meshes: nothing is refitted."""
        return self.run.layout == "capture"

    @property
    def aligned(self) -> bool:
        """Whether a capture's meshes are aligned to its images."""
        return self.captured and self.run.stages.align.iterations > 0

    @property
    def shelled(self) -> bool:
        """Whether what a capture's heads lack is carved from the masks of the training cameras."""
        return self.captured and self.run.stages.shell.reach > 0

    @property
    def lit(self) -> bool:
        """Whether the light of a capture's studio is estimated from the training cameras."""
        return self.captured and self.run.stages.light.lights > 0

    @property
    def solves_contact(self) -> bool:
        """Whether contact is a stage of the run: a capture's meshes may have it already."""
        return not (self.captured and self.run.stages.tracks.contact == "given")

    @property
    def compares(self) -> bool:
        """Whether the run compares variants at several budgets, and makes nothing else."""
        return bool(self.run.compare.variants)

    def holds_out_view(self, protocol: str) -> bool:
        """Whether a protocol judges the camera that is held out."""
        return _holds_out_view(self.run.protocols, protocol)


def read_plan(mapping: Mapping[str, Any]) -> Plan:
    """Reads a configuration and all sheets and layouts that it names.

    Where one camera recorded a subject, none is held out: rows that would judge that camera are left out, and so are,
    where it is true of every subject, tables and figures that show nothing else. Where only some of the subjects are
    wanted, the rows, pairs, tables and figures of the others are left out in the same way; of the others, those stay
    known whose avatars these start from.

    Raises:
        ConfigError: something malformed, a name that is not known, or a dataset of the user's where a synthetic one is
            to be written, or results of another capture of the same name.
    """
    run = load_run(mapping)
    if run.layout == "capture":
        subjects = capture_subjects(run.data_root, run.test_camera)
        refuse_namesakes(subjects, f"results/{run.run}/check")
    else:
        subjects = read_subjects(run.subjects, run.data_root)
    # Before snakemake knows that these files are outputs: those of a job are removed before it starts.
    if run.synthetic:
        refuse_others(run.data_root)
    found = compared(run.compare)
    # A comparison has rows of its own, the smallest budget of all subjects first.
    rows = [
        Row(subject, one.name, protocol) for one in found for subject in subjects for protocol in run.compare.protocols
    ] or read_rows(run.runs, list(subjects))
    for row in rows:
        _check(f"{run.runs}: unknown variant", row.variant, run.variants)
        _check(f"{run.runs}: unknown protocol", row.protocol, run.protocols)
    tables = {} if found else read_tables(run.tables)
    figures = read_figures(run.figures) if run.figures and not found else {}
    for pair in run.reenact:
        for name in pair.split("/"):
            _check("reenact: unknown subject", name, subjects)
    everybody = subjects
    if run.only:
        for name in run.only:
            _check("only: unknown subject", name, subjects)
        subjects = {name: subject for name, subject in subjects.items() if name in run.only}
        rows = [row for row in rows if row.subject in subjects]
        pairs = [pair for pair in run.reenact if all(name in subjects for name in pair.split("/"))]
        run = dataclasses.replace(run, reenact=pairs)
        tables = {name: table for name, table in tables.items() if _shows_one(table, rows)}
        figures = {name: figure for name, figure in figures.items() if _draws_one(figure, rows, pairs)}

    def held(protocol: str) -> bool:
        return _holds_out_view(run.protocols, protocol)

    rows = [row for row in rows if subjects[row.subject].test_camera or not held(row.protocol)]
    if not any(subject.test_camera for subject in subjects.values()):
        tables = {k: table for k, table in tables.items() if table.speeds or not all(map(held, table.protocols))}
        figures = {k: figure for k, figure in figures.items() if not held(figure.protocol)}
    starts = checked_starts(run, everybody, [(row.subject, row.variant) for row in rows])
    known = {*subjects, *(name for name, _ in starts)}
    subjects = {name: subject for name, subject in everybody.items() if name in known}
    return Plan(run, subjects, rows, starts, tables, figures)


def _check(what: str, name: str, known: Mapping[str, Any]) -> None:
    if name not in known:
        raise ConfigError(f"{what} '{name}'; {did_you_mean(name, known)}")


def _shows_one(table: TableLayout, rows: Sequence[Row]) -> bool:
    """Whether a table has a number of one of the rows; those of the run as a whole always do."""
    return table.kind in ("speed", "cameras") or any(
        (row.subject in table.subjects or table.subjects == ["*"])
        and row.variant in table.variants
        and row.protocol in table.protocols
        for row in rows
    )


def _draws_one(figure: FigureLayout, rows: Sequence[Row], pairs: Sequence[str]) -> bool:
    """Whether a figure has something to draw of the rows and of the pairs source/target of subjects."""
    if figure.kind == "reenactment":
        return bool(pairs)
    return figure.kind == "curves" or any(
        figure.shows(row.subject)
        and row.protocol == figure.protocol
        and (row.variant in figure.variants or not figure.variants)
        for row in rows
    )


def _holds_out_view(protocols: Mapping[str, ProtocolConfig], protocol: str) -> bool:
    known = protocols.get(protocol)
    return known is not None and known.split == "novel_view"
