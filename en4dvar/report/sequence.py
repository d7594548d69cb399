"""Pages and figures of a sequence and of a twin experiment, from ``sequence.nc`` or ``twin.nc`` alone; what a session
gets of them; sequences of the same readings side by side.

ln p(y) = Σ_k ln p(y_k | y_1 … y_{k−1}), each the density of N(H x̄, P + R) of the forecast: exact for a linear model and
an ensemble of enough members, as in a Kalman filter. Source: Schweppe (1965), IEEE Trans. Inf. Theory 11, 61; for
model selection by ensembles: Carrassi, Bocquet, Hannart & Ghil (2017), Q. J. R. Meteorol. Soc. 143, 866.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binom

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, write_text
from en4dvar.plumbing.hints import counted, percent
from en4dvar.plumbing.tables import csv_text, table
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.report.chart import COLUMN, POINTS, Chart, Panel, Row, interval, stacked
from en4dvar.report.compare import named, preferred, ranked
from en4dvar.report.export import Kind, column_name, escaped, latex_unit, plus_minus, render_latex
from en4dvar.report.html import render
from en4dvar.report.paper import on_paper
from en4dvar.report.svg import Captioned, draw
from en4dvar.report.text import axis_label, fixed, number_like, plain_number, pretty_unit, shown, with_unit
from en4dvar.results.declared import Names
from en4dvar.results.netcdf import Group, read_groups, understood
from en4dvar.results.series_file import CERTAIN, FILES, MEAN, estimates, series_file, series_group, uncertain
from en4dvar.series.problem import SeriesResult
from en4dvar.series.twin import TwinResult

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

BINS = 10
RANKS = (
    "Rank histogram: where each observation fell among the forecast members, errors of the observations added. A "
    "reliable ensemble has flat bars, 95 % of them inside the band; a valley is too little spread, a hill too much."
)


def write_cycles_report(run_dir: Path, files: bool = False) -> Path:
    """Write ``report.html`` of a sequence or a twin experiment from its result, with ``files`` also figures as PDF and
    PNG; returns the path of the page. Raises :class:`OutputError`.
    """
    file = series_file(run_dir) or run_dir / FILES[0]
    kind, data = file.stem, read_groups(file)["/"]
    shown, figures = (_scored(data), twin_figures(data)) if kind == "twin" else (_ended(data), sequence_figures(data))
    shown |= {"attributes": data.attrs, "sizes": data.sizes, "copies": files}
    drawn = draw(figures, folder=inside(run_dir, "figures") if files else None)
    return write_text(run_dir / "report.html", render(f"{kind}.html.j2", figures=drawn, **shown))


def span_of(time: Array) -> tuple[float, float] | None:
    """Limits of an axis of time without margins."""
    return (float(time[0]), float(time[-1])) if time[-1] > time[0] else None


def ranks(ranked: Array) -> Chart:
    """The rank histogram of all observations, with the band that holds 95 % of the bars of a reliable ensemble."""
    known = ranked[np.isfinite(ranked)]
    counts, edges = np.histogram(known, BINS, (0, 1))
    low, high = binom.ppf([0.025, 0.975], len(known), 1 / BINS) / max(1, len(known))
    shares = counts / max(1, len(known))
    panel = Panel("rank of the observation, 0 to 1", f"share of {len(known)}", xlim=(0.0, 1.0))
    panel.ylim = 0.0, 1.05 * max(float(shares.max()), float(high), 1e-3)
    panel.span(low, high, "grid", 0.6)
    panel.stairs(edges, shares, "prior", 0.7)
    panel.rule(1 / BINS, "ink")
    return Chart([Row(5.0 * POINTS, [panel])])


def variables(data: Group) -> list[tuple[str, str, str]]:
    """Name, unit and the unit shown of each variable of the state."""
    columns = "state", "units", "display_units" if "display_units" in data else "units"
    return list(zip(*(map(str, data[column].values) for column in columns), strict=True))


def symbols(data: Group) -> list[str]:
    """How the variables of the state are written; in files of earlier versions by their names."""
    return list(map(str, data["symbol" if "symbol" in data else "state"].values))


def last_analysis(data: Group) -> Iterator[tuple[str, float, float, str]]:
    """Name, mean, std and the unit they are shown in of the variables that are uncertain at the end."""
    return uncertain(variables(data), *(data[f"analysis_{what}"].values[-1] for what in ("mean", "std")))


def cycles_table(file: Path, kind: Kind) -> str:
    """A table of the result file of a sequence or a twin experiment as text, in display units. ``csv``: a line for each
    time and variable of the state, mean and std of each estimate, and the truth; ``members``: for each member and time
    that is kept (a twin experiment has none: :class:`OutputError`); ``latex``: for each variable of the last analysis.
    """
    data = read_groups(file)["/"]
    if kind == "members" and "members" not in data:
        raise OutputError(f"{file}: a twin experiment keeps no members; --csv has each variable's mean and std in time")
    with understood(file):
        if kind == "latex":
            return _last_analysis(data)
        return csv_text(_state_members(data) if kind == "members" else _in_time(data))


def _in_time(data: Group) -> Iterator[list[str]]:
    state, every = variables(data), [f"{kind}_{what}" for kind in COLOURS for what in ("mean", "std")]
    columns = [column for column in (*every, "truth") if column in data]
    yield ["time", "variable", "unit", *columns]
    values = np.stack([data[column].values * _factors(data) for column in columns], axis=-1)
    for time, at in zip(data["time"].values, values, strict=True):
        for (name, _, unit), row in zip(state, at, strict=True):
            yield [repr(float(time)), name, unit, *(f"{x:.10g}" if np.isfinite(x) else "" for x in row)]


def _state_members(data: Group) -> Iterator[list[str]]:
    yield ["time", "member", *(column_name(name, unit) for name, _, unit in variables(data))]
    for time, members in zip(data["member_time"].values, data["members"].values * _factors(data), strict=True):
        for i, member in enumerate(members):
            if np.isfinite(member).all():  # the others were lost
                yield [repr(float(time)), str(i), *(f"{x:.10g}" for x in member)]


def _factors(data: Group) -> Array:
    """(n,) of the variables of the state, to the units that they are shown in."""
    return np.array([float(convert(1.0, unit, display)) for _, unit, display in variables(data)])


def _last_analysis(data: Group) -> str:
    last = last_analysis(data)
    rows = [(escaped(name), latex_unit(unit) or "--", plus_minus(mean, std)) for name, mean, std, unit in last]
    head, what = ("variable", "unit", "analysis"), "mean and standard deviation of the last analysis"
    return render_latex("table.tex.j2", what=what, columns="llr", head=head, rows=rows, notes={}, comments=())


SHOWN = 5  # variables or observations in a figure
LISTED = 40  # in a table
MOST = 4  # variables in one line
READINGS = ("time", "observation", "observations", "observation_std", "observation_correlation")


class SequenceOutcome(SeriesResult):
    """The state and parameters along a series of data."""

    def __repr__(self) -> str:
        told = [f"{name} {mean:.4g} ± {std:.2g}{unit_after(unit)}" for name, mean, std, unit in estimates(self)]
        more = f" and {len(told) - MOST} more" if len(told) > MOST else ""
        about = f"{self.problem.name}, {counted(len(self.problem.series.times), 'time')}"
        return f"<SequenceOutcome {about}; at the end {', '.join(told[:MOST])}{more}>"

    def __str__(self) -> str:
        return "\n".join([self.table(), *(f"warning: {words}" for words in self.warnings)])

    def table(self) -> str:
        """State and parameters at the last time, aligned."""
        rows = [(name, f"{mean:.5g}", f"{std:.3g}", unit) for name, mean, std, unit in estimates(self)]
        return table([("at the end", "mean", "std", "unit"), *rows])

    def summary(self) -> pd.DataFrame:
        """Mean and standard deviation at the last time, a row a variable."""
        from en4dvar.plumbing.whole_table import WholeTable

        return WholeTable(estimates(self), columns=["variable", "mean", "std", "unit"]).set_index("variable")

    def plot(self) -> Figure:
        """The state in time, or the parameters where it is known."""
        _, _, chart = next(sequence_figures(series_group(self, {})))
        return on_paper(chart)


def _ended(data: Group) -> dict[str, Any]:
    written = Names(zip(map(str, data["state"].values), symbols(data), strict=True))
    at_end = [
        (written[name], number_like(mean, std), number_like(std, std), pretty_unit(unit))
        for name, mean, std, unit in islice(last_analysis(data), LISTED)
    ]
    rows = []
    for name, column in zip(data["observation"].values[:LISTED], data["normalised_innovation"].values.T, strict=False):
        there = column[np.isfinite(column)]
        size, share = (np.sqrt(np.mean(there**2)), np.mean(np.abs(there) <= 2)) if len(there) else (np.nan, np.nan)
        rows.append((str(name), str(len(there)), plain_number(float(size), 3), percent(float(share))))
    readings, iterations = int(np.isfinite(data["observations"].values).sum()), float(data["iterations"].values.mean())
    return {"readings": readings, "iterations": iterations, "at_end": at_end, "innovations": rows}


def sequence_figures(data: Group) -> Iterator[Captioned]:
    best = "smoothed" if "smoothed_mean" in data else "analysis"
    parameters, state = str(data.attrs["parameters"]).split(", "), list(map(str, data["state"].values))
    held = np.array([state.index(name) for name in parameters if name in state], dtype=np.intp)
    spread = data[f"{best}_std"].values.max(axis=0)
    uncertain = np.flatnonzero(spread > CERTAIN * np.abs(data[f"{best}_mean"].values).max(axis=0))
    dynamic = np.setdiff1d(uncertain, held)
    if len(dynamic):
        words = "" if len(dynamic) <= SHOWN else f" {SHOWN} of {len(dynamic)} variables."
        caption = f"The state in time: mean of the {best} ensemble within two standard deviations, and readings of it."
        yield "state", caption + words, in_time(data, best, _some(dynamic, SHOWN))
    if len(held):
        caption = "The parameters in time: mean of the analysis within two standard deviations, given the data so far."
        yield "parameters", caption, in_time(data, "analysis", held[:SHOWN])
    caption = "Innovations, the readings minus their forecasts, within two of their expected standard deviations."
    yield "innovations", caption, innovations(data)
    yield "ranks", RANKS, ranks(data["rank"].values)


def in_time(data: Group, kind: str, chosen: npt.NDArray[np.intp]) -> Chart:
    """Mean ± 2 std of some variables of the state, one panel each, and the readings that are of them."""
    time, read_as = shown(data["time"]), list(data["observation_state"].values)
    panels = []
    for i in chosen:
        name, unit, display = variables(data)[i]
        mean, std = (convert(data[f"{kind}_{what}"].values[:, i], unit, display) for what in ("mean", "std"))
        panel = Panel(ylabel=with_unit(symbols(data)[i], display), xlim=span_of(time))
        panel.band(time, *interval(mean, std, 2, bool(data["positive"].values[i])), "posterior", 0.25, "± 2 std")
        panel.line(time, mean, "posterior", 0.9, label=kind)
        if name in read_as:
            readings = convert(data["observations"].values[:, read_as.index(name)], unit, display)
            panel.dots(time, readings, "ink", 1.6, label="readings")
        panels.append(panel)
    return stacked(panels, 2.8 * POINTS, axis_label(data["time"], "time"))


def innovations(data: Group) -> Chart:
    """Innovations in time over ± 2 expected std, some of the observations."""
    time = shown(data["time"])
    innovation = data["observations"].values - data["predicted_mean"].values
    expected = np.hypot(data["predicted_std"].values, data["observation_std"].values)
    panels = []
    for i in _some(np.arange(data.sizes["observation"]), SHOWN):
        unit, display = (str(data[f"observation_{kind}"].values[i]) for kind in ("units", "display_units"))
        there = np.isfinite(innovation[:, i])
        at, width = time[there], 2 * convert(expected[there, i], unit, display)
        panel = Panel(ylabel=with_unit(str(data["observation"].values[i]), display), xlim=span_of(time))
        panel.band(at, -width, width, "prior", 0.3, "± 2 expected std")
        panel.rule(0, size=0.5)
        panel.dots(at, convert(innovation[there, i], unit, display), "ink", 1.6, label="innovation")
        panels.append(panel)
    return stacked(panels, 2.6 * POINTS, axis_label(data["time"], "time"))


def _some(places: npt.NDArray[np.intp], most: int) -> npt.NDArray[np.intp]:
    """All of few, else some that are spread evenly."""
    return np.asarray(places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))])


@dataclass(frozen=True)
class SequenceScore:
    """``innovation``: root mean square of normalised innovations; ``difference`` to the largest log-evidence; ``bent``:
    a window took more than the two iterations of a linear model.
    """

    run: str
    scheme: str
    log_evidence: float
    difference: float
    probability: float
    innovation: float
    bent: bool


def compare_sequences(run_dirs: Sequence[Path]) -> tuple[SequenceScore, ...]:
    """Score sequences, in the order given. Raises :class:`OutputError`: fewer than two, or why they do not compare."""
    runs = {name: _sequence(run_dir) for name, run_dir in named(run_dirs).items()}
    (first, reference), *others = runs.items()
    for name, other in others:
        if not all(_same(reference, other, key) for key in READINGS):
            raise OutputError(f"{name} and {first} hold other readings or errors: their evidences cannot be compared")
    scores = []
    for run, data in runs.items():
        size = float(np.sqrt(np.nanmean(data["normalised_innovation"].values ** 2)))
        scheme, evidence = str(data.attrs["scheme"]), float(data.attrs["log_evidence"])
        bent = bool(data["iterations"].values.max() > 2)
        scores.append(SequenceScore(run, scheme, evidence, np.nan, np.nan, size, bent))
    return tuple(ranked(scores))


def sequences_table(scores: Sequence[SequenceScore]) -> str:
    """What the terminal shows: a row a run, and which is preferred."""
    header = ("run", "scheme", "log-evidence", "difference", "probability", "innovations / expected")
    rows = [
        (
            s.run, s.scheme, fixed(s.log_evidence, 2), fixed(s.difference, 2), fixed(s.probability, 3),
            f"{s.innovation:.3g}",
        )
        for s in scores
    ]  # fmt: skip
    best, second = sorted(scores, key=lambda score: -score.log_evidence)[:2]
    told = f"{table([header, *rows])}\n\n{preferred(best.run, second.run, -second.difference)}"
    if bent := ", ".join(s.run for s in scores if s.bent):
        told += (
            f"\ncaution: windows of {bent} took more than two iterations, so that the model is not linear in them; "
            "such an evidence may be tens too low: see whether a scheme without a window says the same"
        )
    return told


def _sequence(run_dir: Path) -> Group:
    if (file := series_file(run_dir)) is None:
        raise OutputError(f"{run_dir}: no sequence; sequences are compared with sequences of the same readings")
    if file.stem == "twin":
        raise OutputError(f"{run_dir}: a twin experiment has no evidence; RMSE and spread are in its summary.csv")
    data = read_groups(file)["/"]
    if why := str(data.attrs["without_evidence"]):
        raise OutputError(f"{run_dir}: has no evidence to compare: {why}")
    if not np.isfinite(data.attrs["log_evidence"]):
        raise OutputError(f"{run_dir}: has no evidence to compare: its ensemble has lost the readings")
    return data


def _same(first: Group, other: Group, key: str) -> bool:
    if key not in first or key not in other:
        return key not in first and key not in other
    a, b = first[key].values, other[key].values
    return a.dtype.kind == b.dtype.kind and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


# Of a twin experiment

COLOURS = {"forecast": "prior", "analysis": "posterior", "smoothed": "background"}
FEW = 4  # variables of the state in the second figure
LAST = 200  # cycles in it
BLOCKS = 20  # of times, whose averages tell how sure that of all is
MOST_BARS = 21  # of the histogram of the truth's rank
GROUPS = 12  # of spreads


class TwinOutcome(TwinResult):
    """A twin experiment's truth, observations and estimates; ``scores`` by estimate."""

    def __repr__(self) -> str:
        own = self.experiment
        told = [f"{name} RMSE {s.mean_rmse:.3g}, spread {s.mean_spread:.3g}" for name, s in self.scores.items()]
        return f"<TwinOutcome: {counted(own.members, 'member')}, {counted(own.cycles, 'cycle')}; {'; '.join(told)}>"

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


