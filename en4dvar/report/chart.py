"""What a figure shows, free of how it is drawn: panels in rows, and marks in panels.

One description serves the page (:mod:`en4dvar.report.svg`, in milliseconds) and paper (:mod:`en4dvar.report.paper`,
PDF and PNG by matplotlib, whose import and layout would take longer than the estimate). Colours are names of
:data:`~en4dvar.report.palette.LIGHT`, lengths points (1/72 inch), labels text with mathtext symbols.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from en4dvar.state import Array

Kind = Literal["line", "dots", "rings", "ticks", "dashes", "band", "bars", "rule", "upright", "span"]
POINTS = 72 / 2.54  # a centimetre
COLUMN, PAGE = 8.5 * POINTS, 17.5 * POINTS  # one journal column, and two
Values = npt.ArrayLike


@dataclass(frozen=True)
class Mark:
    """``x`` and ``y`` (n,) in the panel's units, ``top`` (n,) of what has a lower and an upper edge.

    ``size``: width of a line, diameter of a dot. ``dash``: "", "--" or ":". Marks of one ``label`` are one entry of the
    legend. A ``rule`` lies at ``y``, an ``upright`` at ``x`` up to 85 % of the height; a ``span`` reaches from ``y`` to
    ``top``.
    """

    kind: Kind
    x: Array
    y: Array
    top: Array
    colour: str
    size: float = 1.1
    alpha: float = 1.0
    dash: str = ""
    label: str = ""

    @property
    def stroke(self) -> float:
        """Width of the pen: of rings and ticks it is thin, whatever their ``size``."""
        return {"rings": 0.9, "ticks": 0.5, "dashes": 1.0}.get(self.kind, self.size)

    @property
    def heights(self) -> Array:
        """What the panel must be high enough for."""
        return np.concatenate([self.y, self.top])


@dataclass
class Panel:
    """Two axes and what is drawn between them.

    ``xticks``, ``yticks``: how many intervals at most, or the ticks themselves; ``names``: words below ``xticks`` in
    place of numbers. ``bare``: nothing but ``words``, in the middle; ``limits`` left None follow the marks.
    """

    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    title_colour: str = "ink"
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None
    xticks: int | Sequence[float] = 5
    yticks: int | Sequence[float] = 5
    whole: bool = False  # only whole numbers along x
    logarithmic: bool = False  # along y
    x_numbers: bool = True
    y_numbers: bool = True
    left: bool = True  # an axis on the left
    grid: bool = False
    legend: bool = False
    names: Sequence[str] = ()
    bare: bool = False
    words: str = ""
    marks: list[Mark] = field(default_factory=list)

    def line(
        self, x: Values, y: Values, colour: str, size: float = 1.1, dash: str = "", label: str = "", alpha: float = 1.0
    ) -> None:
        self._add("line", x, y, (), colour, size, alpha, dash, label)

    def dots(
        self, x: Values, y: Values, colour: str, size: float = 2.2, alpha: float = 1.0, label: str = "",
        kind: Kind = "dots",
    ) -> None:  # fmt: skip
        """Also ``rings``, ``ticks`` (upright) and ``dashes`` (level)."""
        self._add(kind, x, y, (), colour, size, alpha, "", label)

    def band(self, x: Values, low: Values, high: Values, colour: str, alpha: float, label: str = "") -> None:
        self._add("band", x, low, high, colour, 0.0, alpha, "", label)

    def bars(
        self, x: Values, low: Values, high: Values, colour: str, size: float = 0.8, alpha: float = 1.0, label: str = ""
    ) -> None:
        low, high = (np.broadcast_to(np.asarray(v, dtype=float), np.shape(x)) for v in (low, high))
        self._add("bars", x, low, high, colour, size, alpha, "", label)

    def rule(self, y: float, colour: str = "muted", size: float = 0.6) -> None:
        self._add("rule", (), (y,), (), colour, size, 1.0, "", "")

    def upright(self, x: float, colour: str, size: float = 0.9, dash: str = "", alpha: float = 1.0) -> None:
        self._add("upright", (x,), (), (), colour, size, alpha, dash, "")

    def span(self, low: float, high: float, colour: str, alpha: float) -> None:
        self._add("span", (), (low,), (high,), colour, 0.0, alpha, "", "")

    def histogram(self, values: Array, colour: str, alpha: float) -> None:
        """Scaled to its peak; values that do not differ are a line."""
        if values.size < 2 or np.ptp(values) == 0:
            for value in values[:1]:
                self.upright(float(value), colour, 2.0, alpha=alpha)
            return
        bins = int(np.clip(np.ceil(2 * values.size ** (1 / 3)), 6, 30))  # Rice's rule
        counts, edges = np.histogram(values, bins)
        x, y = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(counts / counts.max(), 2), [0.0]])
        self.band(x, np.zeros(len(x)), y, colour, alpha)
        self.line(x, y, colour, 0.8)

    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Of both axes; where they are not given, those of the marks and 5 % around."""
        x = np.concatenate([np.empty(0), *(m.x for m in self.marks)])
        y = np.concatenate([np.empty(0), *(m.heights for m in self.marks)])
        return self.xlim or _around(x), self.ylim or _around(y, self.logarithmic)

    def entries(self) -> list[str]:
        """Labels of the legend, each once."""
        return list(dict.fromkeys(m.label for m in self.marks if m.label)) if self.legend else []

    def _add(
        self, kind: Kind, x: Values, y: Values, top: Values, colour: str, size: float, alpha: float, dash: str,
        label: str,
    ) -> None:  # fmt: skip
        x, y, top = (np.asarray(v, dtype=float).ravel() for v in (x, y, top))
        self.marks.append(Mark(kind, x, y, top, colour, size, alpha, dash, label))


@dataclass(frozen=True)
class Row:
    """Panels side by side, ``height`` with their labels."""

    height: float
    panels: Sequence[Panel]


@dataclass(frozen=True)
class Chart:
    """Rows of panels, from above; the first panels of all rows are aligned."""

    rows: Sequence[Row]
    width: float = COLUMN

    @property
    def height(self) -> float:
        return sum(row.height for row in self.rows)


def in_columns(panels: Iterable[Panel], height: float, columns: int = 2) -> Chart:
    """Panels in rows of up to ``columns``; empty places are bare."""
    held = list(panels)
    columns = min(columns, len(held))
    held += [Panel(bare=True) for _ in range(-len(held) % columns)]
    return Chart([Row(height, held[i : i + columns]) for i in range(0, len(held), columns)])


def steps(edges: Array, values: Array) -> tuple[Array, Array]:
    """A line (2 m,) through m values, each constant between two of the m + 1 ``edges``."""
    return np.repeat(edges, 2)[1:-1], np.repeat(values, 2)


def _around(values: Array, logarithmic: bool = False) -> tuple[float, float]:
    values = values[np.isfinite(values) & ((values > 0) if logarithmic else True)]
    if not values.size:
        return (0.1, 1.0) if logarithmic else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if logarithmic:
        factor = (high / low) ** 0.05 if high > low else 2.0
        return low / factor, high * factor
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 0.05
    return low - margin, high + margin
