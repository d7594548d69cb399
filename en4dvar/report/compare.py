"""Runs side by side: posteriors of any, and for models of the same data evidence and posterior model probabilities.

Probabilities start from equal ones and follow the Laplace evidence of each run, p(M|y) ∝ p(y|M). Over several data
sets, each with parameters of its own, log-evidences add. A difference below one is called undecidable: "not worth
more than a bare mention" (Kass & Raftery 1995, J. Am. Stat. Assoc. 90, 773). Evidences of different data (two gels)
do not compare: there the posteriors are shown, and no probabilities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.errors import OutputError
from en4dvar.state import Array
from en4dvar.storage.store import ParameterSummary, StoredResult, load_stored

UNDECIDABLE = 1.0  # difference of log-evidence
ALL = "all data sets"


@dataclass(frozen=True)
class ModelScore:
    """One run on one data set (or, summed, on all): what the table of ``en4dvar compare`` shows.

    ``effective_parameters`` is p_WAIC, the sum over the observations of the posterior variance of their
    log-likelihood (Gelman, Hwang & Vehtari 2014, Stat. Comput. 24, 997); ``dfs`` is its linear counterpart.
    ``difference`` is the log-evidence minus that of the best model; NaN, as ``probability``, where the runs used
    different data.
    """

    run: str
    dataset: str
    log_evidence: float
    difference: float
    probability: float
    chi2_per_observation: float
    dfs: float
    effective_parameters: float
    nrmse: float


@dataclass(frozen=True)
class Estimate:
    """A parameter's posterior in one run for one data set; ``members`` (N',) alive, in the unit of ``summary``."""

    run: str
    dataset: str
    summary: ParameterSummary
    members: Array


@dataclass(frozen=True)
class Comparison:
    """Scores and estimates of every data set in turn, runs in the order given; with several data sets the sums of the
    scores come last. ``incomparable`` says why evidences do not compare; empty where they do.
    """

    scores: tuple[ModelScore, ...]
    estimates: tuple[Estimate, ...] = ()
    incomparable: str = ""

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs, in the order given."""
        return tuple(dict.fromkeys(score.run for score in self.scores))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of all runs, in order of appearance."""
        return tuple(dict.fromkeys(estimate.summary.name for estimate in self.estimates))

    def of(self, dataset: str) -> tuple[ModelScore, ...]:
        """The scores of one data set, or of :data:`ALL` together, runs in the order given."""
        return tuple(score for score in self.scores if score.dataset == dataset)

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets; where the runs share several, :data:`ALL` comes last."""
        return tuple(dict.fromkeys(score.dataset for score in self.scores))

    def verdict(self, dataset: str) -> str:
        """The preferred model in words, or that the data do not decide, or that evidences do not compare."""
        if self.incomparable:
            return f"not compared: {self.incomparable}"
        best, second = sorted(self.of(dataset), key=lambda score: -score.log_evidence)[:2]
        if -second.difference < UNDECIDABLE:
            return f"undecidable: {best.run} and {second.run} differ by {-second.difference:.2f} in log-evidence"
        return f"{best.run} is preferred: log-evidence {-second.difference:.2f} above {second.run}"


def compare_runs(runs: Sequence[str | Path]) -> Comparison:
    """Compare run directories: laws on the same data, or gels.

    Raises
    ------
    OutputError: fewer than two runs, a run given twice, or a directory without results.
    """
    if len(runs) < 2:
        raise OutputError("compare needs at least two run directories")
    names = _labels([Path(run) for run in runs])
    results = {name: _results(Path(run)) for name, run in zip(names, runs, strict=True)}
    reason = _difference(results)
    estimates = tuple(
        Estimate(name, dataset, row, result.members("posterior", row.name))
        for dataset in dict.fromkeys(d for held in results.values() for d in held)
        for name in names
        if (result := results[name].get(dataset)) is not None
        for row in result.summary()
    )
    if reason:
        scores = [_score(name, dataset, result) for name in names for dataset, result in results[name].items()]
        return Comparison(tuple(scores), estimates, reason)
    scores = []
    first = results[names[0]]
    for dataset in first:
        scores += _ranked([_score(name, dataset, results[name][dataset]) for name in names])
    if len(first) > 1:
        scores += _ranked([_total(name, [s for s in scores if s.run == name]) for name in names])
    return Comparison(tuple(scores), estimates)


def _difference(results: Mapping[str, Mapping[str, StoredResult]]) -> str:
    """Why the evidences of the runs do not compare; empty where all of them used the same data."""
    first, *others = results
    for name in others:
        if set(results[name]) != set(results[first]):
            odd = sorted(set(results[name]) ^ set(results[first]))
            more = f" and {len(odd) - 3} more" if len(odd) > 3 else ""
            return f"{name} and {first} hold different data sets: {', '.join(odd[:3])}{more}"
        for dataset, result in results[name].items():
            if not _same_data(result, results[first][dataset]):
                return (
                    f"{name} and {first} used different observations of {dataset}; evidences of different data, errors "
                    "or weights do not compare"
                )
    return ""


