"""Runs side by side: posteriors of any, and for models of the same data evidence and posterior model probabilities.

Probabilities start from equal ones, p(M|y) ∝ p(y|M), with the evidence that was sampled for the comparison, else that
of the result: Laplace's approximation unless its posterior was sampled, which can be far off (of 1000 bubbles it stated
0.998 where 0.982 were right). Over several data sets log-evidences add. A difference below one is undecidable, "not
worth more than a bare mention" (Kass & Raftery 1995, J. Am. Stat. Assoc. 90, 773).
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from en4dvar.data.observations import Observations
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.summary import CSV_COLUMNS, ParameterSummary, csv_cells, estimate_cells
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, codes
from en4dvar.plumbing.errors import ConfigError, OutputError, retold
from en4dvar.plumbing.files import make_folder
from en4dvar.plumbing.hints import listed, shown, suggest
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.plumbing.units import UnitError, convert
from en4dvar.report.chart import POINTS, Chart, Panel, in_columns
from en4dvar.report.html import write_page
from en4dvar.report.paper import on_paper
from en4dvar.report.text import figure_text, fixed, with_unit
from en4dvar.results.run_results import result_files
from en4dvar.results.store import StoredResult, load_stored
from en4dvar.results.together import group_folders

if TYPE_CHECKING:
    from matplotlib.figure import Figure

S = TypeVar("S", bound=Any)
T = TypeVar("T")
MOST_WARNINGS = 12  # on the terminal
UNDECIDABLE = 1.0  # difference of log-evidence
ALL = "all data sets"
COLOURS = ("posterior", "centre", "background", "#cc79a7", "#b58900", "muted")
CAPTION = (
    "Posterior of each run, scaled to its peak; bars hold 5–95 % of the members, where these are to be trusted. "
    "Where a run has several data sets, the members of all of them are taken together."
)
STORED = "* as the result has it: Laplace's approximation, unless its posterior was sampled"


@dataclass(frozen=True)
class ModelScore:
    """One run on one data set (or, summed, on all): what the table of ``en4dvar compare`` shows.

    ``difference`` is the log-evidence minus that of the best model; NaN, as ``probability``, where the runs used
    different data. ``stored``: the log-evidence is the result's, not sampled. ``warnings`` are the codes of its
    warnings, and ``doubted`` those for which neither its intervals nor its evidence are to be trusted.
    """

    run: str
    dataset: str
    log_evidence: float
    difference: float
    probability: float
    chi2_per_observation: float
    dfs: float
    nrmse: float
    warnings: str = ""
    doubted: str = ""
    stored: bool = True


@dataclass(frozen=True)
class ComparedEstimate:
    """A parameter's posterior in one run for one data set; ``members`` (N',) alive, in the unit of ``summary``."""

    run: str
    dataset: str
    summary: ParameterSummary
    members: Array


@dataclass(frozen=True)
class ComparedCaution:
    """A warning of one run about one data set."""

    run: str
    dataset: str
    caution: Caution


@dataclass(frozen=True)
class Comparison:
    """Scores and estimates of every data set in turn, runs in the order given; with several data sets the sums of the
    scores come last. ``incomparable`` says why evidences do not compare; empty where they do. ``cautions`` are the
    warnings of all runs, the worst first.
    """

    scores: tuple[ModelScore, ...]
    estimates: tuple[ComparedEstimate, ...] = ()
    incomparable: str = ""
    cautions: tuple[ComparedCaution, ...] = ()

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs, in the order given."""
        return tuple(dict.fromkeys(score.run for score in self.scores))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of all runs, in order of appearance."""
        return tuple(dict.fromkeys(estimate.summary.name for estimate in self.estimates))

    @property
    def by_parameter(self) -> tuple[ComparedEstimate, ...]:
        """The estimates, those of one parameter below each other."""
        return tuple(sorted(self.estimates, key=lambda e: self.parameters.index(e.summary.name)))

    def of(self, dataset: str) -> tuple[ModelScore, ...]:
        """The scores of one data set, or of :data:`ALL` together, runs in the order given."""
        return tuple(score for score in self.scores if score.dataset == dataset)

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets; where the runs share several, :data:`ALL` comes last."""
        return tuple(dict.fromkeys(score.dataset for score in self.scores))

    def plot(self) -> Figure:
        """Posteriors of the runs over each other, a panel a parameter."""
        return on_paper(overlay(self))

    def __str__(self) -> str:
        return comparison_table(self)

    def verdict(self, dataset: str) -> str:
        """The preferred model in words, or why none is. Raises :class:`ConfigError`: the data set is not among them."""
        if self.incomparable:
            return f"not compared: {self.incomparable}"
        if dataset not in self.datasets:
            raise ConfigError(f"verdict: no data set {shown(dataset)}{suggest(dataset, self.datasets)}")
        known = [score for score in self.of(dataset) if np.isfinite(score.log_evidence)]
        lacking = listed(score.run for score in self.of(dataset) if score not in known)
        without = f"the evidence of {lacking} is not known before its warnings are settled" if lacking else ""
        if len(known) < 2:
            return f"not compared: {without}"
        best, second = sorted(known, key=lambda score: -score.log_evidence)[:2]
        words = preferred(best.run, second.run, -second.difference) + f"; {without}" * bool(without)
        if doubts := [f"{score.run} ({score.doubted.replace(' ', ', ')})" for score in (best, second) if score.doubted]:
            words += f"; not to be trusted before the warnings of {' and '.join(doubts)} are settled"
        return words


