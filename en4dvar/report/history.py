"""Data over what was predicted: by a result, one pair of panels a series, in time or over the places where a field was
read; by the prior alone (``en4dvar validate --plot``); and the readings after the window.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.model.state import Array
from en4dvar.plumbing.units import convert
from en4dvar.report.chart import POINTS, Chart, Panel, Row, in_columns
from en4dvar.report.text import axis_label, figure_text, shown, since, time_axis, with_unit
from en4dvar.results.declared import Axis, zero_of
from en4dvar.results.netcdf import Group, Variable
from en4dvar.results.store import StoredResult

if TYPE_CHECKING:
    from en4dvar.data.series import Part
    from en4dvar.descent.preview import Preview

MANY = 5000  # readings: beyond, their bars are one band
FEW = 150  # readings whose marks are large
PANELS = 6  # of the prior predictive

BANDS = (  # group of the members, two of their quantiles, and how what lies between is drawn
    ("prior_predictive", (0.05, 0.95), "prior", 0.28, "prior 90 %"),
    ("posterior_predictive", (0.05, 0.95), "posterior", 0.3, "posterior 90 %"),
    ("posterior_predictive", (0.25, 0.75), "posterior", 0.6, "posterior 50 %"),
)
WITHHELD_COLUMNS = ("time_unit", "time", "unit", "reading", "q05", "q50", "q95", "inside")
WITHHELD = (
    "The readings after the window, which the estimate has not seen, and what it expected of them: median and 5 to "
    "95 % of the posterior members with the errors of a reading and what the model may miss."
)


def history(result: StoredResult) -> Chart:
    """Data ± std, prior and posterior predictive bands (50 and 90 %), the centre; below, residuals over their std."""
    several, observed = len(result.axes) > 1, result.group("observed_data")
    high, low = (5.0, 2.3) if several else (6.8, 2.7)
    rows = []
    for i, axis in enumerate(result.axes):
        x, x_label = _along(observed, axis)
        data, std = shown(observed[axis.name]), shown(observed[f"{axis.name}_std"])
        centre = shown(result.group("sample_stats")[f"{axis.name}_centre"])
        first, last = float(x.min()), float(x.max())
        span = (last - first) or max(abs(first), 1.0)
        reach = first - 0.03 * span, last + 0.03 * span
        top = Panel(
            ylabel=_quantity(observed[axis.name]), title=axis.name if several else "", xlim=reach,
            ylim=_data_range(data, std), x_numbers=False, legend=i == 0,
        )  # fmt: skip
        _predictions(top, result, axis.name, x, centre)
        _readings(top, x, data, std)
        rows += [Row(high * POINTS, [top]), Row(low * POINTS, [_residuals(x, x_label, (data - centre) / std, reach)])]
    return Chart(rows)


def _along(observed: Group, axis: Axis) -> tuple[Array, str]:
    """(K,) times, or places of a field that is read at more of them than times, in the display unit; with a label."""
    place = f"{axis.name}_place"
    times, places = shown(observed[axis.time]), observed[place].values if place in observed else ()
    if len(np.unique(places)) > len(np.unique(times)):
        return np.asarray(places), with_unit("place", str(observed[place].attrs["units"]))
    return times, time_axis(observed[axis.time])


def _quantity(observed: Variable) -> str:
    """Label, symbol and unit of what was observed."""
    label, symbol = str(observed.attrs["long_name"]).removesuffix(", observed"), observed.attrs["symbol"]
    return axis_label(observed, label if label == symbol else f"{label} {symbol}")


def _predictions(panel: Panel, result: StoredResult, name: str, x: Array, centre: Array) -> None:
    """Along the path, or at each reading of a field, and at a single instant."""
    prior = result.group("prior_predictive")
    curve = f"{name}_path" in prior and np.ptp(prior["path_time"].values) > 0
    for group, levels, colour, alpha, label in BANDS:
        held = result.group(group)
        values = shown(held[f"{name}_path" if curve else name])[0]
        finite = np.isfinite(values)
        alive = finite.any(axis=1) if curve else finite.all(axis=1)
        if not alive.any():
            continue
        seen = finite.any(axis=0) if curve else slice(None)
        low, high = member_quantiles(values[alive][:, seen], levels, axis=0)
        if curve:
            panel.band(shown(held["path_time"])[seen], low, high, colour, alpha, label)
        else:
            panel.bars(x, low, high, colour, 4.0 if len(x) <= FEW else 2.0, alpha, label)
    _middle(panel, x, centre, "centre", "best fit", curve)


def _middle(panel: Panel, x: Array, y: Array, colour: str, label: str, curve: bool) -> None:
    if curve:
        panel.line(x, y, colour, 0.9, label=label)
    else:
        panel.dots(x, y, colour, 5.0, label=label, kind="dashes")


def _readings(panel: Panel, x: Array, data: Array, std: Array) -> None:
    if len(x) > MANY:  # one outline instead of a bar for each
        panel.band(x, data - std, data + std, "ink", 0.3, "data ± std")
    else:
        panel.bars(x, data - std, data + std, "ink", 0.6, label="data ± std")
    panel.dots(x, data, "ink", _size(x), label="data ± std")


def _size(x: Array) -> float:
    return 2.2 if len(x) <= FEW else 1.2


def _residuals(x: Array, x_label: str, residual: Array, along: tuple[float, float]) -> Panel:
    reach = 1.15 * max(3.0, float(np.max(np.abs(residual))))
    panel = Panel(x_label, "residual / std", xlim=along, ylim=(-reach, reach))
    panel.yticks = (-2, 0, 2) if reach < 8 else 4
    for limit, alpha in ((2, 0.12), (1, 0.16)):
        panel.span(-limit, limit, "posterior", alpha)
    panel.rule(0)
    panel.dots(x, residual, "ink", _size(x))
    return panel


def _data_range(data: Array, std: Array) -> tuple[float, float]:
    """Limits of the data with room around: a wide prior must not shrink them to a line."""
    low, high = float((data - std).min()), float((data + std).max())
    below = low - 0.12 * (high - low)
    return max(0.0, below) if data.min() >= 0 else below, high + 0.25 * (high - low)


def prior_predictive(previews: Sequence[Preview]) -> Chart:
    """Data ± std over 50 and 90 % of the prior's paths, a panel a series of a data set, :data:`PANELS` at most."""
    drawn, panels = [], []
    for preview in previews:
        width, at = len(preview.grid), 0
        for part in preview.problem.parts:  # with its paths (N, M) along the grid, but for one that has several places
            drawn.append((preview, part, preview.run.path[:, at : at + width] if part.has_path else None))
            at += width * part.has_path
    del drawn[PANELS:]
    for preview, part, path in drawn:
        panel = _prior(preview, part, path if np.ptp(preview.grid) > 0 else None)
        if len(drawn) > 1:
            name = preview.problem.observations.name
            panel.title = figure_text(f"{name}: {part.name}" if len(preview.problem.parts) > 1 else name)
        panels.append(panel)
    panels[0].legend = True
    return in_columns(panels, 6.5 * POINTS)


