"""What a figure shows, free of how it is drawn: panels in rows, marks in panels, round numbers for the axes, colours.

One description serves the page (:mod:`en4dvar.report.svg`, in milliseconds) and paper (:mod:`en4dvar.report.paper`,
PDF and PNG by matplotlib, whose import and layout would take longer than the estimate). Colours are names of
:data:`LIGHT` or hexadecimal, lengths points (1/72 inch), labels text with mathtext symbols.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.report.text import plain_number

Kind = Literal["line", "dots", "rings", "ticks", "dashes", "band", "bars", "rule", "upright", "span", "tiles"]
POINTS = 72 / 2.54  # a centimetre
COLUMN, PAGE = 8.5 * POINTS, 17.5 * POINTS  # one journal column, and two
SAME = 1e-12  # of their size: values that differ by less are not divided into bins
Values = npt.ArrayLike


@dataclass(frozen=True)
class Mark:
    """``x`` and ``y`` (n,) in the panel's units, ``top`` (n,) of what has a lower and an upper edge.

    ``size``: width of a line, diameter of a dot. ``dash``: "", "--" or ":". Marks of one ``label`` are one entry of the
    legend. A ``rule`` lies at ``y``, an ``upright`` at ``x`` up to 85 % of the height; a ``span`` reaches from ``y`` to
    ``top``. ``tiles`` are rectangles about ``x`` and ``y``, whose width and height are ``top``.
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
        return self.y if self.kind == "tiles" else np.concatenate([self.y, self.top])


