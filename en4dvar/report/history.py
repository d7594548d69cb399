"""Data over what was predicted, one pair of panels a series: in time, or over the places where a field was read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from en4dvar.report.style import COLUMN, LIGHT, styled
from en4dvar.report.text import shown, with_unit
from en4dvar.state import Array
from en4dvar.storage.axes import Axis
from en4dvar.storage.store import StoredResult

MANY = 5000  # marks: beyond, they are drawn as pixels, for a vector each would make a page of many megabytes
FEW = 150  # readings whose marks are large


@dataclass(frozen=True)
class Band:
    """Between two quantiles of the members of a group, and how that is drawn."""

    group: str
    levels: tuple[float, float]
    colour: str
    alpha: float
    label: str


BANDS = (
    Band("prior_predictive", (0.05, 0.95), "prior", 0.28, "prior 90 %"),
    Band("posterior_predictive", (0.05, 0.95), "posterior", 0.3, "posterior 90 %"),
    Band("posterior_predictive", (0.25, 0.75), "posterior", 0.6, "posterior 50 %"),
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
    def of(cls, result: StoredResult, axis: Axis) -> SeriesShown:
        observed, name = result.observed_data, axis.name
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
        return cls(axis, x, x_label, data, std, shown(result.sample_stats[f"{name}_centre"]), label)


@styled
def history(result: StoredResult) -> Figure:
    """Data ± std, prior and posterior predictive bands (50 and 90 %), the centre; below, residuals over their std."""
    axes = result.axes
    height = 9.5 if len(axes) == 1 else 7.0 * len(axes)
    figure = Figure(figsize=(COLUMN, height / 2.54), layout="constrained")
    if len(axes) == 1:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        _pair(top, bottom, result, SeriesShown.of(result, axes[0]))
        _legend(top)
        return figure
    for i, (part, axis) in enumerate(zip(figure.subfigures(len(axes), 1, squeeze=False).ravel(), axes, strict=True)):
        top, bottom = part.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        _pair(top, bottom, result, SeriesShown.of(result, axis))
        top.set_title(axis.name, loc="left", fontsize=8)
        if i == 0:
            handles, labels = top.get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper center", ncols=3, columnspacing=1.2, handlelength=1.4)
    return figure


def _legend(top: Axes) -> None:
    top.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, columnspacing=1.2, handlelength=1.4)


def _pair(top: Axes, bottom: Axes, result: StoredResult, one: SeriesShown) -> None:
    """Data and predictions above, residuals below."""
    curve = f"{one.axis.name}_path" in result.dataset("prior_predictive")
    for band in BANDS:
        (_along if curve else _bars)(top, result, one, band)
    size, many = 2.2 if len(one.x) <= FEW else 1.2, len(one.x) > MANY
    if many:  # one path instead of a bar for each, and pixels below the centre
        edges = one.data - one.std, one.data + one.std
        filled = top.fill_between(one.x, *edges, color=LIGHT["ink"], alpha=0.3, lw=0, label="data ± std")
        filled.set_rasterized(True)
        top.plot(one.x, one.data, ",", alpha=0.3, color=LIGHT["ink"], zorder=1.5, rasterized=True)
    else:
        top.errorbar(
            one.x, one.data, one.std, fmt="o", ms=size, lw=0.6, color=LIGHT["ink"], label="data ± std", zorder=4
        )
    if curve:
        top.plot(one.x, one.centre, lw=0.9, color=LIGHT["centre"], label="centre", zorder=3, rasterized=many)
    else:
        top.plot(one.x, one.centre, "_", ms=5, color=LIGHT["centre"], label="centre", zorder=5)
    top.set_ylabel(one.label)
    top.set_ylim(_data_range(one.data, one.std))
    _residuals(bottom, one, size, many)


def _residuals(ax: Axes, one: SeriesShown, size: float, many: bool) -> None:
    residual = (one.data - one.centre) / one.std
    for limit, alpha in ((2, 0.12), (1, 0.16)):
        ax.axhspan(-limit, limit, color=LIGHT["posterior"], alpha=alpha, lw=0)
    ax.axhline(0, color=LIGHT["muted"], lw=0.6)
    ax.plot(one.x, residual, "," if many else "o", ms=size, color=LIGHT["ink"], rasterized=many)
    reach = 1.15 * max(3.0, float(np.max(np.abs(residual))))
    first, last = float(one.x.min()), float(one.x.max())
    span = (last - first) or max(abs(first), 1.0)
    ax.set(ylim=(-reach, reach), ylabel="residual / std", xlim=(first - 0.03 * span, last + 0.03 * span))
    if reach < 8:
        ax.set_yticks([-2, 0, 2])
    else:
        ax.yaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel(one.x_label)


def _along(ax: Axes, result: StoredResult, one: SeriesShown, band: Band) -> None:
    """Quantiles of the members along the path."""
    held = result.dataset(band.group)
    values = shown(held[f"{one.axis.name}_path"][0])
    seen = np.isfinite(values).any(axis=0)
    if not seen.any():
        return
    low, high = np.nanquantile(values[:, seen], band.levels, axis=0)
    time = shown(held["path_time"])[seen]
    ax.fill_between(time, low, high, color=LIGHT[band.colour], alpha=band.alpha, lw=0, label=band.label)


def _bars(ax: Axes, result: StoredResult, one: SeriesShown, band: Band) -> None:
    """Quantiles of the members at each reading of a field."""
    values = shown(result.dataset(band.group)[one.axis.name][0])
    alive = np.isfinite(values).all(axis=1)
    if not alive.any():
        return
    low, high = np.quantile(values[alive], band.levels, axis=0)
    width = 4 if len(one.x) <= FEW else 2
    ax.vlines(one.x, low, high, color=LIGHT[band.colour], alpha=band.alpha, lw=width, label=band.label)


def _data_range(data: Array, std: Array) -> tuple[float, float]:
    """Limits of the data with room around: a wide prior must not shrink them to a line."""
    low, high = float((data - std).min()), float((data + std).max())
    below = low - 0.12 * (high - low)
    return max(0.0, below) if data.min() >= 0 else below, high + 0.25 * (high - low)
