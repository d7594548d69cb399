"""A chart as an ``<svg>`` element of a page: words as words, symbols slanted, colours as CSS variables.

The entries of a legend carry the label of their marks: with the page's script they are switched on and off, and a panel
says where the pointer is. One coordinate in ten of a point is kept. Lines of more points than can be seen are thinned
to the extremes of each part and dots on the same spot are drawn once, so that 10⁵ readings make no page of megabytes.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape

from en4dvar.model.state import Array
from en4dvar.plumbing.files import make_folder
from en4dvar.report.chart import COLUMN, Chart, Mark, Panel, Row
from en4dvar.report.paper import save_chart
from en4dvar.report.text import pieces

GAP = 6.0  # between panels
SPACE = 3.0  # between their numbers below
FONT, SMALL = 8.0, 7.0
EM = 0.56  # width of a character on average, of its height
WIDEST = 0.64  # the same of digits and small letters in the widest of the usual fonts (DejaVu Sans, Verdana)
SHOWN = 2000  # points of a line
Captioned = tuple[str, str, Chart]  # name, caption
Drawing = tuple[str, str, Markup]  # name, caption, SVG


@dataclass(frozen=True)
class Frame:
    """Where a panel lies in the drawing, and how its numbers become points of it."""

    x: float
    y: float
    width: float
    height: float
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    logarithmic: bool = False
    x_logarithmic: bool = False

    def across(self, values: Array) -> Array:
        return self.x + self.width * _share(values, self.xlim, self.x_logarithmic)

    def up(self, values: Array) -> Array:
        return self.y + self.height * (1 - _share(values, self.ylim, self.logarithmic))


def _share(values: Array, limits: tuple[float, float], logarithmic: bool) -> Array:
    low, high = limits
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(values / low) / math.log(high / low) if logarithmic else (values - low) / (high - low)
    return np.asarray(share)


def svg(chart: Chart, name: str, description: str) -> Markup:
    """The drawing; its identifiers begin with ``name``, ``description`` is what a screen reader says."""
    parts, top = [], 0.0
    margins: dict[tuple[int, int], float] = {}  # of (panels of the row, place in it), one for the first of all rows
    for row in chart.rows:
        for j, panel in enumerate(row.panels):
            key = (len(row.panels) if j else 0, j)
            margins[key] = max(margins.get(key, 0.0), _left(panel))
    for row, (_, room) in zip(chart.rows, _laid(chart, margins), strict=True):
        for j, (panel, following) in enumerate(pairwise(row.panels), 1):
            between = _beyond(panel, room)[1] + _beyond(following, room)[0] + SPACE - GAP
            margins[len(row.panels), j] = max(margins[len(row.panels), j], min(between, room / 2))
    laid = _laid(chart, margins)
    ends = [_beyond(row.panels[-1], room)[1] for row, (_, room) in zip(chart.rows, laid, strict=True)]
    for i, (row, (lefts, room)) in enumerate(zip(chart.rows, laid, strict=True)):
        x, width = 0.0, room - (max(GAP, *ends) - GAP) / len(lefts)
        for j, (panel, left) in enumerate(zip(row.panels, lefts, strict=True)):
            parts += _panel(panel, row, top, x + left, width, f"{name}-{i}-{j}")
            x += left + width + GAP
        top += row.height
    wide = ' class="wide"' if chart.width > COLUMN else ""
    head = (
        f'<svg{wide} role="img" aria-label="{escape(description)}" viewBox="0 0 {chart.width:.5g} {chart.height:.5g}" '
        f'font-size="{SMALL:g}" color="var(--ink)" fill="currentColor" stroke-linejoin="round">'
    )
    return Markup(f"{head}{''.join(parts)}</svg>")


def _laid(chart: Chart, margins: dict[tuple[int, int], float]) -> list[tuple[list[float], float]]:
    """Of each row: what is left of its panels, and the width of each."""
    rows = [[margins[len(row.panels) if j else 0, j] for j in range(len(row.panels))] for row in chart.rows]
    return [(lefts, (chart.width - sum(lefts) - len(lefts) * GAP) / len(lefts)) for lefts in rows]


def _beyond(panel: Panel, width: float) -> tuple[float, float]:
    """Points that the numbers below reach beyond an axis of ``width``, on its left and on its right."""
    if panel.bare or panel.names or not panel.x_numbers:
        return 0.0, 0.0
    axis = Frame(0, 0, width, 0, *panel.limits(), panel.logarithmic, panel.x_logarithmic)
    placed = [(x, len(text) * WIDEST * SMALL / 2) for x, text in _placed(panel.x_ticks(), axis.across)]
    beyond = [(half - x, x + half - width) for x, half in placed] or [(0.0, 0.0)]
    return max(left for left, _ in beyond), max(right for _, right in beyond)


def _left(panel: Panel) -> float:
    """Points that the labels on the left need."""
    if panel.bare or not panel.left:
        return 8.0 if panel.x_numbers and not panel.bare else 2.0  # half a number below the corner
    labels = [text for _, text in panel.y_ticks()] if panel.y_numbers else []
    widest = max(map(len, labels), default=0) * WIDEST * SMALL
    return widest + 4.5 + (FONT + 5 if panel.ylabel else 0)


def _panel(panel: Panel, row: Row, top: float, x: float, width: float, name: str) -> list[str]:
    legend, above = _legend(panel, x, top, width)
    above += max((len(p.title.splitlines()) for p in row.panels), default=0) * (FONT + 2) + 4
    below = max((_below(p) for p in row.panels), default=0.0)
    height = row.height - above - below
    place = Frame(x, top + above, width, height, *panel.limits(), panel.logarithmic, panel.x_logarithmic)
    drawn = "".join(path_of(mark, place) for mark in panel.marks)
    if panel.bare:
        words = written(panel.words, x + width / 2, place.y + place.height / 2 + 3, size=FONT)
        return [f'<g fill="none">{drawn}</g>', words] if panel.words else []
    lines = "".join(f"M{place.x:.1f} {y:.1f}h{place.width:.1f}" for y, _ in _placed(panel.y_ticks(), place.up))
    box = f'x="{place.x:.1f}" y="{place.y:.1f}" width="{place.width:.1f}" height="{place.height:.1f}"'
    (x0, x1), (y0, y1) = place.xlim, place.ylim
    scales = f"{' data-log' * panel.logarithmic}{' data-xlog' * panel.x_logarithmic}"
    reading = f'data-x="{x0:.7g} {x1:.7g}" data-y="{y0:.7g} {y1:.7g}"{scales}'
    return [
        *legend,
        f'<clipPath id="{name}"><rect {box}/></clipPath>',
        *([f'<path d="{lines}" stroke="var(--grid)" stroke-width="0.5"/>'] if panel.grid else ()),
        f'<g clip-path="url(#{name})" fill="none">{drawn}</g>',
        *_axes(panel, place, below),
        *(
            written(line, x + width / 2, place.y - 4 - i * (FONT + 2), size=FONT, colour=panel.title_colour)
            for i, line in enumerate(reversed(panel.title.splitlines()))
        ),
        f'<rect class="read" {box} fill="none" pointer-events="all" {reading}/>',
    ]


def _below(panel: Panel) -> float:
    """Points that the labels below need."""
    if panel.bare:
        return 2.0
    under = max((len(t) for t in panel.names), default=0) * WIDEST * SMALL + 6 if panel.names else SMALL + 4
    return (under if panel.x_numbers and panel.xticks != () else 3.0) + (FONT + 4 if panel.xlabel else 0)


def _axes(panel: Panel, place: Frame, below: float) -> Iterator[str]:
    base, left, far = place.y + place.height, place.x, place.x + place.width
    lines, words = [f"M{left:.1f} {base:.1f}H{far:.1f}"], []
    for x, text in _placed(panel.x_ticks(), place.across):
        lines.append(f"M{x:.1f} {base:.1f}v2.5")
        if panel.names:
            words.append(written(text, 0, 0, "end", turned=(x + 2.3, base + 4)))
        elif panel.x_numbers:
            words.append(written(text, x, base + SMALL + 3))
    if panel.left:
        lines.append(f"M{left:.1f} {place.y:.1f}V{base:.1f}")
        for y, text in _placed(panel.y_ticks(), place.up):
            lines.append(f"M{left:.1f} {y:.1f}h-2.5")
            words.append(written(text, left - 4, y + 2.5, "end") if panel.y_numbers else "")
    yield f'<path d="{"".join(lines)}" stroke="var(--muted)" stroke-width="0.6" fill="none"/>'
    yield from words
    yield written(panel.xlabel, place.x + place.width / 2, base + below - 3, size=FONT)
    across = left - _left(panel) + FONT - 1
    yield written(panel.ylabel, 0, 0, size=FONT, turned=(across, place.y + place.height / 2))


def _placed(ticks: list[tuple[float, str]], along: Callable[[Array], Array]) -> Iterator[tuple[float, str]]:
    return zip(along(np.array([value for value, _ in ticks])).tolist(), (text for _, text in ticks), strict=True)


def _legend(panel: Panel, x: float, top: float, width: float) -> tuple[list[str], float]:
    """The entries above a panel, and the height they take."""
    parts, at, line = [], x, top
    for label in panel.entries():
        marks = [m for m in panel.marks if m.label == label]
        length = 15 + EM * SMALL * sum(len(piece) for _, piece in pieces(label))  # the text takes this, about
        if at > x and at + length > x + width:
            at, line = x, line + SMALL + 4
        sample = Frame(at, line + 2, 11, SMALL, (0, 1), (0, 1))
        drawn = "".join(path_of(_sample(m), sample) for m in marks)
        parts.append(
            f'<g class="entry" data-label="{escape(label)}"><g fill="none">{drawn}</g>'
            f"{written(label, at + 14, line + SMALL + 1, 'start')}</g>"
        )
        at += length + 8
    return parts, line - top + SMALL + 6 if parts else 0.0


def _sample(mark: Mark) -> Mark:
    """The mark as its legend shows it, in a unit square."""
    ends, middle = np.array([0.0, 1.0]), np.array([0.5])
    none = np.empty(0)
    x, y, top = {"line": (ends, middle.repeat(2), none), "band": (ends, ends * 0, ends * 0 + 1)}.get(
        mark.kind, (middle, middle * 0, middle * 2) if mark.top.size else (middle, middle, none)
    )
    return Mark(mark.kind, x, y, top, mark.colour, mark.size, mark.alpha, mark.dash)


def written(
    text: str, x: float, y: float, anchor: str = "middle", size: float = SMALL, colour: str = "ink",
    turned: tuple[float, float] | None = None,
) -> str:  # fmt: skip
    """A line of text; ``turned``: upright, about this point."""
    if not text:
        return ""
    at = f'transform="translate({turned[0]:.1f} {turned[1]:.1f}) rotate(-90)"' if turned else f'x="{x:.1f}" y="{y:.1f}"'
    shade = f' color="var(--{colour})"' if colour != "ink" else ""
    return f'<text {at} text-anchor="{anchor}" font-size="{size:g}"{shade}>{_spans(text, size)}</text>'


def _spans(text: str, size: float) -> str:
    """Text with symbols: letters slanted, indices small and shifted."""
    parts, shift = [], 0.0
    for mark, piece in pieces(text):
        wanted = {"_": 0.22, "^": -0.4}.get(mark, 0.0) * size
        dy = f' dy="{wanted - shift:.2g}"' if wanted != shift else ""
        small = f' font-size="{0.72 * size:.3g}"' if mark in "_^" and mark else ""
        slant = ' font-style="italic"' if mark == "i" else ""
        how = f"{dy}{small}{slant}"
        parts.append(f"<tspan{how}>{escape(piece)}</tspan>" if how else str(escape(piece)))
        shift = wanted
    return "".join(parts)


def draw(
    figures: Iterable[Captioned], identifiers: str = "", folder: Path | None = None, begin: str = ""
) -> list[Drawing]:
    """Each chart as SVG, its identifiers begin with ``identifiers``; in a ``folder`` also as PDF and PNG, under names
    with ``begin``. Raises :class:`OutputError`.
    """
    drawings = []
    for name, caption, chart in figures:
        if folder is not None:
            save_chart(chart, make_folder(folder), f"{begin}{name}")
        drawings.append((name, caption, svg(chart, f"{identifiers}{name}", caption)))
    return drawings


def path_of(mark: Mark, place: Frame) -> str:
    colour = mark.colour if mark.colour.startswith("#") else f"var(--{mark.colour})"
    alpha = f' opacity="{mark.alpha:g}"' if mark.alpha < 1 else ""
    x, y, top = place.across(mark.x), place.up(mark.y), place.up(mark.top)
    far, base = place.x + place.width, place.y + place.height
    filled = mark.kind in ("band", "span", "tiles")
    if mark.kind == "line":
        edges = "".join(_line(*_thinned(u, v)) for u, v in _unbroken(x, y))
    elif mark.kind == "band":
        seen = np.isfinite(x) & np.isfinite(y) & np.isfinite(top)
        (u, v), (w, z) = _thinned(x[seen], y[seen]), _thinned(x[seen], top[seen])
        edges = _line(np.concatenate([u, w[::-1]]), np.concatenate([v, z[::-1]])) + "z" if len(u) else ""
    elif mark.kind == "span":
        edges = f"M{place.x:.1f} {y[0]:.1f}H{far:.1f}V{top[0]:.1f}H{place.x:.1f}z"
    elif mark.kind == "tiles":
        # Rectangles, a little larger than they are, so that no line shows between them
        width = place.width * mark.top[0] / abs(place.xlim[1] - place.xlim[0]) + 0.1
        height = place.height * mark.top[1] / abs(place.ylim[1] - place.ylim[0]) + 0.1
        stroke = f"h{width:.2f}v{height:.2f}h-{width:.2f}z"
        edges = _each(x - width / 2, y - height / 2, [stroke] * len(x))
    elif mark.kind == "bars":
        seen = np.isfinite(x) & np.isfinite(y) & np.isfinite(top)
        edges = _each(x[seen], y[seen], [f"V{t:.1f}" for t in top[seen]])
    elif mark.kind == "rule":
        edges = f"M{place.x:.1f} {y[0]:.1f}H{far:.1f}"
    elif mark.kind == "upright":
        edges = f"M{x[0]:.1f} {base:.1f}V{base - 0.85 * place.height:.1f}"
    else:
        edges = _each(*_spots(x, y, mark))
    if not edges:
        return ""
    ends = {"": "", "--": ' stroke-dasharray="3.7 1.6"', ":": ' stroke-dasharray="1 1.6"'}[mark.dash]
    ends += ' stroke-linecap="round"' if mark.kind == "dots" else ""
    label = f' data-label="{escape(mark.label)}"' if mark.label else ""
    how = f'fill="{colour}"' if filled else f'stroke="{colour}" stroke-width="{mark.stroke:g}"{ends}'
    crisp = ' shape-rendering="crispEdges"' if mark.kind == "tiles" else ""
    return f'<path d="{edges}" {how}{alpha}{label}{crisp}/>'


def _spots(x: Array, y: Array, mark: Mark) -> tuple[Array, Array, list[str]]:
    """Where dots are drawn, each spot once, and what is drawn there."""
    seen = np.isfinite(x) & np.isfinite(y)
    spots: Array = np.unique(np.round(np.column_stack([x[seen], y[seen]]), 1), axis=0)
    r, size = f"{mark.size / 2:g}", f"{mark.size:g}"
    ring = f"m-{r} 0a{r} {r} 0 1 0 {size} 0a{r} {r} 0 1 0-{size} 0"
    stroke = {"dots": "h0", "ticks": f"m0 {r}v-{size}", "dashes": f"m-{r} 0h{size}", "rings": ring}[mark.kind]
    return spots[:, 0], spots[:, 1], [stroke] * len(spots)


def _each(x: Array, y: Array, strokes: Sequence[str]) -> str:
    return "".join(f"M{u:.1f} {v:.1f}{stroke}" for u, v, stroke in zip(x, y, strokes, strict=True))


def _line(x: Array, y: Array) -> str:
    return "".join(f"{'L' if i else 'M'}{u:.1f} {v:.1f}" for i, (u, v) in enumerate(zip(x, y, strict=True)))


def _unbroken(x: Array, y: Array) -> Iterator[tuple[Array, Array]]:
    """The parts of a line between its gaps, where it is not finite."""
    there = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.pad(there, 1).astype(int)))
    return ((x[begin:end], y[begin:end]) for begin, end in edges.reshape(-1, 2))


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most :data:`SHOWN` finite points: of each part of many points the least and the greatest."""
    if len(x) <= SHOWN:
        return x, y
    parts = np.array_split(np.arange(len(x)), SHOWN // 2)
    order = sorted({int(part[place(y[part])]) for part in parts for place in (np.argmin, np.argmax)})
    return x[order], y[order]