@dataclass
class Panel:
    """Two axes and what is drawn between them.

    ``xticks``, ``yticks``: how many intervals at most, or the ticks themselves; ``names``, ``y_names``: words in place
    of their numbers. A ``title`` may have several lines. ``bare``: no axes, and ``words`` in the middle. Limits
    that are None follow the marks.
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
    x_logarithmic: bool = False
    x_numbers: bool = True
    y_numbers: bool = True
    left: bool = True  # an axis on the left
    grid: bool = False
    legend: bool = False
    names: Sequence[str] = ()
    y_names: Sequence[str] = ()
    bare: bool = False
    words: str = ""
    marks: list[Mark] = field(default_factory=list)

    def line(
        self, x: Values, y: Values, colour: str, size: float = 1.1, dash: str = "", label: str = "", alpha: float = 1.0
    ) -> None:
        self._add("line", x, y, (), colour, size, alpha=alpha, dash=dash, label=label)

    def dots(
        self, x: Values, y: Values, colour: str, size: float = 2.2, alpha: float = 1.0, label: str = "",
        kind: Kind = "dots",
    ) -> None:  # fmt: skip
        """Also ``rings``, ``ticks`` (upright) and ``dashes`` (level)."""
        self._add(kind, x, y, (), colour, size, alpha=alpha, label=label)

    def band(self, x: Values, low: Values, high: Values, colour: str, alpha: float, label: str = "") -> None:
        self._add("band", x, low, high, colour, 0.0, alpha=alpha, label=label)

    def bars(
        self, x: Values, low: Values, high: Values, colour: str, size: float = 0.8, alpha: float = 1.0, label: str = ""
    ) -> None:
        low, high = (np.broadcast_to(np.asarray(v, dtype=float), np.shape(x)) for v in (low, high))
        self._add("bars", x, low, high, colour, size, alpha=alpha, label=label)

    def rule(self, y: float, colour: str = "muted", size: float = 0.6) -> None:
        self._add("rule", (), (y,), (), colour, size)

    def upright(self, x: float, colour: str, size: float = 0.9, dash: str = "", alpha: float = 1.0) -> None:
        self._add("upright", (x,), (), (), colour, size, alpha=alpha, dash=dash)

    def span(self, low: float, high: float, colour: str, alpha: float) -> None:
        self._add("span", (), (low,), (high,), colour, 0.0, alpha=alpha)

    def histogram(self, values: Array, colour: str, alpha: float) -> None:
        """Scaled to its peak; values that do not differ, but for rounding, are a line."""
        if values.size < 2 or np.ptp(values) <= SAME * np.abs(values).max():
            for value in values[:1]:
                self.upright(float(value), colour, 2.0, alpha=alpha)
            return
        bins = int(np.clip(np.ceil(2 * values.size ** (1 / 3)), 6, 30))  # Rice's rule
        counts, edges = np.histogram(values, bins)
        self.stairs(edges, counts / counts.max(), colour, alpha)

    def stairs(
        self, edges: Values, heights: Values, colour: str, alpha: float, size: float = 0.8, dash: str = "",
        label: str = "",
    ) -> None:  # fmt: skip
        """Bars (m,) side by side between edges (m + 1,): their outline, filled where ``alpha`` is not zero."""
        x, y = np.repeat(np.asarray(edges, dtype=float), 2), np.pad(np.repeat(np.asarray(heights, dtype=float), 2), 1)
        if alpha:
            self.band(x, np.zeros(len(x)), y, colour, alpha, label)
        self.line(x, y, colour, size, dash, label)

    def intervals(self, low: Values, high: Values, y: Values, colour: str, size: float = 1.1, label: str = "") -> None:
        """A level line from ``low`` to ``high`` (n,) at each ``y`` (n,)."""
        ends = np.column_stack([low, high, np.full(np.shape(low), np.nan)])
        self.line(ends, np.repeat(np.asarray(y, dtype=float), 3), colour, size, label=label)

    def tiles(self, x: Values, y: Values, size: tuple[float, float], colour: str) -> None:
        """Rectangles about ``x`` and ``y`` (n,), ``size`` wide and high."""
        self._add("tiles", x, y, size, colour, 0.0)

    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Of both axes; where they are not given, those of the marks and 5 % around."""
        x = np.concatenate([np.empty(0), *(m.x for m in self.marks)])
        y = np.concatenate([np.empty(0), *(m.heights for m in self.marks)])
        return self.xlim or _around(x, self.x_logarithmic), self.ylim or _around(y, self.logarithmic)

    def entries(self) -> list[str]:
        return list(dict.fromkeys(m.label for m in self.marks if m.label)) if self.legend else []

    def x_ticks(self) -> list[tuple[float, str]]:
        """Along x, each with its number or its name."""
        return labelled(self.limits()[0], self.xticks, self.names, self.x_logarithmic, self.whole)

    def y_ticks(self) -> list[tuple[float, str]]:
        return labelled(self.limits()[1], self.yticks, self.y_names, self.logarithmic, False)

    def _add(self, kind: Kind, x: Values, y: Values, top: Values, colour: str, size: float, **how: Any) -> None:
        x, y, top = (np.asarray(v, dtype=float).ravel() for v in (x, y, top))
        self.marks.append(Mark(kind, x, y, top, colour, size, **how))


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


def in_columns(panels: Iterable[Panel], height: float, columns: int = 2, width: float = 0.0) -> Chart:
    """Panels in rows of up to ``columns``; empty places are bare. ``width``: of all, else a journal column each."""
    held = list(panels)
    columns = min(columns, len(held))
    held += [Panel(bare=True) for _ in range(-len(held) % columns)]
    return Chart([Row(height, held[i : i + columns]) for i in range(0, len(held), columns)], width or COLUMN * columns)


def stacked(panels: Sequence[Panel], height: float, xlabel: str) -> Chart:
    """Panels below each other with one axis along x, and a legend of all their marks above."""
    *others, last = panels
    for panel in others:
        panel.x_numbers = False
    last.xlabel, first = xlabel, panels[0]
    first.legend = any(mark.label for panel in panels for mark in panel.marks)
    for mark in [mark for panel in panels for mark in panel.marks if mark.label]:
        if mark.label not in first.entries():
            first.marks.append(replace(mark, x=mark.x[:0], y=mark.y[:0], top=mark.top[:0]))
    heights = np.full(len(panels), height)
    heights[0] += 0.5 * POINTS * first.legend
    heights[-1] += 0.8 * POINTS
    return Chart([Row(float(h), [panel]) for h, panel in zip(heights, panels, strict=True)])


