"""One self-contained HTML page: tables, pictures, videos, plots, provenance. Text in, text out.

Nothing is fetched: styles, script and pictures are inside. Without JavaScript everything but the sliders works. Colours
follow the reader's light or dark setting; strips and tables scroll inside the page on narrow screens.
"""

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from nbavatar.reporting.curves import line_chart, training_curves
from nbavatar.reporting.markdown import markdown_to_html
from nbavatar.reporting.pareto import COSTS, QUALITIES, measured_variants, scatter_chart
from nbavatar.reporting.pictures import ERROR_MAX, RAMP

__all__ = ["Card", "Opening", "Strip", "curves_section", "opening_section", "page", "pictures_section"]
__all__ += ["pareto_section", "provenance_section", "strips_section", "tables_section", "videos_section"]


@dataclass(frozen=True)
class Card:
    """One column of a strip.

    Attributes:
        title: method.
        pictures: (data address, alternative text) from top to bottom.
        caption: figures.
        small: enlarge without smoothing.
        window: part of the first picture that the second one enlarges: x, y, width, height as shares of its sides.
    """

    title: str
    pictures: Sequence[tuple[str, str]]
    caption: str = ""
    small: bool = False
    window: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Strip:
    """One frame: truth first, then every method."""

    title: str
    cards: Sequence[Card]


@dataclass(frozen=True)
class Opening:
    """What the page opens with.

    Attributes:
        text: whose pictures and figures they are.
        cards: truth, render and error of one image.
        figures: (name, value, direction) of the metrics that matter.
        film: address of a turntable that the page plays; empty if there is none.
        small: enlarge the film without smoothing.
    """

    text: str
    cards: Sequence[Card]
    figures: Sequence[tuple[str, str, str]]
    film: str = ""
    small: bool = False


def opening_section(opening: Opening | None) -> str:
    """A strip that is understood at a glance; empty if there is nothing to show."""
    if opening is None:
        return ""
    shots = [_card(card, f"opening-{i}") for i, card in enumerate(opening.cards)]
    if opening.film:
        small = ' class="small"' if opening.small else ""
        film = f'<video{small} autoplay loop muted playsinline controls src="{opening.film}" aria-label="turntable">'
        caption = "<figcaption><b>Turntable</b><br>one pose, seen around</figcaption>"
        shots.append(f"<figure>{caption}{film}</video></figure>")
    values = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{value}</dd><dd>{html.escape(direction)}</dd></div>"
        for name, value, direction in opening.figures
    )
    figures = f"<dl>{values}</dl>" if values else ""
    strip = f'<div class="shots">{"".join(shots)}</div>'
    return f'<section id="opening">\n{strip}\n{figures}\n<p>{html.escape(opening.text)}</p>\n</section>'


def tables_section(tables: Mapping[str, tuple[str, str]]) -> str:
    """Tables from their Markdown, each with its csv to download.

    Args:
        tables: name -> (Markdown, csv); either may be empty.
    """
    parts = []
    for name, (markdown, table) in tables.items():
        body = markdown_to_html(markdown)
        if table:
            address = "data:text/csv;base64," + base64.b64encode(table.encode()).decode("ascii")
            link = f'<a download="{_safe(name)}.csv" href="{address}">{_safe(name)}.csv</a>'
            body += f"\n<p>{link}: all digits, and for the tables of the paper the source of every cell</p>"
        parts.append(f'<section id="table-{_safe(name)}">\n{body}\n</section>')
    return "\n".join(parts)


