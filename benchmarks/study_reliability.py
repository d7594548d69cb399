"""Reliability of model probabilities: experiments generated half by each law from its prior, both laws compared.

    python benchmarks/study_reliability.py 200            # the paper's noise
    python benchmarks/study_reliability.py 100 0.1        # noise of 0.1 µm: the experiment that decides

Truths are drawn from the priors the evidence integrates over, so stated probability and frequency must agree.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from en4dvar.assimilate import assimilate
from en4dvar.build import build
from en4dvar.config import load_config
from en4dvar.executor import ThreadsExecutor
from en4dvar.forecast import forecast
from en4dvar.observations import Observations
from en4dvar_bubble.study.evidence import DECISIVE, probability

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
STOP, MOST, FEWEST = 0.35, 60, 5


def experiments(count: int, noise: float, gel: str = "03") -> tuple[np.ndarray, np.ndarray]:
    """Δ log-evidence (count,) of the quadratic law, and whether it generated the data (count,)."""
    configs = {m: load_config(CONFIGS / f"agarose_{gel}_{m}.yaml") for m in ("nh", "qlkv")}
    bases = {m: build(c)[0] for m, c in configs.items()}
    difference, quadratic = np.empty(count), np.arange(count) % 2 == 1
    with ThreadsExecutor(2) as executor:
        for i in range(count):
            observed = draw(bases["qlkv" if quadratic[i] else "nh"], noise, np.random.default_rng([11, i]))
            log = {
                m: assimilate(replace(b, observations=observed), configs[m].assimilation, 1, executor).log_evidence
                for m, b in bases.items()
            }
            difference[i] = log["qlkv"] - log["nh"]
    return difference, quadratic


def draw(base, noise: float, rng: np.random.Generator) -> Observations:
    """Readings of one bubble drawn from the prior; when they end is decided by the readings alone."""
    prior = base.prior
    while True:
        x = prior.mean + prior.std * rng.standard_normal(len(prior.names))
        times = rng.uniform(4.25e-6, 5.5e-6) + np.cumsum(np.r_[0.0, rng.uniform(1.25e-6, 2e-6, MOST - 1)])
        ones = np.ones(MOST)
        run = forecast(replace(base, observations=Observations(times, ones, noise * ones, 0 * ones, ones)), x[None])
        values = run.predictions[0] + noise * rng.standard_normal(MOST)
        if run.failures[0]:
            continue
        below = np.flatnonzero(values < STOP * np.maximum.accumulate(values))
        k = int(below[0]) + 1 if len(below) else MOST
        if k >= FEWEST:
            return Observations(times[:k], values[:k], noise * ones[:k], 0 * ones[:k], ones[:k])


if __name__ == "__main__":
    noise = float(sys.argv[2]) * 1e-6 if len(sys.argv) > 2 else 1.2e-6
    delta, truth = experiments(int(sys.argv[1]), noise, sys.argv[3] if len(sys.argv) > 3 else "03")
    p = probability(delta)
    right = (delta > 0) == truth
    print(f"decided rightly {right.mean():.3f}; undecidable {np.mean(np.abs(delta) < DECISIVE):.3f}")
    confidence = np.maximum(p, 1 - p)
    for low, high in ((0.5, 0.6), (0.6, 0.75), (0.75, 0.9), (0.9, 0.99), (0.99, 1.0001)):
        here = (confidence >= low) & (confidence < high)
        if here.any():
            n, stated = int(here.sum()), float(confidence[here].mean())
            error = np.sqrt(stated * (1 - stated) / n)
            print(f"stated {stated:.3f}: right {right[here].mean():.3f} of {n} (binomial std {error:.3f})")
