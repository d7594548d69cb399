"""Joint estimates of synthetic bubbles: are they calibrated, and what do they cost beside single ones?

    python benchmarks/joint.py calibration [--n 200] [--bubbles 8]    laser-induced bubbles that share G and mu
    python benchmarks/joint.py cost [--bubbles 39]                    forward runs and time against single estimates

Campaign ``i`` has seed ``i``: one G and one mu from the prior of :mod:`laser_twin`, and for every bubble its own R_max
and R_eq. Ranks of what is shared and of the first bubble's own among the 48 members, as in benchmarks/calibration.py.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from laser_twin import MODEL, STD, TIMES, laser_prior
from scipy.stats import binomtest, chisquare

from en4dvar.assimilate import assimilate
from en4dvar.ensemble.forecast import forecast
from en4dvar.joint import JointProblem, estimate_jointly, sharing
from en4dvar.noise import noise_of
from en4dvar.observations import Observations
from en4dvar.prior import own_seed
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.state import Array

SHARED = ("G", "mu")
BINS, CENTRAL = 7, (25, 45)  # of 49 ranks, as in benchmarks/calibration.py
SETTINGS = AssimilationSettings(what_if=False)


def campaign(seed: int, bubbles: int, shared: tuple[str, ...] = SHARED) -> tuple[JointProblem, Array]:
    """Bubbles of one gel and their truths (bubbles, n). A truth that cannot be integrated is drawn again."""
    prior, ones = laser_prior(), np.ones(len(TIMES))
    rng = np.random.default_rng([20261, seed])
    where = [prior.names.index(name) for name in shared]
    common = prior.mean[where] + prior.std[where] * rng.standard_normal(len(where))
    problems, truths = [], []
    while len(problems) < bubbles:
        truth = prior.mean + prior.std * rng.standard_normal(len(prior.names))
        truth[where] = common
        observed = Observations(TIMES, ones, noise_of(STD * ones, 0 * ones), ones, name=f"bubble{len(problems)}")
        problem = InverseProblem(MODEL, MODEL.observables[0], observed, prior)
        run = forecast(problem, truth[None])
        if run.failures[0]:
            continue
        values = run.predictions[0] + STD * rng.standard_normal(len(TIMES))
        data = Observations(TIMES, values, observed.noise, ones, name=observed.name)
        problems.append(InverseProblem(MODEL, MODEL.observables[0], data, prior))
        truths.append(truth)
    return sharing(problems, shared), np.array(truths)


def calibration(n: int, bubbles: int) -> None:
    """A row for each quantity."""
    names, ranks, scores, effective, warned = [], [], [], [], 0
    for seed in range(n):
        joint, truths = campaign(seed, bubbles)
        found = estimate_jointly(joint, SETTINGS, seed)
        members = joint.experiments[0].prior.from_physical(found.control(0)[:-1])
        names = list(joint.experiments[0].prior.names)
        ranks.append((members < truths[0]).sum(axis=0))
        scores.append((truths[0] - members.mean(axis=0)) / members.std(axis=0, ddof=1))
        effective.append(found.members.effective)
        warned += bool(found.cautions)
        for one in found.cautions:
            print(f"campaign {seed}: {one.code}", flush=True)
    rank, z = np.array(ranks), np.array(scores)
    print(f"{n} campaigns of {bubbles} bubbles, {warned} warn, effective draws: median {np.nanmedian(effective):.0f}")
    print("| parameter | rank histogram p | std of z | mean of z | inside 51.0% | inside 91.8% |")
    print("|---|---|---|---|---|---|")
    for j, name in enumerate(names):
        p = chisquare(np.histogram(rank[:, j], BINS, (-0.5, 48.5))[0]).pvalue
        inside = [int((np.abs(rank[:, j] - 24) <= (count - 1) / 2).sum()) for count in CENTRAL]
        shares = [f"{100 * k / n:.1f}%" for k in inside]
        fair = [binomtest(k, n, c / 49).pvalue for k, c in zip(inside, CENTRAL, strict=True)]
        told = "" if min(p, *fair) > 0.01 else " (p < 0.01)"
        print(f"| {name} | {p:.3f} | {z[:, j].std():.3f} | {z[:, j].mean():+.3f} | {shares[0]} | {shares[1]}{told} |")


def cost(bubbles: int) -> None:
    """Single estimates, then the joint one that starts from scratch and makes its own."""
    joint, _ = campaign(0, bubbles, ("G", "mu", "R_eq"))
    alone = AssimilationSettings(what_if=False)
    started, runs = time.process_time(), 0
    for one in joint.experiments:
        runs += assimilate(one, alone, own_seed(0, one.observations.name)).forward_runs
    single = time.process_time() - started
    started = time.process_time()
    found = estimate_jointly(joint, SETTINGS, 0)
    together = time.process_time() - started
    print(f"{bubbles} single estimates: {runs} forward runs, {single:.1f} s of CPU")
    ratio = f"{together:.1f} s: {together / single:.2f} times"
    print(f"joint, single starts included: {found.forward_runs} forward runs, {ratio}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("calibration", "cost"))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--bubbles", type=int)
    asked = parser.parse_args()
    if asked.what == "calibration":
        calibration(asked.n, asked.bubbles or 8)
    else:
        cost(asked.bubbles or 39)


if __name__ == "__main__":
    main()
