"""A chart as an ``<svg>`` element of a page: words as words, colours as CSS variables, no addresses.

One coordinate in ten of a point is kept. Lines of more points than can be seen are thinned to the extremes of each
column of pixels and dots on the same spot are drawn once, so that 10⁵ readings make no page of megabytes. The entries
of a legend carry the label of their marks: with the page's script they are switched on and off.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup, escape

from en4dvar.report.chart import Chart, Mark, Panel, Row
from en4dvar.report.text import math_pieces, plain_number
from en4dvar.state import Array

FONT, SMALL = 8.0, 7.0
EM = 0.56  # width of a character on average, of its height
GAP = 6.0  # between panels
SHOWN = 2000  # points of a line


@dataclass(frozen=True)
class Frame:
    """Where a panel lies in the drawing, and how its numbers become points of it."""

    x: float
    y: float
    width: float
    height: float
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    logarithmic: bool

    def across(self, values: Array) -> Array:
        low, high = self.xlim
        return self.x + self.width * (np.asarray(values, dtype=float) - low) / (high - low)

    def up(self, values: Array) -> Array:
        low, high = self.ylim
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.log(values / low) / math.log(high / low) if self.logarithmic else (values - low) / (high - low)
        return np.asarray(self.y + self.height * (1 - share))


def svg(chart: Chart, name: str, description: str) -> Markup:
    """The drawing; its identifiers begin with ``name``, ``description`` is what a screen reader says."""
    parts, top = [], 0.0
    margins = _left_margins(chart)
    for i, row in enumerate(chart.rows):
        for j, (panel, x, width) in enumerate(_columns(row, margins, chart.width)):
            parts += _panel(panel, row, top, x, width, f"{name}-{i}-{j}")
        top += row.height
    head = (
        f'<svg role="img" aria-label="{escape(description)}" viewBox="0 0 {chart.width:.5g} {chart.height:.5g}" '
        f'font-size="{SMALL:g}" color="var(--ink)" fill="currentColor" stroke-linejoin="round">'
    )
    return Markup(f"{head}{''.join(parts)}</svg>")


def ticks(low: float, high: float, wanted: int | Sequence[float], whole: bool = False) -> list[float]:
    """Round numbers between two limits: at most ``wanted`` intervals, or the given ones."""
    if not isinstance(wanted, int):
        return [float(t) for t in wanted]
    rough = (high - low) / max(wanted, 1)
    if not (rough > 0 and math.isfinite(rough)):
        return [low]
    scale = 10.0 ** math.floor(math.log10(rough))
    step = next(s * scale for s in (1, 2, 2.5, 5, 10) if s * scale >= rough * (1 - 1e-9))
    step = max(1.0, float(math.ceil(step))) if whole else step
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def powers(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 3), (1, 2, 5)):
        found = [f * 10.0**k for k in exponents for f in factors if low <= f * 10.0**k <= high]
        if len(found) > 2:
            break
    return found[:: max(1, len(found) // 6)]


def numbers(values: Sequence[float]) -> list[str]:
    """Ticks as text, all with the same decimals."""
    size = max(map(abs, values), default=0.0)
    step = min((abs(b - a) for a, b in pairwise(values)), default=size)
    if (size and not 1e-3 <= size < 1e5) or step <= 0:
        return [plain_number(v, 3) for v in values]
    places = next((n for n in range(7) if all(abs(v - round(v, n)) < 1e-6 * step for v in values)), 7)
    return [f"{v:.{places}f}".replace("-", "−") if round(v, places) else "0" for v in values]


def _y_ticks(panel: Panel) -> list[float]:
    low, high = panel.limits()[1]
    wanted = panel.yticks
    found = powers(low, high) if panel.logarithmic and isinstance(wanted, int) else ticks(low, high, wanted)
    return [t for t in found if low <= t <= high or math.isclose(t, low) or math.isclose(t, high)]


def _y_labels(panel: Panel) -> list[str]:
    found = _y_ticks(panel)
    return [plain_number(t, 3) for t in found] if panel.logarithmic else numbers(found)


def _left(panel: Panel) -> float:
    """Points that the labels on the left need."""
    if panel.bare or not panel.left:
        return 8.0 if panel.x_numbers and not panel.bare else 2.0  # half a number below the corner
    labels = _y_labels(panel) if panel.y_numbers else []
    widest = max((len(t) for t in labels), default=0) * EM * SMALL
    return widest + 4.5 + (FONT + 5 if panel.ylabel else 0)


def _left_margins(chart: Chart) -> dict[tuple[int, int], float]:
    """(panels of the row, place in it) → margin; the first places of all rows have one."""
    found: dict[tuple[int, int], float] = {}
    for row in chart.rows:
        for j, panel in enumerate(row.panels):
            key = (len(row.panels) if j else 0, j)
            found[key] = max(found.get(key, 0.0), _left(panel))
    return found


def _columns(row: Row, margins: dict[tuple[int, int], float], width: float) -> Iterator[tuple[Panel, float, float]]:
    """Each panel, where its frame begins and how wide it is."""
    n = len(row.panels)
    lefts = [margins[n if j else 0, j] for j in range(n)]
    each, x = (width - sum(lefts) - n * GAP) / n, 0.0
    for panel, left in zip(row.panels, lefts, strict=True):
        yield panel, x + left, each
        x += left + each + GAP


def _panel(panel: Panel, row: Row, top: float, x: float, width: float, name: str) -> list[str]:
    legend, above = _legend(panel, x, top, width)
    above += FONT + 4 if any(p.title for p in row.panels) else 4
    below = max((_below(p) for p in row.panels), default=0.0)
    place = Frame(x, top + above, width, row.height - above - below, *panel.limits(), panel.logarithmic)
    if panel.bare:
        return [_words(panel.words, x + width / 2, place.y + place.height / 2 + 3, size=FONT)] if panel.words else []
    box = f'x="{place.x:.1f}" y="{place.y:.1f}" width="{place.width:.1f}" height="{place.height:.1f}"'
    drawn = "".join(_mark(mark, place) for mark in panel.marks)
    (x0, x1), (y0, y1) = place.xlim, place.ylim
    reading = f'data-x="{x0:.7g} {x1:.7g}" data-y="{y0:.7g} {y1:.7g}"{" data-log" if panel.logarithmic else ""}'
    return [
        *legend,
        f'<clipPath id="{name}"><rect {box}/></clipPath>',
        *(_grid(panel, place) if panel.grid else ()),
        f'<g clip-path="url(#{name})" fill="none">{drawn}</g>',
        *_axes(panel, place, below),
        _words(panel.title, x + width / 2, place.y - 4, size=FONT, colour=panel.title_colour),
        f'<rect class="read" {box} fill="none" pointer-events="all" {reading}/>',
    ]


def _below(panel: Panel) -> float:
    """Points that the labels below need."""
    if panel.bare:
        return 2.0
    under = max((len(t) for t in panel.names), default=0) * EM * SMALL + 4 if panel.names else SMALL + 4
    return (under if panel.x_numbers and panel.xticks != () else 3.0) + (FONT + 4 if panel.xlabel else 0)


def _axes(panel: Panel, place: Frame, below: float) -> Iterator[str]:
    """Lines, ticks, numbers and labels."""
    base, left, far = place.y + place.height, place.x, place.x + place.width
    low, high = place.xlim
    along = [t for t in ticks(low, high, panel.xticks, panel.whole) if low <= t <= high]
    lines, words = [f"M{left:.1f} {base:.1f}H{far:.1f}"], []
    texts = panel.names or numbers(along)
    for x, text in zip(place.across(np.array(along)), texts, strict=True):
        lines.append(f"M{x:.1f} {base:.1f}v2.5")
        if panel.names:
            words.append(_words(text, 0, 0, "end", turned=(x + 2.3, base + 4)))
        elif panel.x_numbers:
            words.append(_words(text, x, base + SMALL + 3))
    if panel.left:
        lines.append(f"M{left:.1f} {place.y:.1f}V{base:.1f}")
        for y, text in zip(place.up(np.array(_y_ticks(panel))), _y_labels(panel), strict=True):
            lines.append(f"M{left:.1f} {y:.1f}h-2.5")
            words.append(_words(text, left - 4, y + 2.5, "end") if panel.y_numbers else "")
    yield f'<path d="{"".join(lines)}" stroke="var(--muted)" stroke-width="0.6" fill="none"/>'
    yield from words
    yield _words(panel.xlabel, place.x + place.width / 2, base + below - 3, size=FONT)
    across = left - _left(panel) + FONT - 1
    yield _words(panel.ylabel, 0, 0, size=FONT, turned=(across, place.y + place.height / 2))


def _grid(panel: Panel, place: Frame) -> Iterator[str]:
    lines = "".join(f"M{place.x:.1f} {y:.1f}h{place.width:.1f}" for y in place.up(np.array(_y_ticks(panel))))
    yield f'<path d="{lines}" stroke="var(--grid)" stroke-width="0.5"/>'


def _legend(panel: Panel, x: float, top: float, width: float) -> tuple[list[str], float]:
    """The entries above a panel, and the height they take."""
    parts, at, line = [], x, top
    for label in panel.entries():
        marks = [m for m in panel.marks if m.label == label]
        length = 15 + EM * SMALL * _length(label)
        if at > x and at + length > x + width:
            at, line = x, line + SMALL + 4
        sample = Frame(at, line + 2, 11, SMALL, (0, 1), (0, 1), False)
        drawn = "".join(_mark(_sample(m), sample) for m in marks)
        parts.append(
            f'<g class="entry" data-label="{escape(label)}"><g fill="none">{drawn}</g>'
            f"{_words(label, at + 14, line + SMALL + 1, 'start')}</g>"
        )
        at += length + 5
    return parts, line - top + SMALL + 6 if parts else 0.0


def _sample(mark: Mark) -> Mark:
    """The mark as its legend shows it, in a unit square."""
    ends, middle = np.array([0.0, 1.0]), np.array([0.5])
    none = np.empty(0)
    x, y, top = {"line": (ends, middle.repeat(2), none), "band": (ends, ends * 0, ends * 0 + 1)}.get(
        mark.kind, (middle, middle * 0, middle * 2) if mark.top.size else (middle, middle, none)
    )
    return Mark(mark.kind, x, y, top, mark.colour, mark.size, mark.alpha, mark.dash)


def _mark(mark: Mark, place: Frame) -> str:
    colour, edges = f"var(--{mark.colour})", ""
    alpha = f' opacity="{mark.alpha:g}"' if mark.alpha < 1 else ""
    x, y, top = place.across(mark.x), place.up(mark.y), place.up(mark.top)
    far, base = place.x + place.width, place.y + place.height
    filled = mark.kind in ("band", "span")
    if mark.kind == "line":
        edges = _line(*_thinned(x, y))
    elif mark.kind == "band":
        seen = np.isfinite(x) & np.isfinite(y) & np.isfinite(top)
        (u, v), (w, z) = _thinned(x[seen], y[seen]), _thinned(x[seen], top[seen])
        edges = _line(np.concatenate([u, w[::-1]]), np.concatenate([v, z[::-1]])) + "z" if len(u) else ""
    elif mark.kind == "span":
        edges = f"M{place.x:.1f} {y[0]:.1f}H{far:.1f}V{top[0]:.1f}H{place.x:.1f}z"
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
    label = f' data-label="{escape(mark.label)}"' if mark.label else ""
    ink = f'fill="{colour}"' if filled else f'stroke="{colour}" stroke-width="{_stroke(mark):g}"{_ends(mark)}'
    return f'<path d="{edges}" {ink}{alpha}{label}/>'


def _stroke(mark: Mark) -> float:
    return {"rings": 0.9, "ticks": 0.5, "dashes": 1.0}.get(mark.kind, mark.size)


def _ends(mark: Mark) -> str:
    dash = {"": "", "--": ' stroke-dasharray="3.7 1.6"', ":": ' stroke-dasharray="1 1.6"'}[mark.dash]
    return dash + (' stroke-linecap="round"' if mark.kind == "dots" else "")


def _spots(x: Array, y: Array, mark: Mark) -> tuple[Array, Array, list[str]]:
    """Where dots are drawn, each spot once, and what is drawn there."""
    seen = np.isfinite(x) & np.isfinite(y)
    spots: Array = np.unique(np.round(np.column_stack([x[seen], y[seen]]), 1), axis=0)
    r = mark.size / 2
    arc = f"a{r:g} {r:g} 0 1 0"
    stroke = {"dots": "h0", "ticks": f"m0 {r:g}v-{mark.size:g}", "dashes": f"m-{r:g} 0h{mark.size:g}"}.get(
        mark.kind, f"m-{r:g} 0{arc} {mark.size:g} 0{arc}-{mark.size:g} 0"
    )
    return spots[:, 0], spots[:, 1], [stroke] * len(spots)


def _each(x: Array, y: Array, strokes: Sequence[str]) -> str:
    return "".join(f"M{u:.1f} {v:.1f}{stroke}" for u, v, stroke in zip(x, y, strokes, strict=True))


def _line(x: Array, y: Array) -> str:
    """A path through what is finite, anew behind each gap."""
    parts, pen = [], False
    for u, v in zip(x.tolist(), y.tolist(), strict=True):
        if math.isfinite(u) and math.isfinite(v):
            parts.append(f"{'L' if pen else 'M'}{u:.1f} {v:.1f}")
            pen = True
        else:
            pen = False
    return "".join(parts)


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most :data:`SHOWN` points: of each part of many points the least and the greatest."""
    if len(x) <= SHOWN:
        return x, y
    kept = set()
    for part in np.array_split(np.arange(len(x)), SHOWN // 2):
        known = part[np.isfinite(y[part])]
        if known.size:
            kept |= {int(known[np.argmin(y[known])]), int(known[np.argmax(y[known])])}
    order = sorted(kept)
    return x[order], y[order]


def _words(
    text: str, x: float, y: float, anchor: str = "middle", size: float = SMALL, colour: str = "ink",
    turned: tuple[float, float] | None = None,
) -> str:  # fmt: skip
    """A line of text; ``turned``: upright, about this point."""
    if not text:
        return ""
    at = f'transform="translate({turned[0]:.1f} {turned[1]:.1f}) rotate(-90)"' if turned else f'x="{x:.1f}" y="{y:.1f}"'
    ink = f' color="var(--{colour})"' if colour != "ink" else ""
    return f'<text {at} text-anchor="{anchor}" font-size="{size:g}"{ink}>{_spans(text, size)}</text>'


def _spans(text: str, size: float) -> str:
    """Text with symbols: letters slanted, indices small and shifted."""
    parts, shift = [], 0.0
    for mark, piece in _pieces(text):
        wanted = {"_": 0.22, "^": -0.4}.get(mark, 0.0) * size
        dy = f' dy="{wanted - shift:.2g}"' if wanted != shift else ""
        small = f' font-size="{0.72 * size:.3g}"' if mark in "_^" and mark else ""
        slant = ' font-style="italic"' if mark == "i" else ""
        parts.append(
            f"<tspan{dy}{small}{slant}>{escape(piece)}</tspan>" if dy or small or slant else str(escape(piece))
        )
        shift = wanted
    return "".join(parts)


def _pieces(text: str) -> Iterator[tuple[str, str]]:
    """("", words), ("i", symbol), ("_", index) or ("^", exponent), in order."""
    for i, part in enumerate(re.split(r"(?<!\\)\$", text)):
        if i % 2:
            yield from ((mark or "i", piece) for mark, piece in math_pieces(part))
        elif part:
            yield "", part.replace(r"\$", "$")


def _length(text: str) -> int:
    return sum(len(piece) for _, piece in _pieces(text))
