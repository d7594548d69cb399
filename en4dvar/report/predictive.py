"""The prior predictive over the data: what the priors expect before any assimilation (``en4dvar validate --plot``)."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from en4dvar.data.series import Part
from en4dvar.descent.preview import Preview
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.model.state import Array
from en4dvar.plumbing.units import convert
from en4dvar.report.chart import COLUMN, POINTS, Chart, Panel, in_columns
from en4dvar.report.text import figure_text, with_unit

PANELS = 6


def prior_predictive(previews: Sequence[Preview]) -> Chart:
    """Data ± std over the prior ensemble's paths (bands hold 50 and 90 % of the members).

    One panel a data set and series, in display units; at most :data:`PANELS` panels are drawn.
    """
    shown = [(preview, part, path) for preview in previews for part, path in _curves(preview)][:PANELS]
    panels = []
    for preview, part, path in shown:
        panel = _panel(preview, part, path)
        if len(shown) > 1:
            name = preview.problem.observations.name
            panel.title = figure_text(f"{name}: {part.name}" if len(preview.problem.parts) > 1 else name)
        panels.append(panel)
    panels[0].legend = True
    return in_columns(panels, 6.5 * POINTS, width=COLUMN * min(2, len(shown)))


def _curves(preview: Preview) -> Iterator[tuple[Part, Array | None]]:
    """The series of a data set, each with its paths (N, M) along the grid; None of one that has several places."""
    width, curves = len(preview.grid), itertools.count()
    for part in preview.problem.parts:
        first = width * next(curves) if part.has_path else 0
        yield part, preview.run.path[:, first : first + width] if part.has_path else None


def _panel(preview: Preview, part: Part, path: Array | None) -> Panel:
    model, y, observable = preview.problem.model, preview.problem.observations, part.observable
    unit, shown_unit, own = observable.unit, observable.display_unit, part.where
    grid, times = (convert(t, model.time_unit, model.time_display_unit) for t in (preview.grid, y.times[own]))
    members = (preview.run.predictions[:, own] if path is None else path)[preview.run.active]
    paths, data, std = (convert(v, unit, shown_unit) for v in (members, y.values[own], y.std[own]))
    label = observable.label
    if label != observable.symbol:
        symbol = observable.symbol
        label = f"{label} {symbol}" if "$" in symbol or len(symbol) > 1 else f"{label} ${symbol}$"
    panel = Panel(with_unit("time", model.time_display_unit), with_unit(label, shown_unit))
    if len(paths) > 1:
        for levels, alpha, words in (((0.05, 0.95), 0.3, "prior 90 %"), ((0.25, 0.75), 0.45, "50 %")):
            low, high = member_quantiles(paths, levels, axis=0)
            if path is None:
                panel.bars(times, low, high, "prior", 3.0, alpha, words)
            else:
                panel.band(grid, low, high, "prior", alpha, words)
        if path is None:
            panel.dots(times, np.median(paths, axis=0), "prior", 5.0, label="median", kind="dashes")
        else:
            panel.line(grid, np.median(paths, axis=0), "prior", 0.9, label="median")
    panel.bars(times, data - std, data + std, "ink", 0.6, label="data ± std")
    panel.dots(times, data, "ink", 2.2 if len(data) <= 150 else 1.2, label="data ± std")
    top = max(float(data.max()), float(np.quantile(paths, 0.95)) if len(paths) else 0.0)
    bottom = min(float(data.min()), float(np.quantile(paths, 0.05)) if len(paths) else 0.0)
    panel.ylim = bottom - 0.05 * (top - bottom), top + 0.08 * (top - bottom)
    return panel
