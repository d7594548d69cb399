"""Repeated twin campaigns: how often the population's 95 % interval holds the true mean (slow; run by hand).

python benchmarks/study_population.py 03 20
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from en4dvar.assimilate import assimilate
from en4dvar.build import build
from en4dvar.config import load_config
from en4dvar.config.document import read_document
from en4dvar.config.synthetic import resolve_campaign
from en4dvar.executor import ThreadsExecutor
from en4dvar.observations import Observations
from en4dvar.synthetic import draw_campaign
from en4dvar_bubble.study.gaussian import factors
from en4dvar_bubble.study.population import estimate_population
from en4dvar_bubble.study.run import POPULATION

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


def repeat(key: str, campaigns: int, first_seed: int = 100) -> np.ndarray:
    """(campaigns, 4) bool: the interval holds the mean of the distribution the truths were drawn from."""
    plan = resolve_campaign(read_document(CONFIGS / "agarose_twin.yaml"), CONFIGS)
    (group,) = (g for g in plan.groups if g.name == f"agarose_{key}")
    config = load_config(CONFIGS / f"agarose_{key}_qlkv.yaml")
    base = build(config)[0]
    by_name = {t.parameter.name: t for t in group.terms}
    true = np.array([np.exp(by_name[n].mean + by_name[n].std ** 2 / 2) for n in POPULATION])
    held = []
    with ThreadsExecutor(2) as executor:
        for seed in range(first_seed, first_seed + campaigns):
            start, analyses = time.perf_counter(), []
            for s in draw_campaign(replace(plan, seed=seed, groups=(group,))):
                ones = np.ones(len(s.times))
                observed = Observations(s.times, s.values, plan.noise * ones, 0 * ones, ones, name=s.name)
                problem = replace(base, observations=observed)
                analyses.append(assimilate(problem, config.assimilation, config.seed, executor))
            found = estimate_population(factors(analyses, base.prior), base.prior, POPULATION, seed)
            low, high = found.interval()
            held.append((low < true) & (true < high))
            told = ", ".join(
                f"{n} {a / t:.2f}–{b / t:.2f}" for n, a, b, t in zip(POPULATION, low, high, true, strict=True)
            )
            print(f"{seed}: interval / truth: {told} ({time.perf_counter() - start:.1f} s)", flush=True)
    return np.array(held)


if __name__ == "__main__":
    inside = repeat(sys.argv[1], int(sys.argv[2]))
    print(dict(zip(POPULATION, inside.sum(axis=0).tolist(), strict=True)), "of", len(inside))
