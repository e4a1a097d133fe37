"""Layout of the figures: what is shown beside what. What `config/figures.yaml` holds."""

import dataclasses
import os

from nbavatar.config.core import option
from nbavatar.config.layouts import choose_layout, read_layouts
from nbavatar.errors import ConfigError

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
    figures = read_layouts(path, FigureLayout, "figure")
    for name, figure in figures.items():
        if figure.kind == "comparison" and not (figure.columns and figure.protocol):
            raise ConfigError.of(f"{path}: {name}", expected="columns and a protocol", found="none")
    return figures


def choose_figure(figures: dict[str, FigureLayout], name: str, where: str) -> FigureLayout:
    """The layout of one figure.

    Raises:
        ConfigError: there is none of this name.
    """
    return choose_layout(figures, name, where, "figure")
