"""A whole run: its name, data, stages, variants, protocols. What `config/*.yaml` files hold.

Every value has the paper's setting as its default, so a configuration file lists only what differs.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from nbavatar.config.compare import CompareRun, compared
from nbavatar.config.core import from_mapping, merge, option, to_mapping
from nbavatar.config.evaluation import (
    EvaluateConfig,
    ProtocolConfig,
    ReportConfig,
    SpeedConfig,
    TableConfig,
    VideoConfig,
)
from nbavatar.config.geometry import AlignConfig, DeformConfig, FitConfig, LightConfig, ShellConfig, SpectralConfig
from nbavatar.config.preprocess import CheckConfig, CropConfig, FramesConfig, IngestConfig, MasksConfig, TracksConfig
from nbavatar.config.synthetic import SynthesizeConfig
from nbavatar.config.training import TrainConfig, own_options
from nbavatar.config.yamlfiles import check_tree
from nbavatar.errors import ConfigError, describe, did_you_mean
from nbavatar.names import check_name, check_place

__all__ = ["RunConfig", "Stages", "TradeoffRun", "Variant", "load_run", "stage_options"]


@dataclasses.dataclass(frozen=True)
class Stages:
    """Options of every stage."""

    synthesize: SynthesizeConfig = option(SynthesizeConfig, "Synthetic dataset (used where `synthetic` is true).")
    check: CheckConfig = option(CheckConfig, "Validation of a capture before anything is made of it.")
    ingest: IngestConfig = option(IngestConfig, "Reading of videos or image folders.")
    tracks: TracksConfig = option(TracksConfig, "Reading of parameters, keypoints and meshes.")
    masks: MasksConfig = option(MasksConfig, "Head and hand masks.")
    fit: FitConfig = option(FitConfig, "Multi-view refit.")
    align: AlignConfig = option(AlignConfig, "Alignment of a capture's meshes to its pictures.")
    shell: ShellConfig = option(ShellConfig, "What the head's mesh of a capture lacks, such as hair.")
    light: LightConfig = option(LightConfig, "The light of a capture's studio.")
    spectral: SpectralConfig = option(SpectralConfig, "Spectral coordinates.")
    deform: DeformConfig = option(DeformConfig, "Contact deformation.")
    train: TrainConfig = option(TrainConfig, "Training.")
    evaluate: EvaluateConfig = option(EvaluateConfig, "Metrics.")
    speed: SpeedConfig = option(SpeedConfig, "Timing.")
    table: TableConfig = option(TableConfig, "Tables.")
    video: VideoConfig = option(VideoConfig, "Videos.")
    report: ReportConfig = option(ReportConfig, "HTML report.")


@dataclasses.dataclass(frozen=True)
class Variant:
    """One way to train an avatar: which crops, which meshes, and what differs from `stages`."""

    crop: str = option("center", "Name of the crop (see `crops`) whose frames it is trained on.")
    meshes: str = option(
        "deform",
        "Meshes that carry it: with contact deformation, as refitted (a capture's: as aligned), or as delivered.",
        choices=("deform", "fit", "tracks"),
    )  # fmt: skip
    shell: bool = option(
        True, "Whether it has the shell, where a capture has one (`stages.shell`); delivered meshes never have."
    )
    stages: dict[str, Any] = option({}, "Options that differ from the run's `stages`, by stage.")


@dataclasses.dataclass(frozen=True)
class TradeoffRun:
    """Sweeps of speed against accuracy (`nbavatar tradeoff`)."""

    sheet: str = option("config/tradeoff.yaml", "Knobs and values.")
    variants: list[str] = option([], "Variants to sweep, for the first subject that has them; none by default.")
    protocol: str = option("nv1024", "Protocol whose images judge quality.")
    side: int = option(
        0, "Longer side that pictures have at least: rendered a whole number of times as large as the images [px].",
        min=0, max=8192,
    )  # fmt: skip
    also: list[str] = option(
        [], "What is measured besides: every saving on and off, the stages before training.",
        choices=("savings", "offline"),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Everything that one configuration file says."""

    run: str = option("paper", "Name of the run; its files live in results/<run>, logs/<run>, benchmarks/<run>.")
    layout: str = option("decaf", "Layout of the input data.", choices=("decaf", "capture"))
    data_root: str = option("resources/DecafDataset", "Folder of the dataset, or of one capture, or of captures.")
    synthetic: bool = option(False, "Make the dataset at `data_root` with `nbavatar synthesize` first.")
    subjects: str = option("config/subjects.tsv", "Sheet of subjects and cameras; not used by the capture layout.")
    test_camera: str | int = option(
        "",
        "Capture layout: camera to hold out (084 and 84 mean the same); empty for the one that its splits.json names, "
        "or else the one best surrounded by others.",
    )
    runs: str = option("config/runs.tsv", "Sheet of what to make: subject, variant, protocol.")
    only: list[str] = option(
        [], "Subjects of whom something is made, of those in the sheet of subjects; empty for all of them."
    )
    tables: str = option("config/tables.yaml", "Layout of the tables.")
    reported: str = option("config/reported.csv", "Numbers printed in the paper.")
    figures: str = option("config/figures.yaml", "Layout of the figures; empty for none.")
    videos: list[str] = option([], "Variants of which a turntable and a driven video are made, for every subject.")
    reenact: list[str] = option([], "Pairs source/target of subjects: the source is shown in the target's poses.")
    tradeoff: TradeoffRun = option(TradeoffRun, "Speed against accuracy.")
    compare: CompareRun = option(CompareRun, "Quality against the time of training, with the spread over seeds.")
    extremes: str = option(
        "",
        "Also drive every kernel to its limits: quick, full, or empty for not in this run.",
        choices=("", "quick", "full"),
    )
    device: str = option("auto", "Device of training, rendering and timing.", choices=("auto", "cpu", "cuda"))
    size_label: str = option(
        "", "What is said in every table caption when sizes are not the paper's, such as 'smoke size, 64 px'."
    )
    frames: FramesConfig = option(
        FramesConfig, "Which frames are used and held out; goes to `ingest` and `tracks` alike."
    )
    stages: Stages = option(Stages, "Options of every stage.")
    crops: dict[str, CropConfig] = option(
        {"center": CropConfig(kind="center", size=1024), "box": CropConfig(kind="box", size=512)},
        "Crops by name: the paper's 1024 protocol uses `center`, its 512 protocol `box`.",
    )
    protocols: dict[str, ProtocolConfig] = option({}, "Evaluation protocols by name.")
    variants: dict[str, Variant] = option({}, "Variants by name.")


