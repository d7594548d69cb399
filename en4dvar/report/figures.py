"""The figures of a report: pure functions from a stored result to a chart in display units, 8.5 cm wide; with them what
varies in time: rows of a table, and what the evidence says of a change.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import untrusted
from en4dvar.priors.field_prior import regular_grid
from en4dvar.report import responses
from en4dvar.report.chart import COLUMN, GREYS, PAGE, POINTS, VIRIDIS, Chart, Panel, Row, in_columns, interval, ramp
from en4dvar.report.history import WITHHELD, expected, history
from en4dvar.report.svg import Captioned
from en4dvar.report.text import axis_label, estimate, shown, unit_behind, with_unit
from en4dvar.results.netcdf import Group
from en4dvar.results.store import StoredResult

MAX_PAIRS = 6
NINETY = 1.6448536  # standard score of the 95 % quantile
WIDER = 3  # spans of the posterior by which the prior is seen to either side of it
LEVELS = 32  # colours of a map
BAND = (0.05, 0.5, 0.95)
PIECES, PIECE = "_pieces", "_piece"  # end the names of the values and of their dimension
PIECE_COLUMNS = ("parameter", "time_unit", "begin", "end", "unit", "q05", "q50", "q95", "prior_q05", "prior_q95")


def histograms(result: StoredResult) -> Chart:
    """Posterior over prior, one panel a parameter scaled to its peak. Bar: 5–95 %, ticks: members, line: centre."""
    panels = []
    for row in result.rows:
        exact, posterior = _prior_density(result, row.name), result.members("posterior", row.name)
        prior = result.members("prior", row.name)
        value = f"{estimate(row, '')}{unit_behind(row.unit)}"
        doubt = "\nnot to be trusted" if row.untrusted else ""
        panel = Panel(
            with_unit(row.symbol, row.unit), title=f"{value}{doubt}", title_colour="posterior", xticks=4, yticks=(),
            left=False, xlim=_reach(prior, posterior), ylim=(-0.14, 1.2),
        )  # fmt: skip
        if exact is None:
            panel.histogram(prior, "prior", alpha=0.35)
        else:
            panel.band(*exact, "prior", 0.35)
        panel.histogram(posterior, "posterior", alpha=0.6)
        panel.dots(posterior, np.full(posterior.shape, -0.06), "posterior", 3.0, kind="ticks")
        if not row.untrusted:
            panel.line([row.q05, row.q95], [1.07, 1.07], "posterior", 2.0)
        panel.upright(row.centre, "centre", dash="--")
        panels.append(panel)
    return in_columns(panels, 3.6 * POINTS, width=COLUMN)


def _prior_density(result: StoredResult, name: str) -> tuple[Array, Array, Array] | None:
    """Of the prior itself, whatever its map: values, zeros and density, scaled to its peak; None where not stored."""
    stats = result.group("sample_stats")
    if "prior_value" not in stats:
        return None
    from scipy.special import ndtr

    place = stats["parameter"].values.tolist().index(name)
    values = shown(result.parameters[name], stats["prior_value"].values[place])
    values, own = np.unique(values, return_index=True)  # beside a bound some are equal to rounding
    density = np.diff(ndtr(stats["prior_score"].values[own])) / np.diff(values)
    x = np.concatenate([values[:1], values[:-1] + np.diff(values) / 2, values[-1:]])
    density = np.concatenate([density[:1], density, density[-1:]]) / density.max()
    return x, np.zeros_like(x), density


def prior_interval(result: StoredResult, name: str) -> tuple[float, float]:
    """5 and 95 % of a prior, in its display unit: of the prior itself, and of its members where it is not stored."""
    stats, prior = result.group("sample_stats"), result.members("prior", name)
    if "prior_value" in stats:
        place = stats["parameter"].values.tolist().index(name)
        values = shown(result.parameters[name], stats["prior_value"].values[place])
        ends = np.interp((-NINETY, NINETY), stats["prior_score"].values, values)
    else:
        ends = member_quantiles(prior, (0.05, 0.95)) if prior.size else np.full(2, np.nan)
    return float(ends[0]), float(ends[1])


def residuals(result: StoredResult) -> Chart:
    """Whitened residuals in time, their autocorrelation, normal quantiles, leverages; the discrepancy if any."""
    time, label = responses.times(result), responses.time_label(result)
    observed = result.group("observed_data")
    keys = "whitened_residual", "studentised", "leverage"
    white, studentised, leverage = (result.of_readings("sample_stats", key) for key in keys)
    counts = np.isfinite(white)
    top = Panel(label, "residual / std", legend=len(result.axes) > 1)
    top.rule(0)
    for axis, (series, colour) in zip(result.axes, responses.each_series(result), strict=True):
        chosen = series[counts[series]]
        if f"{axis.name}_place" not in observed:
            top.line(time[chosen], white[chosen], "muted", 0.5)
        top.dots(time[chosen], white[chosen], colour, label=axis.name)
    rows = [Row(5.0 * POINTS, [top])]
    if f"{result.observable}_discrepancy" in result.group("sample_stats"):
        rows.append(Row(4.4 * POINTS, [_discrepancy(result, time, label)]))
    levers = Panel(label, "leverage", xticks=3, ylim=(0.0, 1.05 * float(np.nanmax(leverage, initial=1e-3))))
    for series, colour in responses.each_series(result, "posterior"):
        chosen = series[counts[series]]
        levers.bars(time[chosen], 0, leverage[chosen], colour, 0.9)
    below = [_autocorrelation(white[counts]), _quantiles(studentised[counts]), levers]
    return Chart([*rows, Row(5.0 * POINTS, below)])


def cost(result: StoredResult) -> Chart:
    """J and its two terms over the iterations; logarithmic where J falls by more than a factor of 20."""
    held = result.group("iterations")
    steps, total = held["iteration"].values, held["J"].values
    steep = bool(total.min() > 0 and total.max() > 20 * total.min())
    panel = Panel("iteration", "cost", xticks=6, whole=True, logarithmic=steep, grid=True, legend=True)
    lines = (
        ("J", "$J$", "ink", ""),
        ("J_observation", "$J_o$ observations", "posterior", "--"),
        ("J_background", "$J_b$ background", "background", ":"),
    )
    for key, label, colour, dash in lines:
        panel.line(steps, held[key].values, colour, dash=dash, label=label)
        panel.dots(steps, held[key].values, colour, 3.0, label=label)
    return Chart([Row(5.4 * POINTS, [panel])])


def traces(result: StoredResult) -> Chart:
    """Each parameter over the iterations: mean and middle 68 % of the ensemble of the iterate, and its centre."""
    held, panels = result.group("iterations"), []
    steps = held["iteration"].values
    for row in result.rows:
        panel = Panel("iteration", with_unit(row.symbol, row.unit), whole=True, yticks=4)
        members, centre = (shown(held[key]) for key in (row.name, f"{row.name}_centre"))
        alive = np.isfinite(members).all(axis=0)
        if alive.sum() > 1:
            low, high = member_quantiles(members[:, alive], (0.16, 0.84), axis=1)  # of what is positive, positive
            panel.band(steps, low, high, "posterior", 0.3)
            panel.line(steps, members[:, alive].mean(axis=1), "posterior")
        panel.line(steps, centre, "centre", 0.9, "--")
        panels.append(panel)
    return in_columns(panels, 3.4 * POINTS, width=COLUMN)


def pairs(result: StoredResult) -> Chart:
    """Posterior members of every pair of parameters; above the diagonal their correlation, on its colour."""
    rows = result.rows
    side = max(COLUMN, min(PAGE, len(rows) * 2.7 * POINTS))
    values = {row.name: result.members("posterior", row.name) for row in rows}
    lines = []
    for i, row in enumerate(rows):
        panels = [_pair(i, j, values[column.name], values[row.name]) for j, column in enumerate(rows)]
        panels[0].ylabel = with_unit(row.symbol, row.unit) if i else ""
        for j, (panel, column) in enumerate(zip(panels, rows, strict=True)):
            panel.x_numbers, panel.y_numbers = i == len(rows) - 1, j == 0
            panel.xlabel = with_unit(column.symbol, column.unit) if panel.x_numbers else ""
        lines.append(Row(side / len(rows), panels))
    return Chart(lines, side)


def maps(result: StoredResult) -> Chart:
    """Each field: a line with its band, or two maps, each over the scale of its colours."""
    data = result.groups["/fields"]
    rows: list[Row] = []
    for name in (name.removesuffix("_at") for name in data.variables if name.endswith("_at")):
        at = data[f"{name}_at"].values
        if at.shape[1] == 1:
            rows.append(Row(5.6 * POINTS, [_line(data, name, at[:, 0])]))
            continue
        mean = shown(data[f"{name}_mean"])
        share = data[f"{name}_std"].values / data[f"{name}_prior_std"].values
        low, high = float(mean.min()), float(mean.max())
        of_mean = _map(at, mean, (low, high if high > low else low + 1.0), VIRIDIS, axis_label(data[name]))
        of_share = _map(at, share, (0.0, 1.0), GREYS, "posterior / prior std")
        tall = float(np.ptp(at[:, 0]) / np.ptp(at[:, 1])) if np.ptp(at[:, 1]) > 0 else 1.0
        rows.append(Row(min(max(tall, 0.3), 2.0) * 0.4 * COLUMN + 0.7 * POINTS, [of_mean[0], of_share[0]]))
        rows.append(Row(1.4 * POINTS, [of_mean[1], of_share[1]]))
    return Chart(rows)


def _line(data: Group, name: str, at: Array) -> Panel:
    order = np.argsort(at)
    positive = not np.any(data[name].values <= 0)
    panel = Panel(with_unit("place", str(data[f"{name}_at"].attrs["units"])), axis_label(data[name]))
    for kind, colour in (("prior_", "prior"), ("", "posterior")):
        mean, std = (shown(data[f"{name}_{kind}{what}"])[order] for what in ("mean", "std"))
        panel.band(at[order], *interval(mean, std, 1, positive), colour, 0.3)
        panel.line(at[order], mean, colour)
    return panel


def _map(
    at: Array, values: Array, scale: tuple[float, float], colours: Sequence[str], label: str
) -> tuple[Panel, Panel]:
    """Values (n,) at the first two coordinates of places ``at`` (n, D), the first of them downwards, and the scale."""
    grid = regular_grid(at[:, :2])
    down, across = grid[1] if grid else (0.0, 0.0)
    (top, left), (bottom, right) = at[:, :2].min(axis=0), at[:, :2].max(axis=0)
    panel = Panel(xticks=3, yticks=3)
    panel.xlim, panel.ylim = (left - across / 2, right + across / 2), (bottom + down / 2, top - down / 2)
    low, high = scale
    level = np.clip(((values - low) / (high - low) * LEVELS).astype(int), 0, LEVELS - 1)
    bar, width = Panel(label, xlim=scale, ylim=(0.0, 1.0), yticks=(), left=False, xticks=4), (high - low) / LEVELS
    for k in range(LEVELS):
        own, colour = at[level == k], ramp(colours, k / (LEVELS - 1))
        bar.tiles([low + (k + 0.5) * width], [0.5], (width, 1.0), colour)
        if len(own) and grid:
            panel.tiles(own[:, 1], own[:, 0], (across, down), colour)
        elif len(own):
            panel.dots(own[:, 1], own[:, 0], colour, 2.0)
    return panel, bar


def _discrepancy(result: StoredResult, time: Array, label: str) -> Panel:
    """Data less the centre, and mean ± std of what the model misses."""
    name, stats = result.observable, result.group("sample_stats")
    residual = shown(result.group("observed_data")[name]) - shown(stats[f"{name}_centre"])
    mean, std = shown(stats[f"{name}_discrepancy"]), shown(stats[f"{name}_discrepancy_std"])
    panel = Panel(label, axis_label(stats[f"{name}_discrepancy"], "residual"), legend=True)
    panel.rule(0)
    panel.band(time, mean - std, mean + std, "posterior", 0.35, "discrepancy ± std")
    panel.dots(time, residual, "ink", label="data − centre")
    return panel


def neighbours(white: Array) -> tuple[Array, float]:
    """Correlation of residuals (K,) that lie 1, 2, … apart, and what 95 % of independent ones do not exceed."""
    lags = max(1, min(15, len(white) // 3)) if len(white) > 1 else 0
    size, limit = float(white @ white) or 1.0, 1.96 / math.sqrt(len(white) or 1)
    return np.array([float(white[lag:] @ white[:-lag]) / size for lag in range(1, lags + 1)]), limit


def _autocorrelation(white: Array) -> Panel:
    correlation, limit = neighbours(white)
    ylim = min((-0.6, *correlation)), max((1.0, *correlation))
    panel = Panel("readings apart", "correlation", xticks=4, whole=True, ylim=ylim)
    panel.span(-limit, limit, "posterior", 0.16)
    panel.rule(0)
    panel.bars(np.arange(1, len(correlation) + 1), 0, correlation, "ink", 1.2)
    return panel


def _quantiles(values: Array) -> Panel:
    from scipy.special import ndtri

    expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
    reach = float(np.max(np.abs(expected))) * 1.1
    panel = Panel("normal quantile", "residual / std", xticks=4)
    panel.line([-reach, reach], [-reach, reach], "muted", 0.6)
    panel.dots(expected, np.sort(values), "ink", 2.0)
    return panel


def _reach(prior: Array, posterior: Array) -> tuple[float, float] | None:
    """Limits that hold the posterior and 90 % of the prior, cut where a vague prior would flatten the picture."""
    ends = list(posterior)
    if prior.size:
        known = np.quantile(prior, (0.05, 0.95))
        if ends and (width := float(np.ptp(posterior))) > 0:
            known = np.clip(known, min(ends) - WIDER * width, max(ends) + WIDER * width)
        ends += list(known)
    low, high = (float(min(ends)), float(max(ends))) if ends else (0.0, 0.0)
    margin = 0.05 * (high - low)
    return (low - margin, high + margin) if margin > 0 else None


def _pair(i: int, j: int, x: Array, y: Array) -> Panel:
    panel = Panel(xticks=2, yticks=3)
    if i == j:
        panel.histogram(x, "posterior", alpha=0.6)
        panel.yticks, panel.left = (), False
    elif i > j:
        panel.dots(x, y, "posterior", 2.0, alpha=0.7)
    else:
        known = np.ptp(x) > 0 and np.ptp(y) > 0
        correlation = float(np.corrcoef(x, y)[0, 1]) if known else math.nan
        panel.bare, panel.words = True, f"{correlation:+z.2f}".replace("-", "−") if known else "–"
        panel.ylim = 0.0, 1.0
        panel.span(0.0, 1.0, "centre" if correlation < 0 else "posterior", 0.6 * abs(correlation) if known else 0.0)
    return panel


@dataclass(frozen=True)
class StoredWalk:
    """A parameter over m + 1 pieces in display units: ``edges`` (m + 2,), quantiles (3, m + 1), of the posterior no
    outer ones (NaN) where the interval is not to be trusted.
    """

    name: str
    label: str
    symbol: str
    unit: str
    time_unit: str
    edges: Array
    posterior: Array
    prior: Array

    @property
    def cells(self) -> list[tuple[object, ...]]:
        """A line a piece, in the order of :data:`PIECE_COLUMNS`."""
        rows = zip(self.edges, self.edges[1:], self.posterior.T, self.prior[[0, 2]].T, strict=False)
        return [
            (self.name, self.time_unit, float(begin), float(end), self.unit, *map(float, after), *map(float, before))
            for begin, end, after, before in rows
        ]


def stored_walks(result: StoredResult) -> tuple[StoredWalk, ...]:
    """The parameters that vary."""
    of_pieces = [v.dims[2] for v in result.groups["/posterior"].variables.values() if len(v.dims) == 3]
    return tuple(_stored_walk(result, dim.removesuffix(PIECE)) for dim in of_pieces)


def _stored_walk(result: StoredResult, name: str) -> StoredWalk:
    posterior = result.groups["/posterior"]
    pieces, time = posterior.variables[name + PIECES], posterior.coords[name + PIECE]
    begins = np.asarray(time.values, dtype=float)
    last = max(float(result.groups["/observed_data"][axis.time].values[-1]) for axis in result.axes)
    edges = np.append(begins, max(last, begins[-1] + 0.02 * (begins[-1] - begins[0])))

    def quantiles(group: str) -> Array:
        values = np.asarray(result.groups[f"/{group}"].variables[name + PIECES].values[0], dtype=float)
        values = values[(result.alive | (group != "posterior")) & np.isfinite(values).all(axis=1)]
        there = values if len(values) else np.full((1, len(begins)), np.nan)
        return shown(pieces, member_quantiles(there, BAND, axis=0))

    after = quantiles("posterior")
    if untrusted(result.cautions, name):
        after[[0, 2]] = np.nan  # the interval
    label = str(posterior.variables[name].attrs["long_name"])
    units = pieces.attrs["display_units"], time.attrs["display_units"]
    return StoredWalk(name, label, pieces.attrs["symbol"], *units, shown(time, edges), after, quantiles("prior"))


def steps(edges: Array, values: Array) -> tuple[Array, Array]:
    """A line (2 m,) through m values, each constant between two of the m + 1 ``edges``."""
    return np.repeat(edges, 2)[1:-1], np.repeat(values, 2)


def bands(result: StoredResult) -> Chart:
    """Median and 5–95 % of each parameter that varies, over the prior's."""
    rows = []
    for walk in stored_walks(result):
        least, most = float(np.nanmin(walk.posterior)), float(np.nanmax(walk.prior))
        steep = min(least, np.nanmin(walk.prior)) > 0 and math.isfinite(most) and most > 5 * least
        labels = responses.time_label(result), with_unit(walk.symbol, walk.unit)
        panel = Panel(*labels, logarithmic=steep, legend=True)
        for quantiles, colour, alpha in ((walk.prior, "prior", 0.3), (walk.posterior, "posterior", 0.35)):
            (x, low), (_, high) = (steps(walk.edges, quantiles[i]) for i in (0, 2))
            panel.band(x, low, high, colour, alpha, colour)
        panel.line(*steps(walk.edges, walk.posterior[1]), "posterior", label="median")
        rows.append(Row(5.0 * POINTS, [panel]))
    return Chart(rows)


