"""A chart as a matplotlib figure, for PDF and PNG and for whoever works on with it."""

from __future__ import annotations

import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from en4dvar.report.chart import Chart, Mark, Panel
from en4dvar.report.palette import LIGHT
from en4dvar.report.style import styled

MANY = 5000  # points of a mark: beyond, they are drawn as pixels, for vectors would make a file of many megabytes
MARKERS = {"dots": "o", "rings": "o", "ticks": "|", "dashes": "_"}


@styled
def on_paper(chart: Chart) -> Figure:
    """The figure, in the same size and colours as in the page."""
    figure = Figure(figsize=(chart.width / 72, chart.height / 72), layout="constrained")
    columns = math.lcm(*(len(row.panels) for row in chart.rows))
    grid = figure.add_gridspec(len(chart.rows), columns, height_ratios=[row.height for row in chart.rows])
    for i, row in enumerate(chart.rows):
        each = columns // len(row.panels)
        for j, panel in enumerate(row.panels):
            if panel.bare and not panel.words:
                continue
            _panel(figure.add_subplot(grid[i, j * each : (j + 1) * each]), panel)
    figure.align_labels()
    return figure


def _panel(ax: Axes, panel: Panel) -> None:
    if panel.bare:
        ax.set_axis_off()
        ax.text(0.5, 0.5, panel.words, ha="center", va="center", transform=ax.transAxes)
        return
    if panel.logarithmic:
        ax.set_yscale("log", nonpositive="mask")
    for mark in panel.marks:
        _mark(ax, mark)
    xlim, ylim = panel.limits()
    ax.set(xlabel=panel.xlabel, ylabel=panel.ylabel, xlim=xlim, ylim=ylim)
    if panel.title:
        ax.set_title(panel.title, color=LIGHT[panel.title_colour])
    if not isinstance(panel.xticks, int):
        ax.set_xticks(list(panel.xticks))
        if panel.names:
            ax.set_xticklabels(list(panel.names), rotation=90)
    else:
        ax.xaxis.set_major_locator(MaxNLocator(panel.xticks, integer=panel.whole))
    if not isinstance(panel.yticks, int):
        ax.set_yticks(list(panel.yticks))
    elif not panel.logarithmic:
        ax.yaxis.set_major_locator(MaxNLocator(panel.yticks))
    ax.tick_params(labelbottom=panel.x_numbers, labelleft=panel.y_numbers and panel.left, left=panel.left)
    ax.spines["left"].set_visible(panel.left)
    if panel.grid:
        ax.grid(axis="y", lw=0.5)
    if panel.legend:
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, columnspacing=1.2, handlelength=1.4)


def _mark(ax: Axes, mark: Mark) -> None:
    how: dict[str, Any] = {"color": LIGHT[mark.colour], "alpha": mark.alpha, "label": mark.label or None}
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
    else:
        edge = 0.0 if mark.kind == "dots" else mark.stroke
        look: dict[str, Any] = {"mew": edge, "mfc": "none"} if mark.kind == "rings" else {"mew": edge}
        ax.plot(mark.x, mark.y, MARKERS[mark.kind], ms=mark.size, rasterized=many, **look, **how)
