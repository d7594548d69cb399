"""Calibration measured by repeated experiments, as the benchmarks wrote it: too slow to be part of every study.

``population.csv``: python benchmarks/study_population.py; ``reliability.csv``: python benchmarks/study_reliability.py.
"""

import csv
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from en4dvar.model.state import Array
from en4dvar_agarose.fits import probability

FOLDER = Path(__file__).parent

LEVEL, FIRST = 0.95, 20  # of the intervals; campaigns that the criterion asks for
EDGES = (0.5, 0.6, 0.75, 0.9, 0.99, 1.0 + 1e-9)  # of the stated probability of the favoured law
EXPERIMENTS = {
    "paper": "the paper's experiment, 0.3 % gel",
    "deciding": "1 % gel, 0.3 µm, two frames a µs for 32 µs (first rebound included)",
}


@dataclass(frozen=True)
class Bin:
    """Experiments whose stated probabilities lie in one bin: mean ``stated``, share ``right``, how many, and the
    binomial standard deviation of the share if what is stated were true.
    """

    stated: float
    right: float
    count: int
    error: float


def reliability(experiment: str) -> tuple[Array, Array]:
    """Log-evidence of the quadratic over the neo-Hookean law (E,) and whether that law made the data (E,)."""
    rows = [row for row in _rows("reliability.csv") if row["experiment"] == experiment]
    difference = np.array([float(row["delta_log_evidence"]) for row in rows])
    return difference, np.array([row["generated_by"] == "qlkv" for row in rows])


def bins(difference: Array, quadratic: Array) -> tuple[Bin, ...]:
    """Stated probability of the favoured law against how often it is the right one; empty bins left out."""
    stated = np.maximum(probability(difference), probability(-difference))
    right = (difference > 0) == quadratic
    shares = []
    for low, high in pairwise(EDGES):
        here = (stated >= low) & (stated < high)
        if here.any():
            # independent, not identical, trials
            error = float(np.sqrt(np.sum(stated[here] * (1 - stated[here])))) / int(here.sum())
            shares.append(Bin(float(stated[here].mean()), float(right[here].mean()), int(here.sum()), error))
    return tuple(shares)


@dataclass(frozen=True)
class Coverage:
    """The number of ``campaigns``, and those whose 95 % interval of a population mean holds the mean of the lognormal
    that the truths were drawn from (``held``; ``of_first`` among the first 20), and the mean of the truths drawn
    (``of_drawn``).
    """

    gel: str
    parameter: str
    of_first: int
    held: int
    of_drawn: int
    campaigns: int

    @property
    def error(self) -> float:
        """Binomial standard deviation of the share held if what is stated were true."""
        return float(np.sqrt(LEVEL * (1 - LEVEL) / self.campaigns))


def coverage() -> list[Coverage]:
    """Coverage of every gel and parameter."""
    covered: dict[tuple[str, str], list[tuple[bool, bool]]] = {}
    for row in sorted(_rows("population.csv"), key=lambda row: (row["gel"], int(row["seed"]))):
        low, high = float(row["low"]), float(row["high"])
        held = (low < float(row["true_mean"]) < high, low < float(row["mean_of_truths"]) < high)
        covered.setdefault((row["gel"], row["parameter"]), []).append(held)
    return [
        Coverage(
            gel, name, sum(held for held, _ in rows[:FIRST]), sum(held for held, _ in rows), sum(h for _, h in rows),
            len(rows),
        )
        for (gel, name), rows in covered.items()
    ]  # fmt: skip


def _rows(name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((FOLDER / name).read_text(encoding="utf-8").splitlines()))
