"""Layout of the tables: which rows and columns, and where each number comes from. What `config/tables.yaml` holds."""

import dataclasses
import os
import re

from nbavatar.config.core import option
from nbavatar.config.layouts import choose_layout, read_layouts
from nbavatar.errors import ConfigError, describe

__all__ = ["TIMED", "TRAINED", "Panel", "TableLayout", "TableRow", "choose_table", "read_tables"]

# Columns that come from a timing, and from the record of a training.
TIMED = ("fps", "ms", "memory_mb")
TRAINED = ("model_mb", "primitives", "train_minutes", "train_memory_mb")
_LABEL = re.compile(r"[A-Za-z0-9:._-]*")
# What may stand between the $ signs of a row: nothing that reads a file, defines, or ends the formula.
_FORMULA = re.compile(r"(?:\\[A-Za-z]++|\\[,;! ]|\^(?!\^)|[A-Za-z0-9 _{}+\-=.,:;()\[\]|/<>*'!])*")
_COMMANDS = frozenset(
    "alpha beta gamma delta epsilon varepsilon zeta eta theta kappa lambda mu nu xi pi rho sigma tau phi varphi "
    "chi psi omega Gamma Delta Theta Lambda Xi Pi Sigma Phi Psi Omega mathcal mathbf mathrm mathit mathbb mathsf "
    "mathtt text textbf textit textrm boldsymbol bm hat bar tilde vec dot overline underline times cdot pm mp leq "
    "geq neq approx sim ll gg infty ldots cdots to rightarrow leftarrow uparrow downarrow in ell partial nabla "
    "sum prod frac sqrt log exp min max left right quad qquad ast star circ prime dagger emptyset setminus cup "
    "cap".split()
)
METRICS = ("psnr", "ssim", "lpips", "psnr_fg", "ssim_fg", *TIMED, *TRAINED, "train_cameras", "test_camera")


@dataclasses.dataclass(frozen=True)
class TableRow:
    """One row: its printed name, the variant that reproduces it, its id in the sheet of printed numbers."""

    label: str = option("", "What the row is called; LaTeX between $ signs.")
    variant: str = option("", "Variant whose results fill the row; empty for rows that are only quoted.")
    reported: str | None = option(None, "Row id in the sheet of printed numbers; the label by default, '' for none.")
    stage: str = option("", "speed: key of the timing; cameras: the subject.")
    rule: bool = option(False, "Draw a line above the row.")
    shaded: bool = option(False, "Shade the row, as the paper does with the setting it selects.")

    @property
    def reported_id(self) -> str:
        """Row id in the sheet of printed numbers."""
        return self.label if self.reported is None else self.reported


@dataclasses.dataclass(frozen=True)
class Panel:
    """One sub-table: a protocol and its id in the sheet of printed numbers."""

    title: str = option("", "Heading of the sub-table; empty where there is only one.")
    protocol: str = option("", "Protocol whose results fill it.")
    reported: str = option("", "Table id in the sheet of printed numbers.")


@dataclasses.dataclass(frozen=True)
class TableLayout:
    """One table."""

    kind: str = option(
        "subject",
        "subjects: metrics of each subject and their mean; mean: mean over the subjects; subject: one subject; speed: "
        "stages of one frame; cameras: training and evaluation cameras.",
        choices=("subjects", "mean", "subject", "speed", "cameras"),
    )
    title: str = option("", "Short title.")
    caption: str = option("", "Caption; protocol, sizes and deviations are added to it.")
    label: str = option("", "LaTeX label, without its prefix.")
    head: str = option("Method", "Heading of the first column.")
    size: int = option(1024, "Side of the paper's images [px]; results of another size are shown apart.", min=1)
    subjects: list[str] = option([], "Subjects, in order.")
    columns: list[str] = option([], "Columns, in order.", choices=METRICS)
    ranked: bool = option(True, "Mark the best value of each column bold, the second underlined.")
    second: bool = option(True, "Also mark the second best value.")
    panels: list[Panel] = option([], "Sub-tables.")
    rows: list[TableRow] = option([], "Rows, in order.")

    @property
    def variants(self) -> tuple[str, ...]:
        """Variants whose evaluations the table shows."""
        if self.kind == "speed":
            return ()
        return tuple(dict.fromkeys(row.variant for row in self.rows if row.variant))

    @property
    def protocols(self) -> tuple[str, ...]:
        """Protocols whose evaluations the table shows."""
        return tuple(dict.fromkeys(panel.protocol for panel in self.panels if panel.protocol))

    @property
    def speeds(self) -> tuple[str, ...]:
        """Variants whose timings the table shows."""
        if self.kind != "speed" and not set(TIMED) & set(self.columns):
            return ()
        return tuple(dict.fromkeys(row.variant for row in self.rows if row.variant))


def read_tables(path: str | os.PathLike[str]) -> dict[str, TableLayout]:
    """Reads the layouts of all tables, by name.

    Raises:
        ConfigError: no such file, not YAML, an unknown key, a wrong type.
    """
    tables = read_layouts(path, TableLayout, "table")
    for name, table in tables.items():
        where = f"{path}: {name}"
        if not table.rows or not table.panels or not table.columns:
            raise ConfigError.of(where, expected="rows, columns and panels", found="an empty list among them")
        if not _LABEL.fullmatch(table.label):
            expected = "letters, digits, ':', '.', '_' and '-'"
            raise ConfigError.of(where, "label", expected=expected, found=describe(table.label))
        for row in table.rows:
            _check_formulas(row.label, where)
        if table.kind in ("subjects", "mean", "subject") and not table.subjects:
            raise ConfigError.of(where, "subjects", expected="one subject or more", found="none")
    return tables


def _check_formulas(label: str, where: str) -> None:
    """Refuses a label whose formulas are more than formulas: what is between its $ signs goes to LaTeX as it is."""
    for formula in label.split("$")[1::2]:
        unknown = [name for name in re.findall(r"\\([A-Za-z]+)", formula) if name not in _COMMANDS]
        if unknown or not _FORMULA.fullmatch(formula):
            found = f"\\{unknown[0]}" if unknown else describe(formula)
            raise ConfigError.of(where, "label of a row", expected="a plain formula between $ signs", found=found)


def choose_table(tables: dict[str, TableLayout], name: str, where: str) -> TableLayout:
    """The layout of one table.

    Raises:
        ConfigError: there is none of this name.
    """
    return choose_layout(tables, name, where, "table")