def compare_runs(runs: Sequence[str | Path] | Mapping[str, str | Path | StoredResult]) -> Comparison:
    """Compare runs: models on the same data, or different data.

    ``runs``: run directories or result files (``.nc``); or name → one of these, or a result at hand.

    Raises :class:`OutputError`: fewer than two runs, a run given twice, a directory without results, or results without
    names.
    """
    results = {name: _results(run) for name, run in named(runs).items()}
    datasets = list(dict.fromkeys(dataset for held in results.values() for dataset in held))
    pairs = [(name, d, held[d]) for d in datasets for name, held in results.items() if d in held]
    estimates = tuple(
        ComparedEstimate(name, dataset, row, result.members("posterior", row.name))
        for name, dataset, result in pairs
        for row in result.rows
    )
    of_runs = [ComparedCaution(name, dataset, c) for name, dataset, result in pairs for c in result.cautions]
    cautions = tuple(sorted(of_runs, key=lambda compared: compared.caution.rank))
    if reason := _difference(results):
        scores = [_score(name, dataset, result) for name, held in results.items() for dataset, result in held.items()]
        return Comparison(tuple(scores), estimates, reason, cautions)
    return Comparison(_judged([_score(*pair) for pair in pairs]), estimates, "", cautions)


def with_evidences(comparison: Comparison, sampled: Sequence[Mapping[str, float]]) -> Comparison:
    """The same with other evidences. ``sampled``: of each run data set → log-evidence in place of the result's."""
    better = dict(zip(comparison.runs, sampled, strict=True))
    scores = [score for score in comparison.scores if score.dataset != ALL]
    for i, score in enumerate(scores):
        if score.dataset in better[score.run]:
            scores[i] = replace(score, log_evidence=better[score.run][score.dataset], stored=False)
    return replace(comparison, scores=_judged(scores))


def _judged(scores: Sequence[ModelScore]) -> tuple[ModelScore, ...]:
    """The scores of each data set ranked, and behind those of several the sums."""
    every = [ranked(list(of_dataset)) for _, of_dataset in groupby(scores, key=lambda score: score.dataset)]
    if len(every) > 1:
        every.append(ranked([_total(run) for run in zip(*every, strict=True)]))
    return tuple(score for of_dataset in every for score in of_dataset)


def _difference(results: Mapping[str, Mapping[str, StoredResult]]) -> str:
    """Why the evidences of the runs do not compare; empty where all of them used the same data."""
    first, *others = results
    for name in others:
        if odd := sorted(set(results[name]) ^ set(results[first])):
            return f"the runs {name} and {first} hold different data sets: {listed(odd, 3)}"
        for dataset, result in results[name].items():
            if not _same_data(result, results[first][dataset]):
                why = "evidences of different data, errors or weights do not compare"
                return f"the runs {name} and {first} used different observations of {dataset}; {why}"
    return ""


def preferred(best: str, second: str, by: float) -> str:
    """That one of two runs has the log-evidence that is larger ``by`` so much, or that the data do not decide."""
    if by < UNDECIDABLE:
        return f"undecidable: {best} and {second} differ by {by:z.2f} in log-evidence"
    return f"{best} is preferred: log-evidence {by:.2f} above {second}"


