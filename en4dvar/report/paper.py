"""A chart as a matplotlib figure: PDF and PNG for a paper, and a figure for whoever works on with it.

Only this module draws with matplotlib, whose import takes longer than all charts of a page: each function does it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from en4dvar.plumbing.files import write_bytes
from en4dvar.report.chart import LIGHT, Chart, Mark, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

MANY = 5000  # points of a mark: beyond, they are drawn as pixels, for vectors would make a file of many megabytes
LABEL = 110  # points that an entry of a legend takes
MARKERS = {"dots": "o", "rings": "o", "ticks": "|", "dashes": "_"}
RC: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.labelsize", "axes.titlesize"), 8),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 7),
    **dict.fromkeys(("legend.frameon", "axes.spines.top", "axes.spines.right"), False),
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.titlecolor"), LIGHT["ink"]),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), LIGHT["ink"]),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), LIGHT["muted"]),
    "axes.linewidth": 0.6,
    "grid.color": LIGHT["grid"],
    "pdf.fonttype": 42,
}
STYLE: list[str | Path | dict[str, Any]] = ["default", RC]  # whatever style the caller's process has


def on_paper(chart: Chart) -> Figure:
    """The figure, in the same size and colours as in the page."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(STYLE):
        figure = Figure(figsize=(chart.width / 72, chart.height / 72), layout="constrained")
        columns = math.lcm(*(len(row.panels) for row in chart.rows))
        grid = figure.add_gridspec(len(chart.rows), columns, height_ratios=[row.height for row in chart.rows])
        for i, row in enumerate(chart.rows):
            each = columns // len(row.panels)
            for j, panel in enumerate(row.panels):
                if not panel.bare or panel.words:
                    _panel(figure.add_subplot(grid[i, j * each : (j + 1) * each]), panel)
        _legends(figure, chart)
        figure.align_labels()
        return figure


def save_chart(chart: Chart, folder: Path, name: str) -> None:
    """``folder/name.pdf`` (vectors) and ``.png`` (200 dots an inch), undated. Raises :class:`OutputError`."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    figure = on_paper(chart)
    with style.context(STYLE):
        engine = figure.get_layout_engine()
        assert engine is not None
        engine.execute(figure)
        figure.set_layout_engine("none")  # it would do it again for every format
        # to the canvases directly: ``savefig`` would draw all of it once more, for a layout that is settled; and in
        # memory: the PDF writer has no words for a disk that is full
        pdf, png = io.BytesIO(), io.BytesIO()
        FigureCanvasPdf(figure).print_pdf(pdf, metadata={"CreationDate": None})
        figure.dpi = 200
        FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    write_bytes(folder / f"{name}.pdf", pdf.getvalue())
    write_bytes(folder / f"{name}.png", png.getvalue())


def _panel(ax: Axes, panel: Panel) -> None:
    if panel.bare:
        for mark in panel.marks:
            _mark(ax, mark)
        ax.set(ylim=panel.limits()[1])
        ax.set_axis_off()
        ax.text(0.5, 0.5, panel.words, ha="center", va="center", transform=ax.transAxes)
        return
    if panel.logarithmic:
        ax.set_yscale("log", nonpositive="mask")
    if panel.x_logarithmic:
        ax.set_xscale("log", nonpositive="mask")
    for mark in panel.marks:
        _mark(ax, mark)
    xlim, ylim = panel.limits()
    ax.set(xlabel=panel.xlabel, ylabel=panel.ylabel, xlim=xlim, ylim=ylim)
    if panel.title:
        ax.set_title(panel.title, color=LIGHT.get(panel.title_colour))
    _ticks(ax.xaxis, panel.x_ticks(), rotation=90 if panel.names else 0)
    _ticks(ax.yaxis, panel.y_ticks())
    ax.tick_params(labelbottom=panel.x_numbers, labelleft=panel.y_numbers and panel.left, left=panel.left)
    ax.spines["left"].set_visible(panel.left)
    if panel.grid:
        ax.grid(axis="y", lw=0.5)


def _legends(figure: Figure, chart: Chart) -> None:
    """Each legend above its panel; where a row has several panels and one legend, above all of them, and where it has
    several legends, in one column: one that is wider than its panel would leave the panels no room.
    """
    axes = iter(figure.axes)
    for row in chart.rows:
        drawn = [(next(axes), panel) for panel in row.panels if not panel.bare or panel.words]
        shown = [(ax, panel) for ax, panel in drawn if panel.legend]
        for ax, panel in shown:
            entries: dict[str, dict[type, Any]] = {}  # of a label, a mark of each kind, drawn over each other
            for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
                entries.setdefault(label, {}).setdefault(type(handle), handle)
            labels, handles = list(entries), cast(Any, [tuple(kinds.values()) for kinds in entries.values()])
            above = 1.0 + 0.12 * bool(panel.title)
            how: dict[str, Any] = {"columnspacing": 1.2, "handlelength": 1.4}
            if len(drawn) > 1 and len(shown) == 1 and row is chart.rows[0]:
                columns = max(1, int(chart.width // LABEL))
                figure.legend(handles, labels, loc="outside upper center", ncols=columns, **how)
            else:
                columns = 3 if len(drawn) == 1 else 1
                ax.legend(handles, labels, loc="lower center", bbox_to_anchor=(0.5, above), ncols=columns, **how)


def _ticks(axis: Axis, ticks: Sequence[tuple[float, str]], rotation: float = 0) -> None:
    axis.set_ticks([value for value, _ in ticks], [text for _, text in ticks], rotation=rotation)
    axis.set_ticks([], minor=True)


def _mark(ax: Axes, mark: Mark) -> None:
    from matplotlib.collections import PolyCollection

    colour = LIGHT.get(mark.colour, mark.colour)
    how: dict[str, Any] = {"color": colour, "alpha": mark.alpha, "label": mark.label or None}
    many = len(mark.x) > MANY
    if mark.kind == "line":
        ax.plot(mark.x, mark.y, mark.dash or "-", lw=mark.size, rasterized=many, **how)
    elif mark.kind == "band":
        ax.fill_between(mark.x, mark.y, mark.top, lw=0, rasterized=many, **how)
    elif mark.kind == "bars":
        ax.vlines(mark.x, mark.y, mark.top, lw=mark.size, **how)
    elif mark.kind == "rule":
        ax.axhline(mark.y[0], lw=mark.size, **how)
    elif mark.kind == "upright":
        ax.axvline(mark.x[0], ymax=0.85, lw=mark.size, ls=mark.dash or "-", **how)
    elif mark.kind == "span":
        ax.axhspan(mark.y[0], mark.top[0], lw=0, **how)
    elif mark.kind == "tiles":
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * mark.top / 2
        rectangles: Any = np.column_stack([mark.x, mark.y])[:, None] + corners
        ax.add_collection(PolyCollection(rectangles, lw=0.1, **how))
    else:
        edge = 0.0 if mark.kind == "dots" else mark.stroke
        look: dict[str, Any] = {"mew": edge, "mfc": "none"} if mark.kind == "rings" else {"mew": edge}
        ax.plot(mark.x, mark.y, MARKERS[mark.kind], ms=mark.size, rasterized=many, **look, **how)