def _scored(data: Group) -> dict[str, Any]:
    burn_in = int(data.attrs["burn_in"])
    rows = []  # estimate, RMSE, spread, spread over RMSE after the burn-in
    for kind, _ in _kinds(data):
        (rmse, off), (spread, by) = (averaged(data, f"{kind}_{what}") for what in ("rmse", "spread"))
        ratio, share = spread / rmse, math.hypot(off / rmse, by / spread)
        rows.append((kind, number_like(rmse, off), number_like(spread, by), number_like(ratio, ratio * share)))
    heads = with_unit("RMSE", _unit(data)), with_unit("spread", _unit(data))
    return {"iterations": float(data["iterations"].values[burn_in:].mean()), "heads": heads, "scores": rows}


def averaged(data: Group, name: str) -> tuple[float, float]:
    """A score's average after the burn-in, and how far chance moves it: by the averages of :data:`BLOCKS` times, for
    scores of cycles that follow each other are alike. Of one cycle a tenth of itself.
    """
    values, mean = data[name].values[int(data.attrs["burn_in"]) :], float(data[name].attrs[MEAN])
    there = values[np.isfinite(values)]
    averages = [block.mean() for block in np.array_split(there, min(BLOCKS, len(there)))] if len(there) > 1 else []
    return mean, float(np.std(averages, ddof=1) / math.sqrt(len(averages))) if averages else 0.1 * mean


