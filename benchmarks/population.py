"""Is the population of a campaign calibrated? Truths from the hyperprior, ranks of mean, spread and single bubbles.

    python benchmarks/population.py [--n 50] [--start 0] [--bubbles 8] [--law nh|ql] [--minutes 14]

Campaign ``i`` has seed ``i``: means and spreads of the logarithms of the population's parameters from the hyperprior
(one and half a standard deviation of the prior), of every bubble its parameters from that population and what is its
own from the prior. ``nh``: laser-induced, neo-Hookean, G and μ (:mod:`laser_twin`); ``ql``: acoustic, quadratic, G, α
and μ (:mod:`acoustic_twin`). Records stand in runs/population and are continued.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import acoustic_twin
import laser_twin
import numpy as np
from records import Record, fill
from scipy.stats import kstest

from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population import population_of
from en4dvar.estimation.population.campaign import moments
from en4dvar.model.state import Array
from en4dvar.priors.prior import own_seed
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

RECORDS = Path("runs") / "population"
PRIORS = {"nh": laser_twin.laser_prior(), "ql": acoustic_twin.prior(acoustic_twin.WIDE)}
LAWS = {"nh": ("G", "mu"), "ql": ("G", "alpha", "mu")}
SETTINGS = AssimilationSettings(what_if=False, refine="none")
MEAN_STD, SPREAD = 1.0, 0.5


def bubble(law: str, seed: int, rng: np.random.Generator, truth: Array) -> InverseProblem | None:
    """Readings of a truth (n,), transformed; None where it cannot be integrated, or yields too few."""
    if law == "ql":
        twin = acoustic_twin.read_twin(seed, rng, PRIORS[law], truth)
        return twin and twin.problem
    design = laser_twin.make_laser_twin(0).problem
    observed = design.observations
    run = forecast(design, truth[None])
    if run.failures[0]:
        return None
    values = run.predictions[0] + observed.std * rng.standard_normal(len(observed))
    return replace(design, observations=replace(observed, values=values))


def campaign(law: str, seed: int, bubbles: int) -> tuple[list[InverseProblem], Array, Array, Array]:
    """Problems, and the truth: ν and τ (p,) in units of the prior, control vectors (bubbles, n).

    All truths are drawn again where one bubble cannot be read: the fit knows nothing of a choice among populations.
    """
    prior, rng = PRIORS[law], np.random.default_rng([20264, seed])
    where = [prior.names.index(name) for name in LAWS[law]]
    while True:
        nu = MEAN_STD * rng.standard_normal(len(where))
        tau = SPREAD * np.abs(rng.standard_normal(len(where)))
        problems: list[InverseProblem] = []
        truths: list[Array] = []
        for i in range(bubbles):
            z = rng.standard_normal(len(prior.names))
            z[where] = nu + tau * z[where]
            one = bubble(law, 1000 * seed + i, rng, prior.from_white(z))
            if one is None:
                break
            problems.append(replace(one, observations=replace(one.observations, name=f"bubble{i}")))
            truths.append(prior.from_white(z))
        if len(problems) == bubbles:
            return problems, nu, tau, np.array(truths)


def ranks(law: str, seed: int, bubbles: int) -> Record:
    """Where the truths lie among the draws, between 0 and 1."""
    began = time.process_time()
    problems, nu, tau, truths = campaign(law, seed, bubbles)
    prior, names = problems[0].prior, LAWS[law]
    start = []
    for one in problems:
        found = assimilate(one, SETTINGS, own_seed(seed, one.observations.name))
        alive = found.posterior[np.isfinite(found.posterior).all(axis=1)]
        start.append(prior.white(prior.from_physical(alive)))
    result = population_of(problems, start, names, seed)
    std = np.array([term.std for term in result.terms])
    centre = np.array([term.mean for term in result.terms])
    mean, between = moments(result.terms, (centre + std * nu)[None], (std * tau)[None])
    where = [prior.names.index(name) for name in names]
    truth = {"mean": mean[0], "between": between[0], "bubble": prior.to_physical(truths)[0][where]}
    draws = {"mean": result.posterior.mean, "between": result.posterior.between, "bubble": result.sets[:, 0, where]}
    found_ranks = {
        f"{what} {name}": float(np.mean(draws[what][:, j] < truth[what][j]))
        for what in truth
        for j, name in enumerate(names)
    }
    size = result.size
    return {"ranks": found_ranks, "size": size, "seconds": time.process_time() - began}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=50)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--bubbles", type=int, default=8)
    parser.add_argument("--law", choices=tuple(LAWS), default="nh")
    parser.add_argument("--minutes", type=float, default=14.0)
    asked = parser.parse_args()
    keys = [str(seed) for seed in range(asked.start, asked.start + asked.n)]
    file = RECORDS / f"{asked.law}_{asked.bubbles}.jsonl"
    done = fill(file, keys, lambda key: ranks(asked.law, int(key), asked.bubbles), asked.minutes)
    records = list(done.values())
    sizes, seconds = (np.array([one[key] for one in records]) for key in ("size", "seconds"))
    print(f"{len(records)} campaigns of {asked.bubbles} bubbles ({asked.law}), {np.median(seconds):.0f} s of CPU each")
    print(f"effective draws: median {np.median(sizes):.0f}, below 100 in {int((sizes < 100).sum())}")
    print("| quantity | ranks uniform, p | inside 50 % | inside 90 % |")
    print("|---|---|---|---|")
    for name in records[0]["ranks"]:
        u = np.array([one["ranks"][name] for one in records])
        inside = [f"{100 * np.mean(np.abs(u - 0.5) < level / 2):.0f} %" for level in (0.5, 0.9)]
        print(f"| {name} | {kstest(u, 'uniform').pvalue:.3f} | {inside[0]} | {inside[1]} |")


if __name__ == "__main__":
    main()
