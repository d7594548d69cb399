"""Calibration measured by repeated experiments, as the benchmarks wrote it: too slow to be part of every study.

``population.csv``: python benchmarks/study_population.py; ``reliability.csv``: python benchmarks/study_reliability.py.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.study.evidence import probability

FOLDER = Path(__file__).parent
POPULATION_HEAD = ["gel", "seed", "parameter", "low", "median", "high", "true_mean", "mean_of_truths", "stacked_mean"]
POPULATION_HEAD += ["r_hat", "effective", "weighed_emulators", "weighed_runs"]
RELIABILITY_HEAD = ["experiment", "number", "generated_by", "delta_log_evidence"]

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
    found = []
    for low, high in pairwise(EDGES):
        here = (stated >= low) & (stated < high)
        if here.any():
            # independent, not identical, trials
            error = float(np.sqrt(np.sum(stated[here] * (1 - stated[here])))) / int(here.sum())
            found.append(Bin(float(stated[here].mean()), float(right[here].mean()), int(here.sum()), error))
    return tuple(found)


def coverage() -> list[tuple[str, str, int, int, int]]:
    """Gel, parameter, campaigns whose 95 % interval of the population mean holds the mean of the lognormal the truths
    were drawn from, those where it holds the mean of the truths drawn, campaigns.
    """
    found: dict[tuple[str, str], list[int]] = {}
    for row in _rows("population.csv"):
        low, high = float(row["low"]), float(row["high"])
        count = found.setdefault((row["gel"], row["parameter"]), [0, 0, 0])
        count[0] += low < float(row["true_mean"]) < high
        count[1] += low < float(row["mean_of_truths"]) < high
        count[2] += 1
    return [(gel, name, *counts) for (gel, name), counts in sorted(found.items(), key=lambda item: item[0][0])]  # type: ignore[misc]


def _rows(name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((FOLDER / name).read_text(encoding="utf-8").splitlines()))
