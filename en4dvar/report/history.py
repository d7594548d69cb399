"""Data over what was predicted, one pair of panels a series: in time, or over the places where a field was read."""

from dataclasses import dataclass

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.model.state import Array
from en4dvar.report.chart import POINTS, Chart, Panel, Row
from en4dvar.report.text import shown, with_unit
from en4dvar.results.declared import Axis
from en4dvar.results.store import StoredResult

MANY = 5000  # readings: beyond, their bars are one band
FEW = 150  # readings whose marks are large


BANDS = (  # group of the members, two of their quantiles, and how what lies between is drawn
    ("prior_predictive", (0.05, 0.95), "prior", 0.28, "prior 90 %"),
    ("posterior_predictive", (0.05, 0.95), "posterior", 0.3, "posterior 90 %"),
    ("posterior_predictive", (0.25, 0.75), "posterior", 0.6, "posterior 50 %"),
)


@dataclass(frozen=True)
class SeriesShown:
    """One series in display units: ``x`` (K,) times or places, ``data``, ``std`` and ``centre`` (K,)."""

    axis: Axis
    x: Array
    x_label: str
    data: Array
    std: Array
    centre: Array
    label: str

    @classmethod
    def of(cls, result: StoredResult, axis: Axis) -> "SeriesShown":
        observed, name = result.group("observed_data"), axis.name
        data, std = shown(observed[name]), shown(observed[f"{name}_std"])
        x, x_label = shown(observed[axis.time]), with_unit("time", observed[axis.time].attrs["display_units"])
        places = np.asarray(observed[f"{name}_place"].values) if f"{name}_place" in observed else np.empty(0)
        if len(np.unique(places)) > len(np.unique(x)):
            x = places
            x_label = with_unit("place", str(observed[f"{name}_place"].attrs["units"]))
        attrs = observed[name].attrs
        label = str(attrs["long_name"]).removesuffix(", observed")
        label = label if label == attrs["symbol"] else f"{label} {attrs['symbol']}"
        label = with_unit(label, attrs["display_units"])
        return cls(axis, x, x_label, data, std, shown(result.group("sample_stats")[f"{name}_centre"]), label)

    @property
    def size(self) -> float:
        """Of a dot."""
        return 2.2 if len(self.x) <= FEW else 1.2

    @property
    def reach(self) -> tuple[float, float]:
        """Limits along x."""
        first, last = float(self.x.min()), float(self.x.max())
        span = (last - first) or max(abs(first), 1.0)
        return first - 0.03 * span, last + 0.03 * span


def history(result: StoredResult) -> Chart:
    """Data ± std, prior and posterior predictive bands (50 and 90 %), the centre; below, residuals over their std."""
    several = len(result.axes) > 1
    high, low = (5.0, 2.3) if several else (6.8, 2.7)
    rows = []
    for i, axis in enumerate(result.axes):
        series = SeriesShown.of(result, axis)
        top = Panel(
            ylabel=series.label, title=axis.name if several else "", xlim=series.reach,
            ylim=_data_range(series.data, series.std), x_numbers=False, legend=i == 0,
        )  # fmt: skip
        _data(top, result, series)
        rows += [Row(high * POINTS, [top]), Row(low * POINTS, [_residuals(series)])]
    return Chart(rows)


def _data(panel: Panel, result: StoredResult, series: SeriesShown) -> None:
    """Data and predictions: along the path, or at each reading of a field."""
    name = series.axis.name
    curve = f"{name}_path" in result.group("prior_predictive")
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
            panel.bars(series.x, low, high, colour, 4.0 if len(series.x) <= FEW else 2.0, alpha, label)
    if curve:
        panel.line(series.x, series.centre, "centre", 0.9, label="best fit")
    else:
        panel.dots(series.x, series.centre, "centre", 5.0, label="best fit", kind="dashes")
    if len(series.x) > MANY:  # one outline instead of a bar for each
        panel.band(series.x, series.data - series.std, series.data + series.std, "ink", 0.3, "data ± std")
    else:
        panel.bars(series.x, series.data - series.std, series.data + series.std, "ink", 0.6, label="data ± std")
    panel.dots(series.x, series.data, "ink", series.size, label="data ± std")


def _residuals(series: SeriesShown) -> Panel:
    residual = (series.data - series.centre) / series.std
    reach = 1.15 * max(3.0, float(np.max(np.abs(residual))))
    panel = Panel(series.x_label, "residual / std", xlim=series.reach, ylim=(-reach, reach))
    panel.yticks = (-2, 0, 2) if reach < 8 else 4
    for limit, alpha in ((2, 0.12), (1, 0.16)):
        panel.span(-limit, limit, "posterior", alpha)
    panel.rule(0)
    panel.dots(series.x, residual, "ink", series.size)
    return panel


def _data_range(data: Array, std: Array) -> tuple[float, float]:
    """Limits of the data with room around: a wide prior must not shrink them to a line."""
    low, high = float((data - std).min()), float((data + std).max())
    below = low - 0.12 * (high - low)
    return max(0.0, below) if data.min() >= 0 else below, high + 0.25 * (high - low)