def strips_section(strips: Mapping[str, Sequence[Strip]]) -> str:
    """Comparison pictures, by heading; the first strip of each heading also gets a slider."""
    if not strips:
        return "<p>No renders were given.</p>"
    ramp = ", ".join(f"rgb{colour}" for colour in RAMP)
    parts = [
        f'<p class="ramp"><span>error 0</span><i style="background: linear-gradient(90deg, {ramp})"></i>'
        f"<span>{ERROR_MAX:g} and more (mean over RGB of |render - truth|, sRGB in [0, 1])</span></p>"
    ]
    number = 0
    for heading, group in strips.items():
        parts.append(f"<h3>{html.escape(heading)}</h3>")
        for i, strip in enumerate(group):
            cards = []
            identities = []
            for card in strip.cards:
                number += 1
                cards.append(_card(card, f"picture-{number}"))
                identities.append((f"picture-{number}", card.title))
            if i == 0 and len(identities) > 1:
                parts.append(_slider(identities, strip))
            parts.append(f"<h4>{html.escape(strip.title)}</h4>")
            parts.append(f'<div class="strip" tabindex="0" role="region" aria-label="{_safe(strip.title)}">')
            parts += [*cards, "</div>"]
    return "\n".join(parts)


def _card(card: Card, identity: str) -> str:
    small = ' class="small"' if card.small else ""
    images = []
    for i, (address, text) in enumerate(card.pictures):
        own = f' id="{identity}"' if i == 0 else ""
        image = f'<img{small} src="{address}" alt="{_safe(text)}"{own}>'
        if i == 0 and card.window is not None:
            names = ("left", "top", "width", "height")
            place = ";".join(f"{n}:{100 * v:.2f}%" for n, v in zip(names, card.window, strict=True))
            image = f'<div class="shot">{image}<i style="{place}"></i></div>'
        images.append(image)
    caption = f"<b>{html.escape(card.title)}</b>" + (f"<br>{html.escape(card.caption)}" if card.caption else "")
    return f"<figure><figcaption>{caption}</figcaption>{''.join(images)}</figure>"


def _slider(pictures: Sequence[tuple[str, str]], strip: Strip) -> str:
    """Two pictures on top of each other; further ones are taken from the strip when the reader chooses them."""
    left, right = 0, 1

    def choice(side: str, chosen: int) -> str:
        options = "".join(
            f'<option value="{identity}"{" selected" if i == chosen else ""}>{html.escape(name)}</option>'
            for i, (identity, name) in enumerate(pictures)
        )
        return f'<select data-side="{side}" aria-label="{side} picture">{options}</select>'

    first, second = strip.cards[left].pictures[0], strip.cards[right].pictures[0]
    small = ' class="small"' if strip.cards[left].small else ""
    under = "under small" if strip.cards[left].small else "under"
    return (
        '<div class="slider"><div class="stack">'
        f'<img class="{under}" src="{second[0]}" alt="{_safe(second[1])}">'
        f'<div class="over"><img{small} src="{first[0]}" alt="{_safe(first[1])}"></div><div class="bar"></div></div>'
        '<input type="range" min="0" max="100" value="50" aria-label="share of the left picture [%]">'
        f'<div class="ends">{choice("left", left)}{choice("right", right)}</div></div>'
    )


