"""The figures of a report: pure functions from a stored result to a figure in display units, 8.5 cm wide."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from en4dvar.report import fields, readings, varying
from en4dvar.report.history import MANY, history
from en4dvar.report.style import COLUMN, LIGHT, PAGE, Captioned, panels, scaled_histogram, styled
from en4dvar.report.text import estimate, pretty_unit, shown, with_unit
from en4dvar.state import Array
from en4dvar.storage.store import StoredResult

MAX_PAIRS = 6


@styled
def histograms(result: StoredResult) -> Figure:
    """Posterior over prior, one panel a parameter scaled to its peak. Bar: 5–95 %, ticks: members, line: centre."""
    rows = result.summary()
    figure, axes = panels(len(rows), COLUMN, 3.6 / 2.54)
    for ax, row in zip(axes, rows, strict=True):
        prior, posterior = result.members("prior", row.name), result.members("posterior", row.name)
        scaled_histogram(ax, prior, LIGHT["prior"], alpha=0.35)
        scaled_histogram(ax, posterior, LIGHT["posterior"], alpha=0.6)
        marks = ax.plot(posterior, np.full(posterior.shape, -0.06), "|", color=LIGHT["posterior"], ms=3, mew=0.5)
        marks[0].set_rasterized(len(posterior) > MANY)
        if not row.untrusted:
            ax.plot([row.q05, row.q95], [1.07, 1.07], color=LIGHT["posterior"], lw=2, solid_capstyle="butt")
        ax.axvline(row.centre, ymax=0.85, color=LIGHT["centre"], lw=0.9, ls="--")
        ax.set(yticks=[], ylim=(-0.14, 1.2), xlabel=with_unit(row.symbol, row.unit), xlim=_reach(prior, posterior))
        value, doubt = f"{estimate(row, '')} {pretty_unit(row.unit)}".rstrip(), " (?)" if row.untrusted else ""
        ax.set_title(f"{value}{doubt}", color=LIGHT["posterior"])
        ax.spines["left"].set_visible(False)
        ax.xaxis.set_major_locator(MaxNLocator(4))
    return figure


@styled
def residuals(result: StoredResult) -> Figure:
    """Whitened residuals in time, their autocorrelation, normal quantiles, leverages; the discrepancy if any."""
    name, stats = result.observable, result.sample_stats
    time, label = readings.times(result), readings.time_label(result)
    white, studentised, leverage = (
        result.of_readings("sample_stats", key) for key in ("whitened_residual", "studentised", "leverage")
    )
    counts = np.isfinite(white)
    discrepant = f"{name}_discrepancy" in stats
    figure = Figure(figsize=(COLUMN, (13.0 if discrepant else 10.0) / 2.54), layout="constrained")
    grid = figure.add_gridspec(3 if discrepant else 2, 3)
    top, below = figure.add_subplot(grid[0, :]), grid.nrows - 1
    top.axhline(0, color=LIGHT["muted"], lw=0.6)
    for axis, (series, colour) in zip(result.axes, readings.each_series(result), strict=True):
        chosen = series[counts[series]]
        if f"{axis.name}_place" not in result.observed_data:
            top.plot(time[chosen], white[chosen], "-", color=LIGHT["muted"], lw=0.5)
        top.plot(time[chosen], white[chosen], "o", ms=2.2, color=colour)
    top.set(xlabel=label, ylabel="whitened residual")
    readings.name_series(top, result)
    if discrepant:
        _discrepancy(figure.add_subplot(grid[1, :]), result, time, label)
    _autocorrelation(figure.add_subplot(grid[below, 0]), white[counts])
    _quantiles(figure.add_subplot(grid[below, 1]), studentised[counts])
    ax = figure.add_subplot(grid[below, 2])
    for series, colour in readings.each_series(result, "posterior"):
        chosen = series[counts[series]]
        ax.vlines(time[chosen], 0, leverage[chosen], color=colour, lw=0.9)
    ax.set(xlabel=label, ylabel="leverage", ylim=(0, None))
    return figure


@styled
def cost(result: StoredResult) -> Figure:
    """J and its two terms over the iterations; logarithmic where J falls by more than a factor of 20."""
    steps = result.iterations["iteration"].values
    figure = Figure(figsize=(COLUMN, 5.4 / 2.54), layout="constrained")
    ax = figure.subplots()
    lines = (
        ("J", "$J$", "ink", "o-"),
        ("J_observation", "$J_o$ observations", "posterior", "s--"),
        ("J_background", "$J_b$ background", "background", "^:"),
    )
    for key, label, colour, marker in lines:
        ax.plot(steps, result.iterations[key].values, marker, ms=3, color=LIGHT[colour], label=label)
    total = result.iterations["J"].values
    if total.min() > 0 and total.max() > 20 * total.min():
        ax.set_yscale("log", nonpositive="mask")
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.set(xlabel="iteration", ylabel="cost")
    ax.grid(axis="y", lw=0.5)
    ax.legend()
    return figure


@styled
def traces(result: StoredResult) -> Figure:
    """Each parameter over the iterations: mean and middle 68 % of the ensemble of the iterate, and its centre."""
    rows = result.summary()
    steps = result.iterations["iteration"].values
    figure, axes = panels(len(rows), COLUMN, 3.4 / 2.54)
    for ax, row in zip(axes, rows, strict=True):
        members, centre = (shown(result.iterations[key]) for key in (row.name, f"{row.name}_centre"))
        alive = np.isfinite(members).all(axis=0)
        if alive.sum() > 1:
            low, high = np.quantile(members[:, alive], (0.16, 0.84), axis=1)  # of what is positive, positive
            ax.fill_between(steps, low, high, color=LIGHT["posterior"], alpha=0.3, lw=0)
            ax.plot(steps, members[:, alive].mean(axis=1), color=LIGHT["posterior"])
        ax.plot(steps, centre, "--", color=LIGHT["centre"], lw=0.9)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set(xlabel="iteration", ylabel=with_unit(row.symbol, row.unit))
    return figure


@styled
def pairs(result: StoredResult) -> Figure:
    """Posterior members of every pair of parameters; above the diagonal their correlation."""
    rows = result.summary()
    n = len(rows)
    values = {row.name: result.members("posterior", row.name) for row in rows}
    side = max(COLUMN, min(PAGE, n * 2.7 / 2.54))
    figure = Figure(figsize=(side, side), layout="constrained")
    grid = figure.subplots(n, n, squeeze=False)
    for i, row in enumerate(rows):
        for j, column in enumerate(rows):
            _pair(grid[i, j], i, j, values[column.name], values[row.name])
            if i == n - 1:
                grid[i, j].set_xlabel(with_unit(column.symbol, column.unit))
            if j == 0 and i > 0:
                grid[i, j].set_ylabel(with_unit(row.symbol, row.unit))
            grid[i, j].tick_params(labelbottom=i == n - 1, labelleft=j == 0 and i > 0)
    figure.align_labels()
    return figure


def all_figures(result: StoredResult) -> Iterator[Captioned]:
    """Everything that the result has enough members for."""
    named = bool(result.posterior.data_vars)
    if named:
        yield (
            "posterior",
            "Posterior (blue) over prior (grey), each scaled to its peak. Bar: 5–95 % of the posterior, none and (?) "
            "where it is not to be trusted; ticks: members; dashed: the centre, where J is smallest.",
            histograms(result),
        )
    if fields.stored_fields(result)[1]:
        yield "fields", fields.CAPTION, fields.maps(result)
    yield (
        "history",
        "Data with their standard deviation, noise-free predictions of the prior and posterior ensembles (bands hold "
        "50 and 90 % of the members) and of the centre (line through its values at the observation times). Below: "
        "residual of the centre over its standard deviation."
        + (" Each series has its own panels." if len(result.axes) > 1 else ""),
        history(result),
    )
    if varying.stored_walks(result):
        yield (
            "varying",
            "What varies in time: median and 5–95 % of the posterior (blue) over 5–95 % of the prior (grey).",
            varying.bands(result),
        )
    if f"{result.observable}_whitened_residual" in result.sample_stats:
        yield (
            "residuals",
            "Residuals of the centre, whitened: in time (below it a discrepancy, mean ± std), their "
            "autocorrelation (band: 95 % of independent numbers), against normal quantiles; leverages.",
            residuals(result),
        )
    if f"{result.observable}_prior_distance" in result.sample_stats:
        yield "influence", readings.CAPTION, readings.influence(result)
    if np.isfinite(result.iterations["J"]).any():
        yield "cost", "The cost J and its two terms at the iterate that starts each iteration.", cost(result)
    if named:
        yield (
            "iterations",
            "Parameters over the iterations: ensemble mean and middle 68 % (blue), centre (dashed).",
            traces(result),
        )
    if 2 <= len(result.posterior.data_vars) <= MAX_PAIRS and result.alive.sum() > 2:
        yield "pairs", "Posterior members in pairs of parameters; above the diagonal the correlation.", pairs(result)


def _discrepancy(ax: Axes, result: StoredResult, time: Array, label: str) -> None:
    """Data less the centre, and mean ± std of what the model misses."""
    name, stats = result.observable, result.sample_stats
    residual = shown(result.observed_data[name]) - shown(stats[f"{name}_centre"])
    mean, std = shown(stats[f"{name}_discrepancy"]), shown(stats[f"{name}_discrepancy_std"])
    ax.axhline(0, color=LIGHT["muted"], lw=0.6)
    ax.fill_between(time, mean - std, mean + std, color=LIGHT["posterior"], alpha=0.35, lw=0, label="discrepancy ± std")
    ax.plot(time, residual, "o", ms=2.2, color=LIGHT["ink"], label="data − centre")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    ax.set(xlabel=label, ylabel=with_unit("residual", str(stats[f"{name}_discrepancy"].attrs["display_units"])))


def _autocorrelation(ax: Axes, white: Array) -> None:
    lags = max(1, min(15, len(white) // 3))
    correlation = [float(white[lag:] @ white[:-lag]) / float(white @ white) for lag in range(1, lags + 1)]
    limit = 1.96 / np.sqrt(len(white))
    ax.axhspan(-limit, limit, color=LIGHT["posterior"], alpha=0.16, lw=0)
    ax.axhline(0, color=LIGHT["muted"], lw=0.6)
    ax.vlines(np.arange(1, lags + 1), 0, correlation, color=LIGHT["ink"], lw=1.2)
    ax.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    ax.set(xlabel="lag", ylabel="autocorrelation", ylim=(min(-0.6, *correlation), max(1.0, *correlation)))


def _quantiles(ax: Axes, values: Array) -> None:
    from scipy.special import ndtri

    expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
    reach = float(np.max(np.abs(expected))) * 1.1
    ax.plot([-reach, reach], [-reach, reach], color=LIGHT["muted"], lw=0.6)
    ax.plot(expected, np.sort(values), "o", ms=2, color=LIGHT["ink"])
    ax.set(xlabel="normal quantile", ylabel="residual / std")


def _reach(prior: Array, posterior: Array) -> tuple[float | None, float | None]:
    """Limits that hold the posterior and 90 % of the prior: a long tail of the prior does not flatten the picture."""
    ends = [*np.quantile(prior, (0.05, 0.95)), *posterior] if prior.size else list(posterior)
    low, high = (min(ends), max(ends)) if ends else (0.0, 0.0)
    margin = 0.05 * (high - low)
    return (low - margin, high + margin) if margin > 0 else (None, None)


def _pair(ax: Axes, i: int, j: int, x: Array, y: Array) -> None:
    ax.xaxis.set_major_locator(MaxNLocator(2))
    ax.yaxis.set_major_locator(MaxNLocator(3))
    if i == j:
        scaled_histogram(ax, x, LIGHT["posterior"], alpha=0.6)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    elif i > j:
        ax.plot(x, y, "o", ms=2, color=LIGHT["posterior"], alpha=0.7, mew=0, rasterized=len(x) > MANY)
    else:
        ax.set_axis_off()
        known = np.ptp(x) > 0 and np.ptp(y) > 0
        correlation = float(np.corrcoef(x, y)[0, 1]) if known else float("nan")
        text = f"{correlation:+.2f}".replace("-", "−") if known else "–"
        ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes)
