"""Reliability of model probabilities: experiments generated half by each law from its prior, both laws compared.

    python benchmarks/study_reliability.py paper 200 [first]      # the paper's experiment, 0.3 % gel
    python benchmarks/study_reliability.py deciding 100 [first]   # one that tells the laws apart

Adds a line an experiment to benchmarks/measured/reliability.csv, those found there left out, so that a run which was
stopped continues, and prints the table of docs/agarose_study.md. Truths are drawn from the priors the evidence
integrates over, so stated probability and frequency must agree.
"""

from __future__ import annotations

import csv
import os
import sys
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population.own import own_draws
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_agarose.fits import probability

THREADS = int(os.environ.get("THREADS", "2"))
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
FILE = Path(__file__).resolve().parent / "measured" / "reliability.csv"
HEAD = ["experiment", "number", "generated_by", "delta_log_evidence"]
FEWEST = 5
EDGES = (0.5, 0.6, 0.75, 0.9, 0.99, 1.0 + 1e-9)  # of the stated probability of the favoured law


@dataclass(frozen=True)
class Experiment:
    """Readings from 4.25–5.5 µs on, ``spacing`` apart (s), std ``noise`` (m), until the first below ``stop`` times the
    largest so far; at most ``most``. ``changes`` of the priors, a law each.
    """

    gel: str = "03"
    noise: float = 1.2e-6
    spacing: tuple[float, float] = (1.25e-6, 2e-6)
    stop: float = 0.35
    most: int = 60
    changes: dict[str, dict[str, str]] = field(default_factory=dict)


EXPERIMENTS = {
    "paper": Experiment(),
    # 1 % gel, two frames a µs, 0.3 µm, 32 µs: growth, collapse and the first rebound
    "deciding": Experiment(gel="10", noise=0.3e-6, spacing=(0.4e-6, 0.6e-6), stop=-1.0, most=64),
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
    kept = csv.DictReader(FILE.read_text(encoding="utf-8").splitlines())
    rows = [row for row in kept if row["experiment"] == experiment]
    difference = np.array([float(row["delta_log_evidence"]) for row in rows])
    return difference, np.array([row["generated_by"] == "qlkv" for row in rows])


def bins(difference: Array, quadratic: Array, edges: tuple[float, ...] = EDGES) -> tuple[Bin, ...]:
    """Stated probability of the favoured law against how often it is the right one; empty bins left out."""
    stated = np.maximum(probability(difference), probability(-difference))
    right = (difference > 0) == quadratic
    shares = []
    for low, high in pairwise(edges):
        here = (stated >= low) & (stated < high)
        if here.any():
            # independent, not identical, trials
            error = float(np.sqrt(np.sum(stated[here] * (1 - stated[here])))) / int(here.sum())
            shares.append(Bin(float(stated[here].mean()), float(right[here].mean()), int(here.sum()), error))
    return tuple(shares)


def table() -> list[str]:
    """Rows of docs/agarose_study.md: of each experiment all, and bin by bin."""
    rows = []
    for name in EXPERIMENTS:
        kept = reliability(name)
        shown = [(f"{name}, all", b) for b in bins(*kept, (EDGES[0], EDGES[-1]))] + [(name, b) for b in bins(*kept)]
        rows += [f"| {words} | {b.stated:.3f} | {b.right:.3f} | {b.count} | {b.error:.3f} |" for words, b in shown]
    return rows


def problems(experiment: Experiment) -> dict[str, InverseProblem]:
    """Law → a problem to put readings in."""
    found = {}
    for law in ("nh", "qlkv"):
        changes = {f"parameters.{k}": v for k, v in experiment.changes.get(law, {}).items()}
        found[law] = build(load_config(CONFIGS / f"agarose_{experiment.gel}_{law}.yaml", changes))[0]
    return found


def draw(base: InverseProblem, experiment: Experiment, rng: np.random.Generator) -> Observations:
    """Readings of one bubble drawn from the prior; when they end is decided by the readings alone."""
    prior, most, noise = base.prior, experiment.most, experiment.noise
    while True:
        x = prior.mean + prior.std * rng.standard_normal(len(prior.names))
        gaps = rng.uniform(*experiment.spacing, most - 1)
        times = rng.uniform(4.25e-6, 5.5e-6) + np.cumsum(np.r_[0.0, gaps])
        ones = np.ones(most)
        run = forecast(replace(base, observations=Observations(times, ones, noise_of(noise * ones), ones)), x[None])
        values = run.predictions[0] + noise * rng.standard_normal(most)
        if run.failures[0]:
            continue
        below = np.flatnonzero(values < experiment.stop * np.maximum.accumulate(values))
        k = int(below[0]) + 1 if len(below) else most
        if k >= FEWEST:
            return Observations(times[:k], values[:k], noise_of(noise * ones[:k]), ones[:k])


def compare(bases: dict[str, InverseProblem], experiment: Experiment, number: int) -> tuple[str, float]:
    """The law that generated experiment ``number`` and the log-evidence of the quadratic over the neo-Hookean law."""
    law = "qlkv" if number % 2 else "nh"
    observed = draw(bases[law], experiment, np.random.default_rng([11, number]))
    with ThreadsExecutor(THREADS) as executor:
        log = {}
        for name, base in bases.items():
            problem = replace(base, observations=observed)
            members = assimilate(problem, AssimilationSettings(what_if=False), number, executor).survivors
            start = base.prior.white(base.prior.from_physical(members))
            log[name] = own_draws(problem, start, number, executor).log_evidence
    return law, log["qlkv"] - log["nh"]


def main() -> None:
    name, count = sys.argv[1], int(sys.argv[2])
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    kept = list(csv.reader(FILE.read_text(encoding="utf-8").splitlines())) if FILE.exists() else [HEAD]
    done = {(row[0], row[1]) for row in kept[1:]}
    experiment = EXPERIMENTS[name]
    bases = problems(experiment)
    for number in range(first, first + count):
        if (name, str(number)) in done:
            continue
        law, difference = compare(bases, experiment, number)
        with FILE.open("a", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerows([*([] if FILE.stat().st_size else [HEAD]), [name, number, law, f"{difference:.4f}"]])
    print("\n".join(table()))


if __name__ == "__main__":
    main()
