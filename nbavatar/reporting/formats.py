"""Writes a table as csv, Markdown and LaTeX. All text, nothing computed.

csv         one line a cell: block, row, column, shown text, exact value, mark, and the file, digest and protocol hash
            it comes from; also what the other formats leave out (foreground metrics, all LPIPS nets, trivial answers)
Markdown    **best**, <u>second</u>, missing cells as an em dash
LaTeX       a snippet to \\input; needs booktabs, graphicx, subcaption and, for shading, xcolor with option table
"""

import csv
import io
import json
import re

from nbavatar.reporting.cells import COLUMNS, Cell, PanelTable, Table, plain

__all__ = ["to_csv", "to_latex", "to_markdown"]

_CSV = (
    "table", "panel", "block", "row", "column", "text", "value", "mark", "comparable", "shown", "source", "digest",
    "protocol_hash", "size", "note",
)  # fmt: skip
# Shrinks what is wider than the line and leaves the rest alone.
_FIT = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "—": "---", "×": r"$\times$",
}  # fmt: skip


def to_csv(table: Table) -> str:
    """Tidy csv, one line a cell, missing cells included."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_CSV)
    for panel in table.panels:
        for block in panel.blocks:
            for line in block.lines:
                for column in panel.columns:
                    cell = line.cells.get(column, Cell(text=""))
                    writer.writerow(
                        _csv_row(table, panel, block.kind, line.label, column, cell, block.comparable, True)
                    )
        comparable = all(block.comparable for block in panel.blocks)
        for kind, label, column, cell in panel.unseen:
            writer.writerow(_csv_row(table, panel, kind, label, column, cell, comparable, False))
    return stream.getvalue()


def _csv_row(
    table: Table, panel: PanelTable, kind: str, label: str, column: str, cell: Cell, comparable: bool, shown: bool
) -> list[str]:
    sources = cell.sources
    sizes = dict.fromkeys(f"{s.size[0]}x{s.size[1]}" for s in sources if s.size)
    return [
        table.name,
        panel.title,
        kind,
        plain(label),
        column,
        cell.text,
        "" if cell.value is None else repr(cell.value),
        cell.mark,
        "yes" if comparable else "no",
        "yes" if shown else "no",
        ";".join(source.path for source in sources),
        ";".join(source.digest for source in sources),
        ";".join(dict.fromkeys(source.protocol_hash for source in sources if source.protocol_hash)),
        ";".join(sizes),
        cell.note,
    ]


def to_markdown(table: Table) -> str:
    """Markdown with one table a panel, notes, and the list of sources."""
    parts = [f"## {table.title}", "", table.caption, ""]
    for panel in table.panels:
        if panel.title:
            parts += [f"### {panel.title}", ""]
        heads = [table.head, *(_heading(group, key) for group, keys in panel.groups for key in keys)]
        parts += [_md_row(heads), _md_row(["---", *(["---:"] * (len(heads) - 1))])]
        for block in panel.blocks:
            parts.append(_md_row([f"*{block.title}*", *([""] * (len(heads) - 1))]))
            for line in block.lines:
                cells = [line.cells.get(column, Cell()) for column in panel.columns]
                parts.append(_md_row([plain(line.label), *(_md_cell(cell) for cell in cells)]))
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


def _md_cell(cell: Cell) -> str:
    return {"best": f"**{cell.text}**", "second": f"<u>{cell.text}</u>"}.get(cell.mark, cell.text)


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
    for block in panel.blocks:
        if block is not panel.blocks[0]:
            lines.append("\\midrule")
        lines.append(f"\\multicolumn{{{span}}}{{l}}{{\\textit{{{_escape(block.title)}}}}} \\\\")
        for line in block.lines:
            if line.rule:
                lines.append(f"\\cmidrule(lr){{1-{span}}}")
            if line.shaded:
                lines.append("\\rowcolor{gray!20}")
            cells = [line.cells.get(column, Cell()) for column in panel.columns]
            lines.append(" & ".join([_latex_label(line.label), *(_latex_cell(cell) for cell in cells)]) + r" \\")
    return [*lines, "\\bottomrule", "\\end{tabular}"]


def _latex_cell(cell: Cell) -> str:
    text = _escape(cell.text)
    if re.fullmatch(r"[+-][0-9.]+", cell.text):
        text = f"${cell.text}$"
    return {"best": f"\\textbf{{{text}}}", "second": f"\\underline{{{text}}}"}.get(cell.mark, text)


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
    found = {
        (source.path, source.digest): None
        for panel in table.panels
        for block in panel.blocks
        for line in block.lines
        for cell in line.cells.values()
        for source in cell.sources
    }
    return list(found)
