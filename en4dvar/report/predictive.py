"""The prior predictive over the data: what the priors expect before any assimilation (``en4dvar validate --plot``)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from en4dvar.descent.preview import Preview
from en4dvar.report.style import COLUMN, LIGHT, panels, styled
from en4dvar.report.text import figure_text, with_unit
from en4dvar.series import Part
from en4dvar.state import Array
from en4dvar.units import convert

PANELS = 6


@styled
def prior_predictive(previews: Sequence[Preview]) -> Figure:
    """Data ± std over the prior ensemble's paths (bands hold 50 and 90 % of the members).

    One panel a data set and series, in display units; at most :data:`PANELS` panels are drawn.
    """
    shown = [(one, part, path) for one in previews for part, path in _curves(one)][:PANELS]
    figure, axes = panels(len(shown), COLUMN * min(2, len(shown)), 6.5 / 2.54)
    for ax, (one, part, path) in zip(axes, shown, strict=True):
        _panel(ax, one, part, path)
        if len(shown) > 1:
            several = len(one.problem.parts) > 1
            ax.set_title(
                figure_text(
                    f"{one.problem.observations.name}: {part.name}" if several else one.problem.observations.name
                )
            )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def _curves(one: Preview) -> Iterator[tuple[Part, Array | None]]:
    """The series of a data set, each with its paths (N, M) along the grid; None of one that has several places."""
    width, curves = len(one.grid), itertools.count()
    for part in one.problem.parts:
        first = width * next(curves) if part.has_path else 0
        yield part, one.run.path[:, first : first + width] if part.has_path else None


def _panel(ax: Axes, one: Preview, part: Part, path: Array | None) -> None:
    model, y, observable = one.problem.model, one.problem.observations, part.observable
    unit, shown_unit, own = observable.unit, observable.display_unit, part.where
    grid, times = (convert(t, model.time_unit, model.time_display_unit) for t in (one.grid, y.times[own]))
    at_readings = path is None
    members = (one.run.predictions[:, own] if path is None else path)[one.run.active]
    paths, data, std = (convert(v, unit, shown_unit) for v in (members, y.values[own], y.std[own]))
    if len(paths) > 1:
        for (low, high), alpha, label in (((0.05, 0.95), 0.3, "prior 90 %"), ((0.25, 0.75), 0.45, "50 %")):
            edges = np.quantile(paths, (low, high), axis=0)
            if at_readings:
                ax.vlines(times, *edges, color=LIGHT["prior"], alpha=alpha, lw=3, label=label)
            else:
                ax.fill_between(grid, *edges, color=LIGHT["prior"], alpha=alpha, lw=0, label=label)
        marks = {"ls": "", "marker": "_"} if at_readings else {"lw": 0.9}
        ax.plot(times if at_readings else grid, np.median(paths, axis=0), color=LIGHT["prior"], label="median", **marks)
    size = 2.2 if len(data) <= 150 else 1.2
    ax.errorbar(times, data, std, fmt="o", ms=size, lw=0.6, color=LIGHT["ink"], label="data ± std", zorder=4)
    label = observable.label
    if label != observable.symbol:
        label = f"{label} {_math(observable.symbol)}"
    ax.set(xlabel=with_unit("time", model.time_display_unit), ylabel=with_unit(label, shown_unit))
    top = max(float(data.max()), float(np.quantile(paths, 0.95)) if len(paths) else 0.0)
    low = min(float(data.min()), float(np.quantile(paths, 0.05)) if len(paths) else 0.0)
    ax.set_ylim(low - 0.05 * (top - low), top + 0.08 * (top - low))


def _math(symbol: str) -> str:
    return symbol if "$" in symbol or len(symbol) > 1 else f"${symbol}$"