def twin_figures(data: Group) -> Iterator[Captioned]:
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
    yield "ranks", RANKS, ranks(data["rank"].values[burn_in:])


def scores(data: Group) -> Chart:
    """RMSE and spread in time, one panel an estimate, averages after the burn-in as thin lines."""
    time, panels = data["time"].values, []
    for kind, colour in _kinds(data):
        rmse, spread = data[f"{kind}_rmse"], data[f"{kind}_spread"]
        (average, off), top = averaged(data, f"{kind}_rmse"), _upper(np.concatenate([rmse.values, spread.values]))
        title = f"{kind}: RMSE {number_like(average, off)}"
        panel = Panel(ylabel=with_unit("error", _unit(data)), title=title, xlim=span_of(time), ylim=(0.0, top))
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
    varied = np.flatnonzero(std.max(axis=0) > CERTAIN * np.abs(truth).max(axis=0))  # not what is held fixed
    chosen = np.unique([*varied[: FEW - 1], varied[-1]])  # the last is an estimated parameter, if there is one
    time, panels = data["time"].values[-LAST:], []
    for i in chosen:
        width = 2 * std[-LAST:, i]
        title = f"{data['state'].values[i]}: {100 * inside[i]:.0f} % within 2 std"
        panel = Panel(ylabel=with_unit("error", str(data["units"].values[i])), title=title, xlim=span_of(time))
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


def _upper(values: Array) -> float:
    """A limit that one bad beginning does not set: twice the 98 % quantile, no more than the maximum."""
    known = values[np.isfinite(values)]
    return float(min(1.05 * known.max(), 2 * np.quantile(known, 0.98))) if len(known) else 1.0