def curves_section(histories: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Training curves: one chart a logged quantity, one line an avatar.

    Args:
        histories: avatar -> logged lines, each with ``step`` and numbers.
    """
    charts = [
        line_chart(curve.title, curve.series, x_label="step", y_label=curve.y_label, log_y=curve.log_y)
        for curve in training_curves(histories)
    ]
    charts = [chart for chart in charts if chart]
    if not charts:
        return "<p>No training history was given.</p>"
    return '<div class="charts">\n' + "\n".join(f"<div>{chart}</div>" for chart in charts) + "\n</div>"


def pareto_section(evals: Sequence[Mapping[str, Any]], speeds: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Quality against time, memory and bytes, protocol by protocol; empty without a variant that has both.

    Args:
        evals: results of ``nbavatar evaluate``.
        speeds: (variant, result of ``nbavatar speed``).
    """
    parts = []
    for protocol in dict.fromkeys(str(result["protocol"]["name"]) for result in evals):
        measured = measured_variants(evals, speeds, protocol)
        charts = [scatter_chart(measured, cost, quality) for quality in QUALITIES for cost in COSTS]
        charts = [chart for chart in charts if chart]
        if charts and len(measured) > 1:
            devices = sorted({str(result.get("device", "")) for _, result in speeds} - {""})
            parts.append(f"<h3>{html.escape(protocol)}</h3>")
            parts.append(
                f"<p>Timed on {html.escape('; '.join(devices) or 'a device that is not named')}. The line joins the "
                "variants that no other beats in both.</p>"
            )
            parts.append('<div class="charts">\n' + "\n".join(f"<div>{chart}</div>" for chart in charts) + "\n</div>")
    return "\n".join(parts)


def videos_section(videos: Sequence[tuple[str, str, bool]]) -> str:
    """Videos: (title, address, whether it can be played from the page)."""
    parts = []
    for title, address, embedded in videos:
        text = html.escape(title)
        if embedded:
            player = "<video controls loop muted playsinline preload=metadata"
            player += f' src="{address}" aria-label="{_safe(title)}"></video>'
            parts.append(f"<figure>{player}<figcaption>{text}</figcaption></figure>")
        else:
            parts.append(f'<p><a href="{_safe(address)}">{text}</a> (a file beside this page)</p>')
    return '<div class="videos">\n' + "\n".join(parts) + "\n</div>" if parts else ""


def pictures_section(pictures: Sequence[tuple[str, str, str]]) -> str:
    """Further pictures, full width: (title, data address, alternative text)."""
    return "\n".join(
        f'<figure class="wide"><img src="{address}" alt="{_safe(text)}">'
        f"<figcaption>{html.escape(title)}</figcaption></figure>"
        for title, address, text in pictures
    )


def provenance_section(results: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Where every result comes from.

    Args:
        results: (file, content with a run record under ``record`` or at the top).
    """
    if not results:
        return "<p>No results were given.</p>"
    heads = ("result", "code", "commit", "device", "protocol", "frames", "images")
    rows, details = [], []
    for path, content in results:
        record = content.get("record") or content
        git = record.get("git") or {}
        commit = str(git.get("commit") or "")[:10] + (" (edited)" if git.get("dirty") else "")
        values = (
            record.get("code", ""),
            commit,
            record.get("device", ""),
            content.get("protocol_hash", ""),
            content.get("frames", ""),
            content.get("count", ""),
        )
        cells = "".join(f"<td>{html.escape(str(value))}</td>" for value in values)
        rows.append(f'<tr><th scope="row">{html.escape(path)}</th>{cells}</tr>')
        text = json.dumps(
            {k: record.get(k) for k in ("config", "inputs", "versions", "seed")}, indent=1, sort_keys=True
        )
        details.append(f"<details><summary>{html.escape(path)}</summary><pre>{html.escape(text)}</pre></details>")
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    table = (
        f'<div class="scroll" tabindex="0" role="region" aria-label="provenance"><table><thead><tr>{head}</tr></thead>'
    )
    return table + f"<tbody>{''.join(rows)}</tbody></table></div>" + "\n".join(details)


def page(title: str, label: str, sections: Sequence[tuple[str, str, str]], opening: Opening | None = None) -> str:
    """The whole page.

    Args:
        title: heading of the page.
        label: a warning shown at its top, such as that sizes are not the paper's; may be empty.
        sections: (id, heading, HTML) in order; sections without content are left out.
        opening: what stands before them.
    """
    here = files("nbavatar.reporting")
    style = here.joinpath("page.css").read_text(encoding="utf-8")
    script = here.joinpath("page.js").read_text(encoding="utf-8")
    kept = [section for section in sections if section[2]]
    links = "".join(f'<a href="#{identity}">{html.escape(heading)}</a>' for identity, heading, _ in kept)
    body = "\n".join(f'<section id="{i}">\n<h2>{html.escape(h)}</h2>\n{content}\n</section>' for i, h, content in kept)
    warning = f'<p class="label">{html.escape(label)}: not comparable with the paper\'s figures.</p>' if label else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<h1>{html.escape(title)}</h1>\n{warning}\n{opening_section(opening)}\n<nav>{links}</nav>\n<main>\n{body}\n</main>\n"
        f"<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _safe(text: str) -> str:
    return html.escape(re.sub(r"\s+", " ", text), quote=True)
