"""Does the assimilation end at the global minimum of J? Counts and forward runs of several ways to start.

    python benchmarks/mode_finding.py --n 24                  the twin, priors of 30 %
    python benchmarks/mode_finding.py --n 400 --prior wide    doubled spread: 1.0 in ln G, ln alpha; 0.7 in ln mu, ln R0

The reference is the lowest J among all ways, twenty random starts of another ensemble and, with ``--mcmc``, a chain.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior

from en4dvar import mcmc
from en4dvar.assimilate import assimilate
from en4dvar.forecast import log_posterior
from en4dvar.problem import AssimilationSettings, InverseProblem

WAYS = {
    "prior mean": AssimilationSettings(start="prior-mean"),
    "best member": AssimilationSettings(starts=1),
    "default (2 starts)": AssimilationSettings(),
    "3 starts": AssimilationSettings(starts=3),
    "8 starts": AssimilationSettings(starts=8),
    "2 starts, Levenberg-Marquardt": AssimilationSettings(step_control="levenberg-marquardt"),
}
TOLERANCE = 0.1  # of J: closer ends are the same minimum


def reference(problem: InverseProblem, seed: int, chain: bool) -> float:
    """The lowest J known: twenty starts of a random ensemble and the best point of a Markov chain."""
    settings = AssimilationSettings(starts=20, members=120, sampling="random")
    end = assimilate(problem, settings, 10_000 + seed)
    best = -float(log_posterior(problem, problem.prior.from_physical(end.centre)[None])[0])
    if chain:
        x = problem.prior.from_physical(end.posterior)
        sampled = mcmc.sample(lambda z: log_posterior(problem, z), x, seed, max_steps=300)
        best = min(best, -float(sampled.log_density.max()))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=24, help="experiments")
    parser.add_argument("--prior", choices=("narrow", "wide"), default="narrow")
    parser.add_argument("--time-std", type=float, default=0.0, help="timing error, s")
    parser.add_argument("--mcmc", action="store_true", help="look for lower minima with a chain as well")
    options = parser.parse_args()
    of = prior(NARROW if options.prior == "narrow" else WIDE)
    excess: dict[str, list[float]] = {way: [] for way in WAYS}
    runs: dict[str, list[int]] = {way: [] for way in WAYS}
    began = time.perf_counter()
    for seed in range(options.n):
        problem = make_twin(seed, of, time_std=options.time_std).problem
        costs = {}
        for way, settings in WAYS.items():
            analysis = assimilate(problem, settings, seed)
            costs[way] = analysis.iterations[-1].cost
            runs[way].append(analysis.forward_runs)
        lowest = min(reference(problem, seed, options.mcmc), *costs.values())
        for way, cost in costs.items():
            excess[way].append(cost - lowest)
            if cost > lowest + TOLERANCE:
                print(f"  experiment {seed}: {way} ends {cost - lowest:.2f} above J = {lowest:.2f}", flush=True)
    print(f"\n{options.n} experiments, {options.prior} priors, {time.perf_counter() - began:.0f} s")
    print(f"{'':32}{'at the minimum':>16}{'forward runs':>14}")
    for way in WAYS:
        found = np.array(excess[way]) <= TOLERANCE
        print(f"{way:32}{found.sum():8d} / {len(found):<5d}{np.mean(runs[way]):14.0f}")


if __name__ == "__main__":
    main()
