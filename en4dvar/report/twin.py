"""Page and figures of a twin experiment, from ``twin.nc`` alone: RMSE and spread in time, the state and its truth,
ranks of the truth among the members, and whether the spread says how large the error is; what a session gets of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.plumbing.tables import table
from en4dvar.report import sequence
from en4dvar.report.chart import COLUMN, POINTS, Chart, Panel, Row, stacked
from en4dvar.report.paper import on_paper
from en4dvar.report.svg import Captioned
from en4dvar.report.text import axis_label, plain_number, pretty_unit, with_unit
from en4dvar.results.netcdf import Group, read_groups
from en4dvar.results.series_file import MEAN, series_group
from en4dvar.series.twin import TwinResult

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COLOURS = {"forecast": "prior", "analysis": "posterior", "smoothed": "background"}
SHOWN = 4  # variables of the state in the second figure
LAST = 200  # cycles in it
MOST_BARS = 21  # of the histogram of the truth's rank
GROUPS = 12  # of spreads


class TwinOutcome(TwinResult):
    """A twin experiment's truth, observations and estimates; ``scores`` by estimate."""

    def __repr__(self) -> str:
        own = self.experiment
        told = [f"{name} RMSE {s.mean_rmse:.3g}, spread {s.mean_spread:.3g}" for name, s in self.scores.items()]
        return f"<TwinOutcome: {own.members} members, {own.cycles} cycles; {'; '.join(told)}>"

    def __str__(self) -> str:
        return "\n".join([self.table(), *(f"warning: {words}" for words in self.warnings)])

    def table(self) -> str:
        """RMSE and spread after the burn-in, aligned."""
        rows = [(name, f"{s.mean_rmse:.4g}", f"{s.mean_spread:.4g}") for name, s in self.scores.items()]
        return table([("estimate", "RMSE", "spread"), *rows])

    def summary(self) -> pd.DataFrame:
        """RMSE and spread after the burn-in, a row an estimate."""
        from en4dvar.plumbing.whole_table import WholeTable

        rows = {name: (score.mean_rmse, score.mean_spread) for name, score in self.scores.items()}
        return WholeTable.from_dict(rows, orient="index", columns=["rmse", "spread"])

    def plot(self) -> Figure:
        """RMSE and spread in time."""
        return on_paper(scores(series_group(self, {})))


def write_twin_report(run_dir: Path, files: bool = False) -> Path:
    """Write ``report.html`` from ``twin.nc``, with ``files`` also PDF and PNG. Raises :class:`OutputError`."""
    data = read_groups(run_dir / "twin.nc")["/"]
    burn_in = int(data.attrs["burn_in"])
    rows = []  # estimate, RMSE, spread, spread over RMSE after the burn-in
    for kind, _ in _kinds(data):
        rmse, spread = (float(data[f"{kind}_{what}"].attrs[MEAN]) for what in ("rmse", "spread"))
        rows.append((kind, plain_number(rmse, 4), plain_number(spread, 4), plain_number(spread / rmse, 3)))
    heads = with_unit("RMSE", _unit(data)), with_unit("spread", _unit(data))
    shown = {"iterations": float(data["iterations"].values[burn_in:].mean()), "heads": heads, "scores": rows}
    return sequence.write_cycles_page(run_dir, "twin.html.j2", data, twin_figures(data), files, **shown)


def twin_figures(data: Group) -> Iterator[Captioned]:
    """Each figure with its caption."""
    burn_in = int(data.attrs["burn_in"])
    words = " The first cycles, shaded, do not count in the averages." if burn_in else ""
    yield "scores", f"RMSE against the truth (line) and spread (dashed) of each estimate in time.{words}", scores(data)
    shown = f"Error of the analysis within two standard deviations, last {min(LAST, data.sizes['time'])} cycles"
    yield "errors", f"{shown}, some variables of the state. A reliable ensemble has 95 % within.", errors(data)
    among = "Rank of the truth among the members, over all cycles and variables that count"
    yield "truth_ranks", f"{among}, relative to a flat histogram.", truth_ranks(data)
    words = f"RMSE of the values in {GROUPS} groups of the same size, by their spread, against that spread."
    lies = "A reliable ensemble lies on the diagonal: where it is spread wide, its error is large."
    yield "reliability", f"{words} {lies}", reliability(data)
    yield "ranks", sequence.RANKS, sequence.ranks(data["rank"].values[burn_in:], int(data.attrs["members"]))


