"""Marks of a chart as paths of SVG, in a frame.

One coordinate in ten of a point is kept. Lines of more points than can be seen are thinned to the extremes of each
part and dots on the same spot are drawn once, so that 10⁵ readings make no page of megabytes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import escape

from en4dvar.model.state import Array
from en4dvar.report.chart import Mark
from en4dvar.report.palette import ink

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
    logarithmic: bool = False
    x_logarithmic: bool = False

    def across(self, values: Array) -> Array:
        return np.asarray(self.x + self.width * _share(np.asarray(values, dtype=float), self.xlim, self.x_logarithmic))

    def up(self, values: Array) -> Array:
        return np.asarray(self.y + self.height * (1 - _share(values, self.ylim, self.logarithmic)))


def _share(values: Array, limits: tuple[float, float], logarithmic: bool) -> Array:
    """The share of the way between two limits."""
    low, high = limits
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(values / low) / math.log(high / low) if logarithmic else (values - low) / (high - low)
    return np.asarray(share)


def path_of(mark: Mark, place: Frame) -> str:
    colour, edges = ink(mark.colour), ""
    alpha = f' opacity="{mark.alpha:g}"' if mark.alpha < 1 else ""
    x, y, top = place.across(mark.x), place.up(mark.y), place.up(mark.top)
    far, base = place.x + place.width, place.y + place.height
    filled = mark.kind in ("band", "span", "tiles")
    if mark.kind == "line":
        edges = _line(*_thinned(x, y))
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
