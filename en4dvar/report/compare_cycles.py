"""Sequences of the same readings side by side: evidence by the forecasts of their observations.

ln p(y) = Σ_k ln p(y_k | y_1 … y_{k−1}), each the density of N(H x̄, P + R) of the forecast: exact for a linear model and
an ensemble of enough members, as in a Kalman filter. Source: Schweppe (1965), IEEE Trans. Inf. Theory 11, 61; for
model selection by ensembles: Carrassi, Bocquet, Hannart & Ghil (2017), Q. J. R. Meteorol. Soc. 143, 866.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import softmax

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.tables import table
from en4dvar.report.compare import named, preferred
from en4dvar.results.netcdf import Group
from en4dvar.results.series_file import read_series, series_file

READINGS = ("time", "observation", "observations", "observation_std", "observation_correlation")


@dataclass(frozen=True)
class SequenceScore:
    """``innovation``: root mean square of normalised innovations; ``difference`` to the largest log-evidence."""

    run: str
    scheme: str
    log_evidence: float
    difference: float
    probability: float
    innovation: float


def compare_sequences(run_dirs: Sequence[Path]) -> tuple[SequenceScore, ...]:
    """Score sequences, in the order given.

    Raises
    ------
    OutputError: fewer than two, one of them no sequence, without an evidence, or of other readings.
    """
    runs = {name: _sequence(run_dir) for name, run_dir in named(run_dirs).items()}
    (first, reference), *others = runs.items()
    for name, other in others:
        if not all(_same(reference, other, key) for key in READINGS):
            raise OutputError(f"{name} and {first} hold other readings or errors: their evidences cannot be compared")
    evidence = np.array([float(data.attrs["log_evidence"]) for data in runs.values()])
    sizes = [np.sqrt(np.nanmean(data["normalised_innovation"].values ** 2)) for data in runs.values()]
    each = zip(evidence, evidence - evidence.max(), softmax(evidence), sizes, strict=True)
    return tuple(
        SequenceScore(run, str(data.attrs["scheme"]), *map(float, numbers))
        for (run, data), numbers in zip(runs.items(), each, strict=True)
    )


def sequences_table(scores: Sequence[SequenceScore]) -> str:
    """What the terminal shows: a row a run, and which is preferred."""
    header = ("run", "scheme", "log-evidence", "difference", "probability", "innovations / expected")
    rows = [
        (s.run, s.scheme, f"{s.log_evidence:.2f}", f"{s.difference:.2f}", f"{s.probability:.3f}", f"{s.innovation:.3g}")
        for s in scores
    ]
    best, second = sorted(scores, key=lambda score: -score.log_evidence)[:2]
    return f"{table([header, *rows])}\n\n{preferred(best.run, second.run, -second.difference)}"


def _sequence(run_dir: Path) -> Group:
    file = series_file(run_dir)
    if file is None:
        raise OutputError(f"{run_dir}: no sequence; sequences are compared with sequences of the same readings")
    if file.stem == "twin":
        raise OutputError(f"{run_dir}: a twin experiment has no evidence; RMSE and spread are in its summary.csv")
    data = read_series(file)
    if "log_evidence" not in data.attrs:
        raise OutputError(f"{run_dir}: written by an earlier version, without an evidence; run it again")
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
