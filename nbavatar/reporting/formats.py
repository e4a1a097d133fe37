"""Writes a table as csv, Markdown and LaTeX. All text, nothing computed.

csv         one line a cell: block, row, column, shown text, exact value, mark, and the file, digest and protocol hash
            it comes from; also what the other formats leave out (foreground metrics, all LPIPS nets, trivial answers)
Markdown    **best**, <u>second</u>, missing cells as an em dash
LaTeX       a snippet to \\input; needs booktabs, graphicx, subcaption and, for shading, xcolor with option table
"""
# pyright: reportArgumentType=false, reportReturnType=false
# The stubs of pandas take a column for a table and know one kind of key.

import json
import re
from collections.abc import Iterable, Iterator

import pandas as pd

from nbavatar.reporting.cells import COLUMNS, MISSING, PanelTable, Table, plain

__all__ = ["to_csv", "to_latex", "to_markdown"]

# Shrinks what is wider than the line and leaves the rest alone.
_FIT = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "—": "---", "×": r"$\times$",
}  # fmt: skip


def to_csv(table: Table) -> str:
    """Tidy csv, one line a cell, missing cells included."""
    cells = table.cells
    columns = {
        "table": table.name,
        "panel": [table.panels[panel].title for panel in cells["panel"]],
        "block": cells["block"],
        "row": cells["label"].map(plain),
        **{name: cells[name] for name in ("column", "text", "value", "mark")},
        **{name: cells[name].map({True: "yes", False: "no"}) for name in ("comparable", "shown")},
        "source": [";".join(source.path for source in sources) for sources in cells["sources"]],
        "digest": [";".join(source.digest for source in sources) for sources in cells["sources"]],
        "protocol_hash": [_each(source.protocol_hash for source in sources) for sources in cells["sources"]],
        "size": [_each("x".join(map(str, source.size or ())) for source in sources) for sources in cells["sources"]],
        "note": cells["note"],
    }
    return pd.DataFrame(columns).to_csv(index=False, lineterminator="\n")


def _each(words: Iterable[str]) -> str:
    """Each word once, in order, without empty ones."""
    return ";".join(dict.fromkeys(word for word in words if word))


def _shown(table: Table, panel: PanelTable) -> Iterator[tuple[str, list[pd.DataFrame]]]:
    """Heading and lines of each block of a panel; a line is a frame with one row a column."""
    number = next(i for i, other in enumerate(table.panels) if other is panel)
    cells = table.cells[table.cells["shown"] & (table.cells["panel"] == number)]
    for _, block in cells.groupby("block", sort=False):
        yield block["heading"].iloc[0], [line for _, line in block.groupby("line", sort=False)]


def to_markdown(table: Table) -> str:
    """Markdown with one table a panel, notes, and the list of sources."""
    parts = [f"## {table.title}", "", table.caption, ""]
    for panel in table.panels:
        if panel.title:
            parts += [f"### {panel.title}", ""]
        heads = [table.head, *(_heading(group, key) for group, keys in panel.groups for key in keys)]
        parts += [_md_row(heads), _md_row(["---", *(["---:"] * (len(heads) - 1))])]
        for heading, lines in _shown(table, panel):
            parts.append(_md_row([f"*{heading}*", *([""] * (len(heads) - 1))]))
            for line in lines:
                cells = map(_md_cell, line["text"], line["mark"])
                parts.append(_md_row([plain(line["label"].iloc[0]), *cells]))
        parts.append("")
    parts += [*(f"- {note}" for note in table.notes), ""]
    sources = [f"- `{_one_line(path)}` {digest}" for path, digest in _sources(table)]
    if sources:
        parts += ["Sources:", "", *sources, ""]
    if table.record:
        text = json.dumps(table.record, sort_keys=True).replace("--", "- -")
        parts += [f"<!-- {text} -->", ""]
    return "\n".join(parts)


def _md_row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _md_cell(text: str, mark: str) -> str:
    text = text or MISSING
    return {"best": f"**{text}**", "second": f"<u>{text}</u>"}.get(mark, text)