def load_run(mapping: Mapping[str, Any], where: str = "config") -> RunConfig:
    """Reads and checks a whole run's configuration.

    Raises:
        ConfigError: an unknown key, a wrong type, a value out of range, a crop or stage that does not exist.
    """
    check_tree(mapping, where)
    run = from_mapping(RunConfig, mapping, where)
    check_name(run.run, f"{where}.run", error=ConfigError)
    for key in ("data_root", "tables", "reported", "figures"):
        check_place(getattr(run, key), f"{where}.{key}", error=ConfigError)
    check_place(run.tradeoff.sheet, f"{where}.tradeoff.sheet", error=ConfigError)
    for key in ("crops", "protocols", "variants"):
        for name in getattr(run, key):
            check_name(name, f"{where}.{key}", error=ConfigError)
    for name, crop in [(f"variants.{n}", v.crop) for n, v in run.variants.items()] + [
        (f"protocols.{n}", p.crop) for n, p in run.protocols.items()
    ]:
        if crop not in run.crops:
            raise ConfigError(f"{where}.{name}.crop: unknown crop '{crop}'; {did_you_mean(crop, run.crops)}")
    stages = {field.name for field in dataclasses.fields(Stages)}
    for name, variant in run.variants.items():
        for stage in variant.stages:
            if stage not in stages:
                raise ConfigError(f"{where}.variants.{name}: unknown stage '{stage}'; {did_you_mean(stage, stages)}")
            if not isinstance(variant.stages[stage], Mapping):
                place, found = f"{where}.variants.{name}.stages.{stage}", describe(variant.stages[stage])
                raise ConfigError.of(place, expected="a mapping of options", found=found)
            _resolved(run, stage, name)
    for name in (*run.videos, *run.tradeoff.variants):
        if name not in run.variants:
            raise ConfigError(f"{where}: unknown variant '{name}'; {did_you_mean(name, run.variants)}")
    if run.tradeoff.variants and run.tradeoff.protocol not in run.protocols:
        name = run.tradeoff.protocol
        raise ConfigError(f"{where}.tradeoff.protocol: unknown protocol '{name}'; {did_you_mean(name, run.protocols)}")
    for pair in run.reenact:
        if pair.count("/") != 1:
            raise ConfigError.of(f"{where}.reenact", expected="pairs source/target", found=repr(pair))
    return _with_compared(run, where)


def _with_compared(run: RunConfig, where: str) -> RunConfig:
    """The run with a variant for every avatar of its comparison."""
    for kind, names, known in (
        ("variant", run.compare.variants, run.variants),
        ("protocol", run.compare.protocols if run.compare.variants else [], run.protocols),
    ):
        for name in names:
            if name not in known:
                raise ConfigError(f"{where}.compare: unknown {kind} '{name}'; {did_you_mean(name, known)}")
    derived = {}
    for one in compared(run.compare):
        variant = run.variants[one.variant]
        stages = merge(variant.stages, {"train": one.options()})
        derived[check_name(one.name, f"{where}.compare", error=ConfigError)] = dataclasses.replace(
            variant, stages=stages
        )
    return dataclasses.replace(run, variants={**run.variants, **derived})


def stage_options(run: RunConfig, stage: str, variant: str | None = None) -> dict[str, Any]:
    """The resolved options of one stage, all keys present, JSON-ready; of training, those of its method."""
    options = to_mapping(_resolved(run, stage, variant))
    return own_options(options) if stage == "train" else options


def _resolved(run: RunConfig, stage: str, variant: str | None) -> Any:
    base = getattr(run.stages, stage)
    over = run.variants[variant].stages.get(stage, {}) if variant is not None else {}
    if isinstance(base, FramesConfig):  # both readers must agree on the frames
        over = merge(over, to_mapping(run.frames))
    return from_mapping(type(base), merge(to_mapping(base), over), f"variants.{variant}.stages.{stage}")
