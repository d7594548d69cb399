"""Reliability of model probabilities: experiments generated half by each law from its prior, both laws compared.

    python benchmarks/study_reliability.py paper 200 [first]      # the paper's experiment, 0.3 % gel
    python benchmarks/study_reliability.py deciding 100 [first]   # one that tells the laws apart

Adds a line an experiment to models/en4dvar_agarose/measured/reliability.csv, which the study's report shows; those
found there are left out, so a run that was stopped continues. Truths are drawn from the priors the evidence integrates
over, so stated probability and frequency must agree.
"""

from __future__ import annotations

import csv
import os
import sys
from dataclasses import dataclass, field, replace
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
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_agarose.fits import probability
from en4dvar_agarose.measured import FOLDER

THREADS = int(os.environ.get("THREADS", "2"))
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
HEAD = ["experiment", "number", "generated_by", "delta_log_evidence"]
FEWEST = 5


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
            members = assimilate(problem, AssimilationSettings(what_if=False), number, executor).posterior
            start = base.prior.white(base.prior.from_physical(members))
            log[name] = own_draws(problem, start, number, executor).log_evidence
    return law, log["qlkv"] - log["nh"]


def main() -> None:
    name, count = sys.argv[1], int(sys.argv[2])
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    file = FOLDER / "reliability.csv"
    kept = list(csv.reader(file.read_text(encoding="utf-8").splitlines())) if file.exists() else [HEAD]
    done = {(row[0], row[1]) for row in kept[1:]}
    experiment = EXPERIMENTS[name]
    bases = problems(experiment)
    for number in range(first, first + count):
        if (name, str(number)) in done:
            continue
        law, difference = compare(bases, experiment, number)
        with file.open("a", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerows([*([] if file.stat().st_size else [HEAD]), [name, number, law, f"{difference:.4f}"]])
    rows = [row for row in csv.reader(file.read_text(encoding="utf-8").splitlines()) if row[0] == name]
    delta = np.array([float(row[3]) for row in rows])
    right = (delta > 0) == np.array([row[2] == "qlkv" for row in rows])
    stated = np.maximum(probability(delta), probability(-delta))
    print(f"{name}: {len(rows)} experiments, {right.mean():.3f} decided rightly, stated {stated.mean():.3f}")


if __name__ == "__main__":
    main()