# name, caption, where there is enough to draw it, and what does; ``{several}`` is said of several series
FIGURES: tuple[tuple[str, str, Callable[[StoredResult], Any], Callable[[StoredResult], Chart]], ...] = (
    ("posterior",
     "What is known after the readings (posterior, blue) and what was before (prior, grey), each scaled to its "
     "peak. Bar: the 90 % interval; a number whose interval must not be quoted, because of a warning, has no bar "
     "and says so. Ticks: the members of the posterior ensemble. Dashed: the best fit.",
     lambda result: result.parameters, histograms),
    ("fields",
     "Fields of the initial state: posterior mean, and posterior over prior standard deviation (1: the data say "
     "nothing about the cell); for a field along a line, mean and std of the posterior (blue) over those of the prior "
     "(grey).",
     lambda result: "/fields" in result.groups, maps),
    ("history",
     "Readings with their standard deviation; what was possible before them (prior, grey) and after them "
     "(posterior, blue: bands of 50 and 90 %, without the errors of readings); the best fit (line through its "
     "values at the readings). Below: reading minus best fit, in standard deviations of the reading.{several}",
     lambda result: True, history),
    ("withheld", WITHHELD, lambda result: "/withheld" in result.groups, expected),
    ("varying", "What varies in time: median and 5–95 % of the posterior (blue) over 5–95 % of the prior (grey).",
     stored_walks, bands),
    ("residuals",
     "Residuals of the best fit, in standard deviations and without the correlation of their errors "
     "(whitened): in time (below it any discrepancy, mean ± std); their correlation with those 1, 2, … readings "
     "later (band: 95 % of independent numbers); against normal quantiles; leverage, the share of each "
     "reading in its own prediction.",
     lambda result: len(responses.whitened(result)), residuals),
    ("influence", responses.CAPTION,
     lambda result: f"{result.observable}_prior_distance" in result.group("sample_stats"), responses.influence),
    ("cost", "The cost J and its two terms at the iterate that starts each iteration.",
     lambda result: np.isfinite(result.group("iterations")["J"].values).any(), cost),
    ("iterations", "Parameters over the iterations: ensemble mean and middle 68 % (blue), centre (dashed).",
     lambda result: result.parameters, traces),
    ("pairs",
     "Posterior members in pairs of parameters. Above the diagonal their correlation, the stronger the deeper its "
     "colour (blue: positive, orange: negative).",
     lambda result: 2 <= len(result.parameters) <= MAX_PAIRS and result.alive.sum() > 2, pairs),
)  # fmt: skip


def all_figures(result: StoredResult) -> Iterator[Captioned]:
    """Everything that the result has enough members for."""
    several = " Each series has its own panels." if len(result.axes) > 1 else ""
    for name, caption, there, chart in FIGURES:
        if there(result):
            yield name, caption.format(several=several), chart(result)