def to_latex(table: Table) -> str:
    """LaTeX table environment in the paper's layout."""
    notes = " ".join([table.caption, *table.notes])
    parts = [
        f"% Table {table.name}. Needs \\usepackage{{booktabs,graphicx,subcaption}} and \\usepackage[table]{{xcolor}}.",
        *(f"% source: {_one_line(path)} {digest}" for path, digest in _sources(table)),
        *([f"% record: {json.dumps(table.record, sort_keys=True)}"] if table.record else []),
        "\\begin{table}[t]",
        "\\centering",
        f"\\caption{{\\textbf{{{_escape(table.title)}.}} {_escape(notes)}}}",
        f"\\label{{tab:{table.label}}}",
    ]
    for panel in table.panels:
        body = _latex_tabular(table, panel)
        if len(table.panels) == 1:
            parts += [_FIT, *body, "}"]
        else:
            width = f"{0.98 / len(table.panels):.2f}"
            parts += [
                f"\\begin{{subtable}}[t]{{{width}\\linewidth}}",
                "\\centering",
                f"\\caption{{\\textbf{{{_escape(panel.title)}}}}}",
                _FIT,
                *body,
                "}",
                "\\end{subtable}",
                *(["\\hfill"] if panel is not table.panels[-1] else []),
            ]
    return "\n".join([*parts, "\\end{table}", ""])


def _latex_tabular(table: Table, panel: PanelTable) -> list[str]:
    aligned = " ".join("c" * len(keys) for _, keys in panel.groups)
    lines = [f"\\begin{{tabular}}{{l {aligned}}}", "\\toprule"]
    if any(group for group, _ in panel.groups):
        heads, rules, first = [], [], 2
        for group, keys in panel.groups:
            last = first + len(keys) - 1
            heads.append(f"\\multicolumn{{{len(keys)}}}{{c}}{{{_escape(group)}}}")
            rules.append(f"\\cmidrule(lr){{{first}-{last}}}")
            first = last + 1
        lines += ["& " + " & ".join(heads) + r" \\", " ".join(rules)]
    heads = [_escape(table.head), *(_latex_heading(key) for key in panel.columns)]
    lines += [" & ".join(heads) + r" \\", "\\midrule"]
    span = len(panel.columns) + 1
    for i, (heading, block) in enumerate(_shown(table, panel)):
        if i > 0:
            lines.append("\\midrule")
        lines.append(f"\\multicolumn{{{span}}}{{l}}{{\\textit{{{_escape(heading)}}}}} \\\\")
        for line in block:
            if line["rule"].iloc[0]:
                lines.append(f"\\cmidrule(lr){{1-{span}}}")
            if line["shaded"].iloc[0]:
                lines.append("\\rowcolor{gray!20}")
            cells = map(_latex_cell, line["text"], line["mark"])
            lines.append(" & ".join([_latex_label(line["label"].iloc[0]), *cells]) + r" \\")
    return [*lines, "\\bottomrule", "\\end{tabular}"]


def _latex_cell(text: str, mark: str) -> str:
    text = f"${text}$" if re.fullmatch(r"[+-][0-9.]+", text) else _escape(text or MISSING)
    return {"best": f"\\textbf{{{text}}}", "second": f"\\underline{{{text}}}"}.get(mark, text)


def _latex_label(label: str) -> str:
    """Escapes everything but what stands between $ signs."""
    pieces = label.split("$")
    return "".join(f"${piece}$" if i % 2 else _escape(piece) for i, piece in enumerate(pieces))


def _latex_heading(column: str) -> str:
    style = COLUMNS[column.rpartition(".")[2]]
    arrow = {True: r"$\uparrow$", False: r"$\downarrow$", None: ""}[style.higher_is_better]
    return _escape(style.heading) + arrow


def _escape(text: str) -> str:
    return "".join(_SPECIAL.get(letter, letter) for letter in text)


def _one_line(path: str) -> str:
    """A path with its line breaks and other control characters written out: behind one, a comment would have ended."""
    return json.dumps(path, ensure_ascii=False)[1:-1]


def _heading(group: str, column: str) -> str:
    style = COLUMNS[column.rpartition(".")[2]]
    arrow = {True: " ↑", False: " ↓", None: ""}[style.higher_is_better]
    return f"{group} {style.heading}{arrow}".strip()


def _sources(table: Table) -> list[tuple[str, str]]:
    shown = table.cells[table.cells["shown"]]
    return list(dict.fromkeys((s.path, s.digest) for sources in shown["sources"] for s in sources))