def scores(data: Group) -> Chart:
    """RMSE and spread in time, one panel an estimate, averages after the burn-in as thin lines."""
    time, panels = data["time"].values, []
    for kind, colour in _kinds(data):
        rmse, spread = data[f"{kind}_rmse"], data[f"{kind}_spread"]
        average, top = float(rmse.attrs[MEAN]), _upper(rmse.values, spread.values)
        title = f"{kind}: RMSE {plain_number(average, 3)}"
        panel = Panel(ylabel=with_unit("error", _unit(data)), title=title, xlim=sequence.span_of(time), ylim=(0.0, top))
        if burn_in := int(data.attrs["burn_in"]):
            panel.band(time[[0, burn_in - 1]], [0, 0], [top, top], "grid", 0.5)
        panel.line(time, rmse.values, colour, 0.7, label="RMSE")
        panel.line(time, spread.values, "centre", 0.7, "--", label="spread")
        panel.rule(average, colour)
        panels.append(panel)
    return stacked(panels, 3.0 * POINTS, axis_label(data["time"], "time"))


def errors(data: Group) -> Chart:
    """Error of the analysis within ± 2 std, in the last cycles; titles say how often over all that count."""
    burn_in, truth = int(data.attrs["burn_in"]), data["truth"].values
    error, std = data["analysis_mean"].values - truth, data["analysis_std"].values
    inside = np.mean(np.abs(error[burn_in:]) <= 2 * std[burn_in:], axis=0)
    varied = np.flatnonzero(std.max(axis=0) > 1e-9 * np.abs(truth).max(axis=0))  # not what is held fixed
    chosen = np.unique([*varied[: SHOWN - 1], varied[-1]])  # the last is an estimated parameter, if there is one
    time, panels = data["time"].values[-LAST:], []
    for i in chosen:
        width = 2 * std[-LAST:, i]
        title = f"{data['state'].values[i]}: {100 * inside[i]:.0f} % within 2 std"
        panel = Panel(ylabel=with_unit("error", str(data["units"].values[i])), title=title, xlim=sequence.span_of(time))
        panel.band(time, -width, width, "posterior", 0.25, "± 2 std")
        panel.rule(0, size=0.5)
        panel.line(time, error[-LAST:, i], "ink", 0.8, label="analysis − truth")
        panels.append(panel)
    return stacked(panels, 2.8 * POINTS, axis_label(data["time"], "time"))


def truth_ranks(data: Group) -> Chart:
    """Histogram of the rank of the truth, one panel an estimate; 1 is what a flat one has."""
    size = int(data.attrs["members"]) - int(data.attrs["members_lost"]) + 1
    edges = np.round(np.linspace(0, size, min(size, MOST_BARS) + 1)) / size  # whole ranks in a bar
    panels = []
    for kind, colour in _kinds(data):
        ranked = _counted(data, data[f"{kind}_rank"].values)
        count, _ = np.histogram(ranked, edges)
        relative = count / (np.diff(edges) * max(1, len(ranked)))
        top = 1.05 * max(1.0, float(relative.max()))
        panel = Panel(ylabel="frequency", title=kind, xlim=(0.0, 1.0), ylim=(0.0, top))
        panel.stairs(edges, relative, colour, 0.6)
        panel.line([0, 1], [1, 1], "ink", 0.8, "--")
        panels.append(panel)
    return stacked(panels, 2.8 * POINTS, "share of the members below the truth")


def reliability(data: Group) -> Chart:
    """RMSE against spread, in groups of the same size, one line an estimate."""
    panel = Panel(with_unit("spread", _unit(data)), with_unit("RMSE", _unit(data)), legend=True)
    largest = 0.0
    for kind, colour in _kinds(data):
        spread = _counted(data, data[f"{kind}_std"].values)
        error = _counted(data, data[f"{kind}_mean"].values - data["truth"].values)
        groups = np.array_split(np.argsort(spread, kind="stable"), min(GROUPS, max(1, len(spread))))
        x, y = (np.array([np.sqrt(np.mean(v[g] ** 2)) for g in groups]) for v in (spread, error))
        panel.line(x, y, colour, 1.0, label=kind)
        panel.dots(x, y, colour, 3.0, label=kind)
        largest = max(largest, float(x.max(initial=0)), float(y.max(initial=0)))
    panel.line([0, largest], [0, largest], "ink", 0.8, "--")
    return Chart([Row(COLUMN, [panel])])


def _counted(data: Group, values: np.ndarray) -> np.ndarray:
    """Values (K, n) that are there, after the burn-in, of the variables that scores count, as one row."""
    wanted = values[int(data.attrs["burn_in"]) :, data["dynamic"].values.astype(bool)].ravel()
    return np.asarray(wanted[np.isfinite(wanted)])


def _kinds(data: Group) -> list[tuple[str, str]]:
    return [(kind, colour) for kind, colour in COLOURS.items() if f"{kind}_rmse" in data]


def _unit(data: Group) -> str:
    return pretty_unit(str(data["analysis_rmse"].attrs["units"]))


def _upper(*series: Any) -> float:
    """A limit that one bad beginning does not set: twice the 98 % quantile, no more than the maximum."""
    values = np.concatenate([s[np.isfinite(s)] for s in series])
    return float(min(1.05 * values.max(), 2 * np.quantile(values, 0.98))) if len(values) else 1.0
