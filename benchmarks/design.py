"""Expected information of planned laser bubbles: how fast, and does the cheap estimate rank as the exact one?

    python benchmarks/design.py speed          100 designs by linearisation over the prior: seconds of one core
    python benchmarks/design.py rank           20 random designs, linearised and nested: differences, Kendall's tau
    python benchmarks/design.py exact --n 5    nested against brute force: draws of the prior alone behind ln p(y)

Design ``i`` has seed ``i``: step and end of the readings, their error and the largest radius; neo-Hookean Kelvin-Voigt,
polytropic gas, priors of benchmarks/laser_twin.py. All are synthetic. Brute force is told as a lower bound where the
draws of the prior that explain the readings are few.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from laser_twin import MODEL, laser_prior
from scipy.special import logsumexp
from scipy.stats import kendalltau

from en4dvar.design.evaluate import SampleSizes, evaluate
from en4dvar.design.planned import Planned
from en4dvar.noise import noise_of
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.state import Array

ABOUT = ("G", "mu")
SIZES = SampleSizes()


def planned_bubble(seed: int, coarse: float = 1.0) -> InverseProblem:
    """A random design; errors ``coarse`` times as large."""
    rng = np.random.default_rng([20261122, seed])
    step, end = rng.uniform(0.7e-6, 3e-6), rng.uniform(25e-6, 60e-6)
    times = np.arange(0.7e-6, end, step)
    std, largest = coarse * rng.uniform(0.5e-6, 3e-6), rng.uniform(180e-6, 280e-6)
    prior = laser_prior()
    terms = [replace(t, mean=largest) if t.parameter.name == "R_max" else t for t in prior.terms]
    ones = np.ones(len(times))
    data = Observations(times, ones, noise_of(std * ones, 0 * ones), ones, name=f"design{seed}")
    return InverseProblem(MODEL, MODEL.observables[0], data, Prior(tuple(terms)))


def speed(count: int) -> None:
    """Seconds of 100 designs."""
    evaluate(planned_bubble(0), ABOUT, SIZES, "laplace", 0)  # compiles
    began, cpu = time.perf_counter(), time.process_time()
    runs = sum(evaluate(planned_bubble(i), ABOUT, SIZES, "laplace", 0)[0].forward_runs for i in range(count))
    print(
        f"{count} designs, {runs} runs: {time.process_time() - cpu:.1f} s of CPU, {time.perf_counter() - began:.1f} s"
    )


def rank(count: int) -> None:
    """Linearised and nested information of random designs."""
    found = []
    for i in range(count):
        cheap, exact = (evaluate(planned_bubble(i), ABOUT, SIZES, method, 0)[0] for method in ("laplace", "nested"))
        found.append((cheap.gain, exact.gain, exact.error))
        print(f"design {i}: linearised {cheap.gain:.3f}, nested {exact.gain:.3f} ± {exact.error:.3f}", flush=True)
    cheap, exact, _ = np.array(found).T
    apart = cheap - exact
    print(f"linearised less nested: {apart.mean():+.3f} in the mean, {np.abs(apart).max():.3f} at most")
    print(f"Kendall's tau {kendalltau(cheap, exact).statistic:.3f}")


def exact(count: int, inner: int, outer: int) -> None:
    """Information about everything, against ln p(y) from ``inner`` draws of the prior; errors ten times as large."""
    for i in range(count):
        problem = planned_bubble(i, coarse=10)
        planned = Planned(problem)
        found = evaluate(problem, (), SIZES, "nested", 0)[0]
        predictions = _predictions(planned, inner, i)
        truths = _predictions(planned, outer, 1000 + i)
        std, rng = problem.observations.std, np.random.default_rng([7, i])
        gains = []
        for truth in truths:
            e = rng.standard_normal(len(std))
            logs = -0.5 * np.sum(((truth + std * e - predictions) / std) ** 2, axis=1)
            gains.append(-0.5 * e @ e - logsumexp(logs) + np.log(len(logs)))
        brute, error = np.mean(gains), np.std(gains) / np.sqrt(len(gains))
        print(
            f"design {i}: nested {found.gain:.3f} ± {found.error:.3f}, brute force {brute:.3f} ± {error:.3f} "
            f"({inner} draws of the prior, {outer} sets of readings)",
            flush=True,
        )


def _predictions(planned: Planned, count: int, seed: int) -> Array:
    rng = np.random.default_rng([11, seed])
    found = planned.run(rng.standard_normal((count, len(planned.names)))).predictions
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "rank", "exact"))
    parser.add_argument("--n", type=int, help="designs; default 100, 20 or 5")
    parser.add_argument("--inner", type=int, default=100_000, help="draws of the prior behind ln p(y) (exact)")
    parser.add_argument("--outer", type=int, default=1000, help="simulated sets of readings (exact)")
    given = parser.parse_args()
    if given.what == "speed":
        speed(given.n or 100)
    elif given.what == "rank":
        rank(given.n or 20)
    else:
        exact(given.n or 5, given.inner, given.outer)


if __name__ == "__main__":
    main()
