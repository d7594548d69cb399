"""Fields that were estimated cell by cell: maps of what they are and of how much the data narrowed them."""

from collections.abc import Sequence

import numpy as np

from en4dvar.model.state import Array
from en4dvar.priors.field_prior import regular_grid
from en4dvar.report.chart import COLUMN, POINTS, Chart, Panel, Row, interval
from en4dvar.report.palette import GREYS, VIRIDIS, ramp
from en4dvar.report.text import axis_label, shown, with_unit
from en4dvar.results.netcdf import Group
from en4dvar.results.store import StoredResult

LEVELS = 32  # colours of a map
CAPTION = (
    "Fields of the initial state: posterior mean, and posterior over prior standard deviation (1: the data say nothing "
    "about the cell); for a field along a line, mean and std of the posterior (blue) over those of the prior (grey)."
)


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
    for k in range(LEVELS):
        own, colour = at[level == k], ramp(colours, k / (LEVELS - 1))
        if len(own) and grid:
            panel.tiles(own[:, 1], own[:, 0], (across, down), colour)
        elif len(own):
            panel.dots(own[:, 1], own[:, 0], colour, 2.0)
    bar = Panel(label, xlim=scale, ylim=(0.0, 1.0), yticks=(), left=False, xticks=4)
    width = (high - low) / LEVELS
    for k in range(LEVELS):
        bar.tiles([low + (k + 0.5) * width], [0.5], (width, 1.0), ramp(colours, k / (LEVELS - 1)))
    return panel, bar
