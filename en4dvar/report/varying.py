"""Parameters that vary in time, read from a result: bands, rows of a table, and what the evidence says of a change."""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.diagnosis.diagnostics import change_words, member_quantiles
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import untrusted
from en4dvar.report.chart import POINTS, Chart, Panel, Row, steps
from en4dvar.report.text import shown, with_unit
from en4dvar.results.store import StoredResult

LEVELS = (0.05, 0.5, 0.95)
PIECES, PIECE = "_pieces", "_piece"  # end the names of the values and of their dimension
PIECE_COLUMNS = ("parameter", "time_unit", "begin", "end", "unit", "q05", "q50", "q95", "prior_q05", "prior_q95")


@dataclass(frozen=True)
class StoredWalk:
    """A parameter over m + 1 pieces in display units: ``edges`` (m + 2,) of the pieces, quantiles (3, m + 1).

    Where the interval of the parameter is not to be trusted, the posterior has no outer quantiles (NaN).
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
    return tuple(
        _stored_walk(result, name.removesuffix(PIECES))
        for name, variable in result.groups["/posterior"].variables.items()
        if variable.dims[2:] == (f"{name.removesuffix(PIECES)}{PIECE}",)
    )


def _stored_walk(result: StoredResult, name: str) -> StoredWalk:
    posterior, observed = result.groups["/posterior"], result.groups["/observed_data"].every
    pieces, time = posterior.variables[name + PIECES], posterior.coords[name + PIECE]
    begins = np.asarray(time.values, dtype=float)
    last = max(float(observed[axis.time].values[-1]) for axis in result.axes)
    edges = np.append(begins, max(last, begins[-1] + 0.02 * (begins[-1] - begins[0])))

    def quantiles(group: str) -> Array:
        values = np.asarray(result.groups[f"/{group}"].variables[name + PIECES].values[0], dtype=float)
        values = values[result.alive] if group == "posterior" else values
        values = values[np.isfinite(values).all(axis=1)]
        levels = member_quantiles(values, LEVELS, axis=0) if len(values) else np.full((3, len(begins)), np.nan)
        return shown(pieces, levels)

    after = quantiles("posterior")
    if untrusted(result.cautions, name):
        after[[0, 2]] = np.nan  # the interval
    label = str(posterior.variables[name].attrs["long_name"])
    units = pieces.attrs["display_units"], time.attrs["display_units"]
    return StoredWalk(name, label, pieces.attrs["symbol"], *units, shown(time, edges), after, quantiles("prior"))


def verdict(result: StoredResult) -> str:
    """What the evidence says of all that varies, in a sentence; "" where nothing does."""
    stats = result.group("sample_stats").attrs
    if "log_evidence_change" not in stats:
        return ""
    return change_words(str(stats["varying"]), float(stats["log_evidence_change"]))


def bands(result: StoredResult) -> Chart:
    """Median and 5–95 % of each parameter that varies, over the prior's."""
    rows = []
    for walk in stored_walks(result):
        least, most = float(np.nanmin(walk.posterior)), float(np.nanmax(walk.prior))
        steep = least > 0 and math.isfinite(most) and most > 5 * least
        panel = Panel(
            with_unit("time", walk.time_unit), with_unit(walk.symbol, walk.unit), logarithmic=steep, legend=True
        )
        for quantiles, colour, alpha in ((walk.prior, "prior", 0.3), (walk.posterior, "posterior", 0.35)):
            (x, low), (_, high) = (steps(walk.edges, quantiles[i]) for i in (0, 2))
            panel.band(x, low, high, colour, alpha, colour)
        panel.line(*steps(walk.edges, walk.posterior[1]), "posterior", label="median")
        rows.append(Row(5.0 * POINTS, [panel]))
    return Chart(rows)