def model_probabilities(log_evidence: Array) -> Array:
    """Posterior probabilities (M,) of models with log-evidences (M,) and equal prior probabilities."""
    weights = np.exp(log_evidence - np.max(log_evidence))
    return np.asarray(weights / weights.sum())


def comparison_table(comparison: Comparison) -> str:
    """What the terminal shows: one row a model and data set, and the verdict on each data set."""
    from en4dvar.tables import table

    header = ("data set", "run", "log-evidence", "difference", "probability", "chi2/K", "DFS", "p_WAIC", "NRMSE")
    rows = [
        (
            s.dataset,
            s.run,
            f"{s.log_evidence:.2f}",
            f"{s.difference:.2f}" if np.isfinite(s.difference) else "–",
            f"{s.probability:.3f}" if np.isfinite(s.probability) else "–",
            f"{s.chi2_per_observation:.3g}",
            f"{s.dfs:.2f}",
            f"{s.effective_parameters:.2f}",
            f"{s.nrmse:.4f}",
        )
        for s in comparison.scores
    ]
    verdicts = [f"{name}: {comparison.verdict(name)}" for name in comparison.datasets]
    if comparison.incomparable:
        verdicts = [comparison.verdict("")]
    return "\n".join([table([header, *rows]), "", *verdicts])


def estimates_table(comparison: Comparison) -> str:
    """Posterior mean, std and 5–95 % of every parameter, runs below each other, in display units."""
    from en4dvar.tables import table

    header = ("parameter", "unit", "data set", "run", "mean", "std", "5 %", "95 %")
    rows = [
        (e.summary.name, e.summary.unit, e.dataset, e.run, *(f"{v:.4g}" for v in _shown(e.summary)))
        for name in comparison.parameters
        for e in comparison.estimates
        if e.summary.name == name
    ]
    return table([header, *rows])


def _shown(row: ParameterSummary) -> tuple[float, ...]:
    return row.mean, row.std, row.q05, row.q95


def _labels(runs: Sequence[Path]) -> list[str]:
    """Names of the directories; their paths where names repeat."""
    names = [run.resolve().name for run in runs]
    labels = names if len(set(names)) == len(names) else [str(run) for run in runs]
    if len(set(labels)) < len(labels):
        raise OutputError("compare: a run directory is given twice")
    return labels


def _results(run: Path) -> dict[str, StoredResult]:
    """Data set → result of a run directory."""
    files = sorted((run / "datasets").glob("*.nc")) or [run / "posterior.nc"]
    results = [load_stored(file) for file in files]
    return {result.name: result for result in results}


def _same_data(a: StoredResult, b: StoredResult) -> bool:
    left, right = a.observed_data, b.observed_data
    if a.observable != b.observable or left.sizes["time"] != right.sizes["time"]:
        return False
    names = ["time", a.observable, f"{a.observable}_reading_std", "time_std", "weights"]
    further = f"{a.observable}_correlation"
    if (further in left) != (further in right) or left.attrs.get("huber_threshold") != right.attrs.get(
        "huber_threshold"
    ):
        return False
    names += [further] if further in left else []
    return all(np.allclose(left[n].values, right[n].values, rtol=1e-12, atol=0) for n in names)


def _score(run: str, dataset: str, result: StoredResult) -> ModelScore:
    stats = result.sample_stats.attrs
    likelihood = result.dataset("log_likelihood")[result.observable].values[0]
    alive = result.sample_stats["active"].values.ravel().astype(bool)
    return ModelScore(
        run,
        dataset,
        float(stats["log_evidence"]),
        float("nan"),
        float("nan"),
        float(stats["chi2_per_observation"]),
        float(stats["dfs"]),
        float(np.sum(np.var(likelihood[alive], axis=0, ddof=1))),
        float(stats["nrmse"]),
    )


def _total(run: str, scores: Sequence[ModelScore]) -> ModelScore:
    """Sums of evidence, DFS and effective parameters; means of the measures of fit."""
    return ModelScore(
        run,
        ALL,
        sum(s.log_evidence for s in scores),
        0.0,
        0.0,
        float(np.mean([s.chi2_per_observation for s in scores])),
        sum(s.dfs for s in scores),
        sum(s.effective_parameters for s in scores),
        float(np.mean([s.nrmse for s in scores])),
    )


def _ranked(scores: Sequence[ModelScore]) -> list[ModelScore]:
    evidence = np.array([s.log_evidence for s in scores])
    return [
        replace(s, difference=float(s.log_evidence - evidence.max()), probability=float(p))
        for s, p in zip(scores, model_probabilities(evidence), strict=True)
    ]