def interval(mean: Array, std: Array, reach: float, positive: bool) -> tuple[Array, Array]:
    """Mean ± ``reach`` std, of what is positive by the lognormal of the same mean and standard deviation."""
    if not positive:
        return mean - reach * std, mean + reach * std
    width = np.sqrt(np.log1p((std / mean) ** 2))
    centre = np.log(mean) - width**2 / 2
    return np.exp(centre - reach * width), np.exp(centre + reach * width)


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


def labelled(
    limits: tuple[float, float], wanted: int | Sequence[float], names: Sequence[str], logarithmic: bool, whole: bool
) -> list[tuple[float, str]]:
    """The ticks of an axis within its limits, each with its number or its name."""
    low, high = sorted(limits)
    powers_of_ten = logarithmic and isinstance(wanted, int)
    chosen = powers(low, high) if powers_of_ten else ticks(low, high, wanted, whole)
    held = [t for t in chosen if low <= t <= high or math.isclose(t, low) or math.isclose(t, high)]
    texts = names or ([plain_number(t, 3) for t in held] if logarithmic else numbers(held))
    return list(zip(held, texts, strict=True))


def powers(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 3), (1, 2, 5)):
        values = [f * 10.0**k for k in exponents for f in factors if low <= f * 10.0**k <= high]
        if len(values) > 2:
            break
    return values[:: max(1, len(values) // 6)]


def numbers(values: Sequence[float]) -> list[str]:
    """Ticks as text, all with the same decimals; no two that differ look the same."""
    size = max(map(abs, values), default=0.0)
    step = min((abs(b - a) for a, b in pairwise(values)), default=size)
    if (size and not 1e-3 <= size < 1e5) or step <= 0:
        digits = next((n for n in range(3, 15) if all(abs(v - float(f"{v:.{n}g}")) < 1e-6 * step for v in values)), 15)
        return [plain_number(v, digits if step > 0 else 3) for v in values]
    places = next((n for n in range(13) if all(abs(v - round(v, n)) < 1e-6 * step for v in values)), 13)
    return [f"{v:.{places}f}".replace("-", "−") if round(v, places) else "0" for v in values]


_BOTH = {  # on light, on dark ground
    "paper": ("#ffffff", "#16161a"),
    "ink": ("#1b1b1f", "#ececf0"),
    "muted": ("#63636c", "#a9a9b4"),
    "grid": ("#dcdce2", "#3b3b44"),
    "prior": ("#85858f", "#9c9ca8"),
    "posterior": ("#0072b2", "#56b4e9"),
    "centre": ("#d55e00", "#ff9f5a"),
    "background": ("#009e73", "#2fd0a2"),
}
LIGHT, DARK = ({name: colours[k] for name, colours in _BOTH.items()} for k in (0, 1))
VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
GREYS = ("#ffffff", "#bdbdbd", "#636363", "#000000")


def ramp(anchors: Sequence[str], share: float) -> str:
    """The colour at a ``share`` of the way along ``anchors``.

    >>> ramp(GREYS, 0.0), ramp(GREYS, 1.0)
    ('#ffffff', '#000000')
    """
    place = min(max(share, 0.0), 1.0) * (len(anchors) - 1)
    first = min(int(place), len(anchors) - 2)
    low, high = (bytes.fromhex(code[1:]) for code in anchors[first : first + 2])
    mixed = bytes(round(a + (b - a) * (place - first)) for a, b in zip(low, high, strict=True))
    return f"#{mixed.hex()}"
