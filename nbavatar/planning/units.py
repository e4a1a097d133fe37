"""Units of work: on whom each stage works, and what it needs of the others.

The fields of a unit are the wildcards of the rules that make it. Everything is in the order of the sheets, and each
unit is there once.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TypeVar

from nbavatar.config.sheets import Row
from nbavatar.errors import ConfigError, did_you_mean
from nbavatar.planning.run import Plan
from nbavatar.planning.starts import start_of as find_start

__all__ = [
    "Avatar",
    "Crop",
    "Figure",
    "Judged",
    "Meshes",
    "Person",
    "Reenactment",
    "Table",
    "Video",
    "View",
    "avatars",
    "crops",
    "figures",
    "fitted",
    "judged",
    "judged_crops",
    "judged_on",
    "meshes_of",
    "people",
    "reenactments",
    "rows_of_table",
    "start_of",
    "starts",
    "swept",
    "tables",
    "timed",
    "timed_in_table",
    "trained_on",
    "training_views",
    "trivial_answers",
    "videos",
    "views",
    "whole",
]


@dataclasses.dataclass(frozen=True)
class Person:
    """One subject."""

    subject: str


@dataclasses.dataclass(frozen=True)
class View:
    """What one camera recorded of a subject."""

    subject: str
    camera: str


@dataclasses.dataclass(frozen=True)
class Crop:
    """The same, cropped in one of the run's ways."""

    crop: str
    subject: str
    camera: str


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Meshes of a subject as one stage leaves them: `tracks`, `fit`, `align`, `shell` or `deform`."""

    stage: str
    subject: str


@dataclasses.dataclass(frozen=True)
class Avatar:
    """A subject's avatar of one variant: one training."""

    subject: str
    variant: str


@dataclasses.dataclass(frozen=True)
class Video:
    """A video of an avatar: a `turntable`, or `driven` by the subject's own motion."""

    subject: str
    variant: str
    kind: str


@dataclasses.dataclass(frozen=True)
class Reenactment:
    """One subject's head in another's poses."""

    source: str
    target: str


@dataclasses.dataclass(frozen=True)
class Judged:
    """All that one protocol judges of a subject."""

    subject: str
    protocol: str


@dataclasses.dataclass(frozen=True)
class Table:
    """One table."""

    table: str


@dataclasses.dataclass(frozen=True)
class Figure:
    """One figure."""

    figure: str


T = TypeVar("T")


def _once(units: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(units))


def people(plan: Plan) -> list[Person]:
    """Subjects of whom something is made."""
    return _once(Person(row.subject) for row in plan.rows)


def views(plan: Plan) -> list[View]:
    """All cameras of these subjects."""
    return [View(one.subject, camera) for one in people(plan) for camera in plan.subjects[one.subject].cameras]


def crops(plan: Plan) -> list[Crop]:
    """All crops of these cameras."""
    return [Crop(crop, view.subject, view.camera) for crop in plan.run.crops for view in views(plan)]


def avatars(plan: Plan) -> list[Avatar]:
    """What is trained."""
    return _once(Avatar(row.subject, row.variant) for row in plan.rows)


def starts(plan: Plan) -> list[Avatar]:
    """What is trained only because others start from it."""
    return [avatar for named in plan.starts if (avatar := Avatar(*named)) not in avatars(plan)]


def start_of(plan: Plan, subject: str, variant: str) -> Avatar | str:
    """What a training starts from: an avatar of the run, a file, or nothing (empty)."""
    start = find_start(plan.run, subject, variant)
    return start if isinstance(start, str) else Avatar(*start)


def tables(plan: Plan) -> list[Table]:
    """All tables."""
    return [Table(name) for name in plan.tables]


def figures(plan: Plan) -> list[Figure]:
    """All figures."""
    return [Figure(name) for name in plan.figures]


def judged(plan: Plan) -> list[Judged]:
    """Subjects, each under every protocol that judges it."""
    return _once(Judged(row.subject, row.protocol) for row in plan.rows)


def videos(plan: Plan) -> list[Video]:
    """A turntable and a driven video of every avatar whose variant asks for them."""
    filmed = [avatar for avatar in avatars(plan) if avatar.variant in plan.run.videos]
    return [Video(avatar.subject, avatar.variant, kind) for avatar in filmed for kind in ("turntable", "driven")]