def comparison_table(comparison: Comparison) -> str:
    """What the terminal shows: one row a model and data set, and the verdict on each data set."""
    header = ("data set", "run", "log-evidence", "difference", "probability", "chi2/K", "DFS", "NRMSE")
    rows = [
        (
            s.dataset, s.run, f"{fixed(s.log_evidence, 2)}{' *' * s.stored}", fixed(s.difference, 2),
            fixed(s.probability, 3), f"{s.chi2_per_observation:.3g}", f"{s.dfs:.2f}", f"{s.nrmse:.4f}",
        )
        for s in comparison.scores
    ]  # fmt: skip
    told = [f"{name}: {comparison.verdict(name)}" for name in comparison.datasets]
    verdicts = [comparison.verdict("")] if comparison.incomparable else told
    notes = [STORED] if any(s.stored for s in comparison.scores) else []
    warned = [f"{c.caution.kind}: {c.run}: {c.dataset}: {c.caution}" for c in comparison.cautions]
    if (more := len(warned) - MOST_WARNINGS) > 0:
        warned[MOST_WARNINGS:] = [f"and {more} more warnings and notes; see the report"]
    return "\n".join([table([header, *rows]), *notes, "", *verdicts, *warned])


def estimates_table(comparison: Comparison) -> str:
    """Mean, std and 5–95 % of every parameter, in display units; where not to be trusted the last column says why."""
    every = comparison.by_parameter
    doubted = any(e.summary.untrusted for e in every)
    header = ("parameter", "unit", "data set", "run", "mean", "std", "5 %", "95 %", *["not to be trusted"] * doubted)
    rows = []
    for e in every:
        mean, std, low, _, high = estimate_cells(e.summary)
        why = [", ".join(e.summary.untrusted)] * doubted
        rows.append((e.summary.name, e.summary.unit, e.dataset, e.run, mean, std, low, high, *why))
    return table([header, *rows])


def write_comparison(comparison: Comparison, out: str | Path) -> Path:
    """Write ``compare.html``, ``posteriors.png``, ``.pdf``, tables; returns the page. Raises :class:`OutputError`."""
    out = make_folder(out)
    warned = {(s.run, s.dataset): s.warnings for s in comparison.scores}
    rows = ([e.run, e.dataset, *csv_cells(e.summary), warned[e.run, e.dataset]] for e in comparison.by_parameter)
    write_csv(out / "estimates.csv", [["run", "dataset", *CSV_COLUMNS, "warnings"], *rows])
    columns = [f.name for f in fields(ModelScore)]
    write_csv(out / "evidence.csv", [columns, *([getattr(s, c) for c in columns] for s in comparison.scores)])
    figures = [("posteriors", CAPTION, overlay(comparison))] if comparison.parameters else []
    title = " – ".join(comparison.runs)
    return write_page(out, "compare", figures, out, title=title, comparison=comparison)


def overlay(comparison: Comparison) -> Chart:
    """Posterior members of the runs over each other, one panel a parameter, in the display unit of the first run.
    Raises :class:`OutputError`: there is none, only fields.
    """
    if not (names := comparison.parameters):
        raise OutputError("no parameter was estimated, only fields; the evidence of the runs is compared")
    panels = [_panel([e for e in comparison.estimates if e.summary.name == name], comparison.runs) for name in names]
    panels[0].legend = True
    return in_columns(panels, (4.0 + 0.15 * len(comparison.runs)) * POINTS)


def _panel(estimates: Sequence[ComparedEstimate], runs: Sequence[str]) -> Panel:
    row = estimates[0].summary
    panel = Panel(with_unit(row.symbol, row.unit), yticks=(), left=False, ylim=(0.0, 1.1 + 0.09 * len(runs)))
    for i, run in enumerate(runs):
        colour = COLOURS[i % len(COLOURS)]
        panel.line([], [], colour, label=figure_text(run))
        own = [e for e in estimates if e.run == run]
        with retold(UnitError, OutputError, f"the runs mean different quantities by {row.name}: "):
            parts = [convert(e.members, e.summary.unit, row.unit) for e in own]
        values = np.concatenate([np.empty(0), *parts])
        if values.size < 2 or np.ptp(values) == 0:
            continue
        panel.histogram(values, colour, alpha=0.25)
        if not any(e.summary.untrusted for e in own):
            low, high = member_quantiles(values, (0.05, 0.95))
            panel.line([low, high], np.full(2, 1.08 + 0.09 * i), colour, 2.0)
    return panel


