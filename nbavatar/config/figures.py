"""Layout of the figures: what is shown beside what. What `config/figures.yaml` holds."""

import dataclasses
import os
from pathlib import Path

from nbavatar.config.core import from_mapping, option
from nbavatar.errors import ConfigError, did_you_mean

__all__ = ["FigureColumn", "FigureLayout", "choose_figure", "read_figures"]

KINDS = ("comparison", "features", "reenactment", "contact", "curves", "pareto")
ROWS = ("whole", "zoom", "coverage", "error")


@dataclasses.dataclass(frozen=True)
class FigureColumn:
    """One method of a comparison."""

    variant: str = option("", "Variant whose render is shown.")
    label: str = option("", "Heading; the variant's name by default.")


@dataclasses.dataclass(frozen=True)
class FigureLayout:
    """One figure."""

    kind: str = option(
        "comparison",
        "comparison: truth and methods, with insets and error maps; features: what the billboards carry and the "
        "renderer makes of it; reenactment: one subject driven by another's poses; contact: the head before and after "
        "the contact stage; curves: training histories; pareto: quality against time, memory and bytes.",
        choices=KINDS,
    )
    title: str = option("", "Short title.")
    caption: str = option("", "Caption.")
    protocol: str = option("", "Protocol of the renders (comparison, pareto); of the crops otherwise.")
    subjects: list[str] = option(["*"], "Subjects, in order; * stands for all that there are.")
    columns: list[FigureColumn] = option([], "comparison: methods, in order; one that has no result is left out.")
    rows: list[str] = option(["whole", "zoom", "error"], "comparison: rows for each frame.", choices=ROWS)
    variant: str = option("full", "features, reenactment: whose avatar.")
    frames: int = option(1, "Frames of each subject, those with the largest contact of hand and head.", min=1, max=20)

    @property
    def variants(self) -> tuple[str, ...]:
        """Variants that the figure shows."""
        if self.kind == "comparison":
            return tuple(dict.fromkeys(column.variant for column in self.columns))
        return (self.variant,) if self.kind in ("features", "reenactment") else ()

    def shows(self, subject: str) -> bool:
        """Whether a subject belongs to the figure."""
        return self.subjects == ["*"] or subject in self.subjects


def read_figures(path: str | os.PathLike[str]) -> dict[str, FigureLayout]:
    """Reads the layouts of all figures, by name.

    Raises:
        ConfigError: no such file, not YAML, an unknown key, a wrong type.
    """
    import yaml

    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError.of(path, expected="the layout of the figures (.yaml)", found="no such file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError.of(path, expected="YAML", found=f"text that does not parse ({error})") from error
    if not isinstance(content, dict):
        raise ConfigError.of(path, expected="figure name -> layout", found=type(content).__name__)
    figures = {str(name): from_mapping(FigureLayout, value, f"{path}: {name}") for name, value in content.items()}
    for name, figure in figures.items():
        if figure.kind == "comparison" and not (figure.columns and figure.protocol):
            raise ConfigError.of(f"{path}: {name}", expected="columns and a protocol", found="none")
    return figures


def choose_figure(figures: dict[str, FigureLayout], name: str, where: str) -> FigureLayout:
    """The layout of one figure.

    Raises:
        ConfigError: there is none of this name.
    """
    if name not in figures:
        raise ConfigError(f"{where}: unknown figure '{name}'; {did_you_mean(name, figures)}")
    return figures[name]