def reenactments(plan: Plan, variant: str) -> list[Reenactment]:
    """Pairs of subjects of which the source has an avatar of this variant."""
    pairs = [Reenactment(*pair.split("/")) for pair in plan.run.reenact]
    return [pair for pair in pairs if Avatar(pair.source, variant) in avatars(plan)]


def training_views(plan: Plan, subject: str) -> list[View]:
    """The cameras that a subject is trained on."""
    return [View(subject, camera) for camera in plan.subjects[subject].train_cameras]


def _training_crops(plan: Plan, crop: str, subject: str) -> list[Crop]:
    return [Crop(crop, view.subject, view.camera) for view in training_views(plan, subject)]


def trained_on(plan: Plan, subject: str, variant: str) -> list[Crop]:
    """Crops of the training cameras, as a variant asks for them."""
    return _training_crops(plan, plan.run.variants[variant].crop, subject)


def judged_on(plan: Plan, subject: str, protocol: str) -> list[Crop]:
    """Crops that a protocol looks at: the held-out camera for novel views, the training cameras for held-out poses.

    Raises:
        ConfigError: no such protocol, or a novel view is asked for where one camera recorded the subject.
    """
    if protocol not in plan.run.protocols:
        raise ConfigError(f"unknown protocol '{protocol}'; {did_you_mean(protocol, plan.run.protocols)}")
    if not plan.holds_out_view(protocol):
        return trivial_answers(plan, subject, protocol)
    camera = plan.subjects[subject].test_camera
    if not camera:
        raise ConfigError(
            f"{subject}: one camera recorded it, and none is held out for protocol '{protocol}'; "
            "take a protocol of split self_reenactment"
        )
    return [Crop(plan.run.protocols[protocol].crop, subject, camera)]


def judged_crops(plan: Plan) -> list[Crop]:
    """Crops that some protocol looks at."""
    return _once(crop for row in plan.rows for crop in judged_on(plan, row.subject, row.protocol))


def trivial_answers(plan: Plan, subject: str, protocol: str) -> list[Crop]:
    """Training crops of the same kind: their mean image is one of the trivial answers that a result is compared to."""
    return _training_crops(plan, plan.run.protocols[protocol].crop, subject)


def fitted(plan: Plan, subject: str) -> Meshes:
    """Meshes before contact: refitted ones, or those that a capture brings, aligned or not."""
    return Meshes("align" if plan.aligned else "tracks" if plan.captured else "fit", subject)


def whole(plan: Plan, subject: str) -> Meshes:
    """The same with all parts that a variant may have."""
    return Meshes("shell", subject) if plan.shelled else fitted(plan, subject)


def meshes_of(plan: Plan, subject: str, variant: str) -> Meshes:
    """The meshes that carry a variant."""
    wanted = plan.run.variants[variant]
    if wanted.meshes == "fit" or (wanted.meshes == "deform" and not plan.solves_contact):
        return whole(plan, subject) if wanted.shell else fitted(plan, subject)
    return Meshes(wanted.meshes, subject)


def rows_of_table(plan: Plan, table: str) -> list[Row]:
    """The rows of the sheet that a table shows."""
    layout = plan.tables[table]
    return [row for row in plan.rows if row.variant in layout.variants and row.protocol in layout.protocols]


def timed_in_table(plan: Plan, table: str) -> list[Avatar]:
    """Avatars whose timings a table shows."""
    return _first_of_each(plan, plan.tables[table].speeds)


def timed(plan: Plan) -> list[Avatar]:
    """Avatars that some table times: timing takes the machine for itself, so no more than needed."""
    return _once(avatar for table in plan.tables for avatar in timed_in_table(plan, table))


def swept(plan: Plan, variants: Sequence[str]) -> list[Avatar]:
    """Avatars of these variants whose speed is traded against accuracy."""
    return _first_of_each(plan, variants)


def _first_of_each(plan: Plan, variants: Sequence[str]) -> list[Avatar]:
    """The avatar of the first subject that has each of some variants."""
    first: dict[str, Avatar] = {}
    for avatar in avatars(plan):
        if avatar.variant in variants:
            first.setdefault(avatar.variant, avatar)
    return list(first.values())