def named(runs: Sequence[str | Path] | Mapping[str, T]) -> Mapping[str, T | Path]:
    """Name → run: names of the folders, or their paths where names repeat; at least two runs."""
    if isinstance(runs, str | Path | StoredResult) or len(runs) < 2:
        raise OutputError(f"compare needs at least two run directories{_its_groups(runs)}")
    if isinstance(runs, Mapping):
        return runs
    if any(isinstance(run, StoredResult) for run in runs):
        raise OutputError("results at hand have no names: give {'one': result, 'other': result}")
    paths = [Path(run) for run in runs]
    names = [path.resolve().name for path in paths]
    labels = names if len(set(names)) == len(names) else [str(path) for path in paths]
    if len(set(labels)) < len(labels):
        raise OutputError("compare: a run directory is given twice")
    return dict(zip(labels, paths, strict=True))


def _its_groups(runs: Any) -> str:
    """Where the comparison of the groups of one run is, and what it may be told; "" where it has none."""
    paths = [it for it in (runs if isinstance(runs, list | tuple) else [runs]) if isinstance(it, str | Path)]
    groups = [shlex.quote(str(folder)) for path in paths for folder in group_folders(Path(path))]
    if len(groups) < 2:
        return ""
    return (
        f"; {paths[0]} compares its {len(groups)} groups itself, on its page: a median that is known stands in its "
        "configuration (population.known), a line needs numbers with a unit in the names of the groups, or compare "
        f"the folders {' '.join(groups)}"
    )


def _results(run: str | Path | StoredResult) -> dict[str, StoredResult]:
    if isinstance(run, StoredResult):
        return {run.name: run}
    files = [Path(run)] if Path(run).suffix == ".nc" else result_files(Path(run))
    return {result.name: result for result in map(load_stored, files)}


def _same_data(a: StoredResult, b: StoredResult) -> bool:
    ours, theirs = _stated(a.observations()), _stated(b.observations())
    return (a.axes, ours.keys()) == (b.axes, theirs.keys()) and all(
        ours[key].shape == theirs[key].shape and np.allclose(ours[key], theirs[key], rtol=1e-12, atol=0) for key in ours
    )


def _stated(o: Observations) -> dict[str, Array]:
    """The observations and everything that is stated about their errors."""
    stated = {"times": o.times, "values": o.values, "weights": o.weights, "std": o.noise.std}
    stated |= {"time_std": o.noise.time_std, **{name: matrix for name, (matrix, _) in o.noise.matrices().items()}}
    return stated | {name: np.asarray(number) for name, number in o.noise.attributes().items()}


def _score(run: str, dataset: str, result: StoredResult) -> ModelScore:
    stats = result.groups["/sample_stats"].attrs
    log, *fit = (float(stats[key]) for key in ("log_evidence", "chi2_per_observation", "dfs", "nrmse"))
    warned, doubted = (" ".join(codes(c)) for c in (result.cautions, [c for c in result.cautions if c.spoils]))
    return ModelScore(run, dataset, log, np.nan, np.nan, fit[0], fit[1], fit[2], warned, doubted)


def _total(scores: Sequence[ModelScore]) -> ModelScore:
    """Of one run: sums of evidence and DFS; means of the measures of fit; the codes of warnings, each once."""

    def of_all(key: str) -> list[Any]:
        return [getattr(score, key) for score in scores]

    joined: dict[str, Any] = {key: sum(of_all(key)) for key in ("log_evidence", "dfs")}
    joined |= {key: float(np.mean(of_all(key))) for key in ("chi2_per_observation", "nrmse")}
    joined |= {key: " ".join(dict.fromkeys(" ".join(of_all(key)).split())) for key in ("warnings", "doubted")}
    return replace(scores[0], dataset=ALL, **joined, stored=any(of_all("stored")))


def ranked(scores: Sequence[S]) -> list[S]:
    """The scores with the difference of their log-evidence from the best one, and their probabilities among those whose
    evidence is known; none (NaN) of one alone.
    """
    evidence = np.array([s.log_evidence for s in scores])
    difference = evidence - evidence[np.isfinite(evidence)].max(initial=-np.inf)
    # the models are equally probable before the data
    odds = np.exp(difference) if np.sum(~np.isnan(evidence)) > 1 else np.full(len(evidence), np.nan)
    judged = zip(scores, difference.tolist(), (odds / np.nansum(odds)).tolist(), strict=True)
    return [replace(s, difference=d, probability=p) for s, d, p in judged]