def _prior(preview: Preview, part: Part, path: Array | None) -> Panel:
    model, y, observable = preview.problem.model, preview.problem.observations, part.observable
    unit, shown_unit, own = observable.unit, observable.display_unit, part.where
    grid, times = (convert(t, model.time_unit, model.time_display_unit) for t in (preview.grid, y.times[own]))
    members = (preview.run.predictions[:, own] if path is None else path)[preview.run.active]
    paths, data, std = (convert(v, unit, shown_unit) for v in (members, y.values[own], y.std[own]))
    label, symbol = observable.label, observable.symbol
    if label != symbol:
        label = f"{label} {symbol}" if "$" in symbol or len(symbol) > 1 else f"{label} ${symbol}$"
    zero = convert(float(np.broadcast_to(y.zero, len(y))[part.begin]), model.time_unit, model.time_display_unit)
    panel = Panel(since(zero, model.time_display_unit, float(times.max())), with_unit(label, shown_unit))
    if len(paths) > 1:
        for levels, alpha, words in (((0.05, 0.95), 0.3, "prior 90 %"), ((0.25, 0.75), 0.45, "50 %")):
            low, high = member_quantiles(paths, levels, axis=0)
            if path is None:
                panel.bars(times, low, high, "prior", 3.0, alpha, words)
            else:
                panel.band(grid, low, high, "prior", alpha, words)
        _middle(panel, times if path is None else grid, np.median(paths, axis=0), "prior", "median", path is not None)
    _readings(panel, times, data, std)
    top = max(float(data.max()), float(np.quantile(paths, 0.95)) if len(paths) else 0.0)
    bottom = min(float(data.min()), float(np.quantile(paths, 0.05)) if len(paths) else 0.0)
    panel.ylim = bottom - 0.05 * (top - bottom), top + 0.08 * (top - bottom)
    return panel


def withheld_lines(result: StoredResult) -> list[tuple[object, ...]]:
    """A line a reading after the window, on the clock of the data, in display units; none where none follows."""
    if "/withheld" not in result.groups:
        return []
    held = result.groups["/withheld"]
    units = [held[key].attrs["display_units"] for key in ("withheld_time", result.observable)]
    times, *more = _withheld(result)
    file_times = times + shown(held["withheld_time"], zero_of(held["withheld_time"]))
    columns = (values.tolist() for values in (file_times, *more))
    return [
        (units[0], time, units[1], value, low, median, high, int(low <= value <= high))
        for time, value, low, median, high in zip(*columns, strict=True)
    ]


def _withheld(result: StoredResult) -> Iterator[Array]:
    """Times, readings, and the low, median and high of what was expected, each (K,)."""
    name = result.observable
    keys = "withheld_time", name, f"{name}_low", f"{name}_median", f"{name}_high"
    return (shown(result.groups["/withheld"][key]) for key in keys)


def expected(result: StoredResult) -> Chart:
    """Readings after the window over bands of what was expected."""
    held = result.groups["/withheld"]
    times, readings, low, median, high = _withheld(result)
    panel = Panel(time_axis(held["withheld_time"]), axis_label(held[result.observable]), legend=True)
    panel.band(times, low, high, "posterior", 0.3, "expected 90 %")
    panel.line(times, median, "posterior", 0.9, label="median")
    panel.dots(times, readings, "ink", 2.2, label="reading")
    return Chart([Row(5.5 * POINTS, [panel])])
