"""How matplotlib's figures look and are written: PDF and PNG on white, inline SVG that follows light and dark schemes.

Figures are drawn with the object interface in the light palette. In the page each colour of the palette becomes a CSS
variable, so one drawing serves both schemes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure

from en4dvar.files import write_bytes
from en4dvar.report.palette import LIGHT as LIGHT  # for those who draw with matplotlib
from en4dvar.state import Array

P = ParamSpec("P")
T = TypeVar("T")
COLUMN = 8.5 / 2.54  # inches: one journal column
PAGE = 17.5 / 2.54

RC: dict[str, Any] = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.1,
    "text.color": LIGHT["ink"],
    "axes.labelcolor": LIGHT["ink"],
    "axes.titlecolor": LIGHT["ink"],
    "axes.edgecolor": LIGHT["muted"],
    "xtick.color": LIGHT["muted"],
    "ytick.color": LIGHT["muted"],
    "xtick.labelcolor": LIGHT["ink"],
    "ytick.labelcolor": LIGHT["ink"],
    "grid.color": LIGHT["grid"],
    "svg.fonttype": "path",
    "svg.hashsalt": "en4dvar",
    "pdf.fonttype": 42,
}


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Run ``draw`` in the report's style, whatever style the caller's process has."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> T:
        with style.context(["default", RC]):
            return draw(*args, **kwargs)

    return inside


def panels(n: int, width: float, row_height: float, above: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure with ``n`` axes in up to two columns; inches, ``above`` is left for a legend."""
    columns = min(2, n)
    rows = -(-n // columns)
    figure = Figure(figsize=(width, rows * row_height + above), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for ax in axes[n:]:
        ax.remove()
    return figure, axes[:n]


def scaled_histogram(ax: Axes, values: Array, colour: str, alpha: float, lw: float = 0.8) -> None:
    """Scaled to its peak; values that do not differ are a line."""
    if values.size < 2 or np.ptp(values) == 0:
        for value in values[:1]:
            ax.axvline(value, ymax=0.85, color=colour, alpha=alpha, lw=2)
        return
    bins = int(np.clip(np.ceil(2 * values.size ** (1 / 3)), 6, 30))  # Rice's rule
    counts, edges = np.histogram(values, bins)
    ax.stairs(counts / counts.max(), edges, fill=True, color=colour, alpha=alpha)
    ax.stairs(counts / counts.max(), edges, color=colour, lw=lw)


def _settle(figure: Figure) -> None:
    """Compute the layout once; constrained layout would do it again for every format."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


@styled
def save_figure(figure: Figure, folder: Path, name: str) -> None:
    """``folder/name.pdf`` (vectors) and ``folder/name.png`` (200 dots an inch), undated, each by atomic rename."""
    _settle(figure)
    # to the canvases directly: ``savefig`` would draw all of it once more, for a layout that is settled; and in memory:
    # the PDF writer has no words for a disk that is full
    pdf, png = io.BytesIO(), io.BytesIO()
    FigureCanvasPdf(figure).print_pdf(pdf, metadata={"CreationDate": None})
    dots, figure.dpi = figure.dpi, 200
    try:
        FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    finally:
        figure.dpi = dots
    write_bytes(folder / f"{name}.pdf", pdf.getvalue())
    write_bytes(folder / f"{name}.png", png.getvalue())


@styled
def inline_svg(figure: Figure, name: str, description: str) -> Markup:
    """The figure as an ``<svg>`` element: identifiers unique by ``name``, colours as CSS variables, no addresses."""
    _settle(figure)
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", svg).replace("xlink:href", "href")
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    for colour, code in LIGHT.items():
        svg = svg.replace(code, f"var(--{colour})")
    width, height = figure.get_size_inches()
    label = description.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    head = f'<svg role="img" aria-label="{label}" viewBox="0 0 {width * 72:g} {height * 72:g}"'
    return Markup(re.sub(r"^<svg[^>]*", head, svg, count=1))


def band(mean: Array, std: Array, reach: float, positive: bool) -> tuple[Array, Array]:
    """Mean ± ``reach`` std, of what is positive by the lognormal of the same mean and standard deviation."""
    if not positive:
        return mean - reach * std, mean + reach * std
    width = np.sqrt(np.log1p((std / mean) ** 2))
    centre = np.log(mean) - width**2 / 2
    return np.exp(centre - reach * width), np.exp(centre + reach * width)
