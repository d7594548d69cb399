"""The prior predictive over the data: what the priors expect before any assimilation (``en4dvar validate --plot``)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from en4dvar.descent.preview import Preview
from en4dvar.report.style import COLUMN, LIGHT, panels, styled
from en4dvar.report.text import figure_text, with_unit
from en4dvar.units import convert

PANELS = 6


@styled
def prior_predictive(previews: Sequence[Preview]) -> Figure:
    """Data ± std over the prior ensemble's paths (bands hold 50 and 90 % of the members), one panel a data set.

    In display units; at most :data:`PANELS` data sets are drawn.
    """
    shown = previews[:PANELS]
    figure, axes = panels(len(shown), COLUMN * min(2, len(shown)), 6.5 / 2.54)
    for ax, one in zip(axes, shown, strict=True):
        _panel(ax, one, titled=len(shown) > 1)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def _panel(ax: Axes, one: Preview, titled: bool) -> None:
    model, y, observable = one.problem.model, one.problem.observations, one.problem.observable
    unit, shown_unit = observable.unit, observable.display_unit
    grid, times = (convert(t, model.time_unit, model.time_display_unit) for t in (one.grid, y.times))
    paths, data, std = (convert(v, unit, shown_unit) for v in (one.run.path[one.run.active], y.values, y.std))
    if len(paths) > 1:
        for (low, high), alpha, label in (((0.05, 0.95), 0.3, "prior 90 %"), ((0.25, 0.75), 0.45, "50 %")):
            edges = np.quantile(paths, (low, high), axis=0)
            ax.fill_between(grid, *edges, color=LIGHT["prior"], alpha=alpha, lw=0, label=label)
        ax.plot(grid, np.median(paths, axis=0), color=LIGHT["prior"], lw=0.9, label="median")
    size = 2.2 if len(y) <= 150 else 1.2
    ax.errorbar(times, data, std, fmt="o", ms=size, lw=0.6, color=LIGHT["ink"], label="data ± std", zorder=4)
    label = observable.label
    if label != observable.symbol:
        label = f"{label} {_math(observable.symbol)}"
    ax.set(xlabel=with_unit("time", model.time_display_unit), ylabel=with_unit(label, shown_unit))
    top = max(float(data.max()), float(np.quantile(paths, 0.95)) if len(paths) else 0.0)
    low = min(float(data.min()), float(np.quantile(paths, 0.05)) if len(paths) else 0.0)
    ax.set_ylim(low - 0.05 * (top - low), top + 0.08 * (top - low))
    if titled:
        ax.set_title(figure_text(y.name))


def _math(symbol: str) -> str:
    return symbol if "$" in symbol or len(symbol) > 1 else f"${symbol}$"
