"""Models of the same data side by side: evidence, posterior model probabilities, fit, information.

Probabilities start from equal ones and follow the Laplace evidence of each run, p(M|y) ∝ p(y|M). Over several data
sets, each with parameters of its own, log-evidences add. A difference below one is called undecidable: "not worth
more than a bare mention" (Kass & Raftery 1995, J. Am. Stat. Assoc. 90, 773).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.errors import OutputError
from en4dvar.state import Array
from en4dvar.store import Result, load_result

UNDECIDABLE = 1.0  # difference of log-evidence
ALL = "all data sets"


@dataclass(frozen=True)
class ModelScore:
    """One model on one data set (or, summed, on all): what the table of ``en4dvar compare`` shows.

    ``effective_parameters`` is p_WAIC, the sum over the observations of the posterior variance of their
    log-likelihood (Gelman, Hwang & Vehtari 2014, Stat. Comput. 24, 997); ``dfs`` is its linear counterpart.
    ``difference`` is the log-evidence minus that of the best model.
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
class Comparison:
    """Scores of every data set in turn, runs in the order given; with several data sets the sums come last."""

    scores: tuple[ModelScore, ...]

    def of(self, dataset: str) -> tuple[ModelScore, ...]:
        return tuple(score for score in self.scores if score.dataset == dataset)

    @property
    def datasets(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(score.dataset for score in self.scores))

    def verdict(self, dataset: str) -> str:
        """The preferred model in words, or that the data do not decide."""
        best, second = sorted(self.of(dataset), key=lambda score: -score.log_evidence)[:2]
        if -second.difference < UNDECIDABLE:
            return f"undecidable: {best.run} and {second.run} differ by {-second.difference:.2f} in log-evidence"
        return f"{best.run} is preferred: log-evidence {-second.difference:.2f} above {second.run}"


def compare(runs: Sequence[str | Path]) -> Comparison:
    """Compare run directories that used the same data.

    Raises
    ------
    OutputError: fewer than two runs, a directory without results, or runs whose observations differ.
    """
    if len(runs) < 2:
        raise OutputError("compare needs at least two run directories")
    names = _labels([Path(run) for run in runs])
    results = {name: _results(Path(run)) for name, run in zip(names, runs, strict=True)}
    first = results[names[0]]
    for name in names[1:]:
        if set(results[name]) != set(first):
            odd = sorted(set(results[name]) ^ set(first))
            raise OutputError(f"{name} and {names[0]} hold different data sets: {', '.join(odd)}")
        for dataset, result in results[name].items():
            if not _same_data(result, first[dataset]):
                raise OutputError(
                    f"{name} and {names[0]} used different observations of {dataset}; evidences of different data, "
                    "errors or weights do not compare"
                )
    scores: list[ModelScore] = []
    for dataset in first:
        scores += _ranked([_score(name, dataset, results[name][dataset]) for name in names])
    if len(first) > 1:
        scores += _ranked([_total(name, [s for s in scores if s.run == name]) for name in names])
    return Comparison(tuple(scores))


def model_probabilities(log_evidence: Array) -> Array:
    """Posterior probabilities (M,) of models with log-evidences (M,) and equal prior probabilities."""
    weights = np.exp(log_evidence - np.max(log_evidence))
    return np.asarray(weights / weights.sum())


def comparison_table(comparison: Comparison) -> str:
    """What the terminal shows: one row a model and data set, and the verdict on each data set."""
    from en4dvar.describe import table

    header = ("data set", "run", "log-evidence", "difference", "probability", "chi2/K", "DFS", "p_WAIC", "NRMSE")
    rows = [
        (
            s.dataset,
            s.run,
            f"{s.log_evidence:.2f}",
            f"{s.difference:.2f}",
            f"{s.probability:.3f}",
            f"{s.chi2_per_observation:.3g}",
            f"{s.dfs:.2f}",
            f"{s.effective_parameters:.2f}",
            f"{s.nrmse:.4f}",
        )
        for s in comparison.scores
    ]
    return "\n".join(
        [table([header, *rows]), "", *(f"{name}: {comparison.verdict(name)}" for name in comparison.datasets)]
    )


def _labels(runs: Sequence[Path]) -> list[str]:
    """Names of the directories; their paths where names repeat."""
    names = [run.resolve().name for run in runs]
    labels = names if len(set(names)) == len(names) else [str(run) for run in runs]
    if len(set(labels)) < len(labels):
        raise OutputError("compare: a run directory is given twice")
    return labels


def _results(run: Path) -> dict[str, Result]:
    """Data set → result of a run directory."""
    files = sorted((run / "datasets").glob("*.nc")) or [run / "posterior.nc"]
    results = [load_result(file) for file in files]
    return {result.name: result for result in results}


def _same_data(a: Result, b: Result) -> bool:
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


def _score(run: str, dataset: str, result: Result) -> ModelScore:
    stats = result.sample_stats.attrs
    likelihood = result.dataset("log_likelihood")[result.observable].values[0]
    alive = result.sample_stats["active"].values.ravel().astype(bool)
    return ModelScore(
        run,
        dataset,
        float(stats["log_evidence"]),
        0.0,
        0.0,
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
