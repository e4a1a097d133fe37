"""Turns the Markdown that this package writes into HTML: headings, tables, lists, emphasis. Not a general converter."""

import html
import re
from collections.abc import Iterator

__all__ = ["markdown_to_html"]


def markdown_to_html(text: str) -> str:
    """HTML of a table's Markdown (see ``nbavatar.reporting.formats``).

    Headings move down one level, so that they nest under a section of the page. A row with text in its first cell only
    becomes a heading of the rows below it. Comments are dropped; lists after ``Sources:`` fold away.
    """
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    return "\n".join(_blocks(text.splitlines()))


def _blocks(lines: list[str]) -> Iterator[str]:
    position = 0
    while position < len(lines):
        line = lines[position]
        heading = re.fullmatch(r"(#+) (.*)", line)
        if heading:
            level = min(len(heading.group(1)) + 1, 6)
            yield f"<h{level}>{_inline(heading.group(2))}</h{level}>"
            position += 1
        elif line.startswith("|"):
            end = _end_of(lines, position, "|")
            yield from _table(lines[position:end])
            position = end
        elif line.startswith("- "):
            end = _end_of(lines, position, "- ")
            yield '<ul class="notes">'
            yield from (f"<li>{_inline(item[2:])}</li>" for item in lines[position:end])
            yield "</ul>"
            position = end
        elif line == "Sources:":
            start = position + 2
            end = _end_of(lines, start, "- ")
            yield "<details><summary>Sources</summary><ul>"
            yield from (f"<li>{_inline(item[2:])}</li>" for item in lines[start:end])
            yield "</ul></details>"
            position = end
        else:
            if line.strip():
                yield f"<p>{_inline(line)}</p>"
            position += 1


def _end_of(lines: list[str], start: int, prefix: str) -> int:
    end = start
    while end < len(lines) and lines[end].startswith(prefix):
        end += 1
    return end


def _cells(line: str) -> list[str]:
    return [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def _table(lines: list[str]) -> Iterator[str]:
    head = _cells(lines[0])
    yield '<div class="scroll" tabindex="0" role="region" aria-label="table"><table><thead><tr>'
    yield "".join(f'<th scope="col">{_inline(cell)}</th>' for cell in head)
    yield "</tr></thead><tbody>"
    for line in lines[2:]:
        cells = _cells(line)
        if len(cells) > 1 and not any(cells[1:]):
            title = f"<span>{_inline(cells[0])}</span>"
            yield f'<tr class="block"><th colspan="{len(head)}" scope="rowgroup">{title}</th></tr>'
            continue
        body = "".join(f"<td>{_inline(cell)}</td>" for cell in cells[1:])
        yield f'<tr><th scope="row">{_inline(cells[0])}</th>{body}</tr>'
    yield "</tbody></table></div>"


def _inline(text: str) -> str:
    text = html.escape(text, quote=False)
    text = text.replace("&lt;u&gt;", "<u>").replace("&lt;/u&gt;", "</u>")
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    text = re.sub(r"`(.+?)`", r"<code>\1</code>", text)
    return re.sub(r"\*(.+?)\*", r"<i>\1</i>", text)
