"""Populations of soft gels, whose moduli are as uncertain by a common error as they are large: are their medians held?

    python benchmarks/soft_gels.py [--n 200] [--seed 1] [--bubbles 6]

A pressure or a scale that is off adds as many pascals to every modulus (here 0.75 kPa for a standard deviation).
Synthetic, and exact but for what is tested: median and spread of G are drawn from the hyperprior of ``init``'s
configurations (median of the prior 2.6 kPa, log_std 2), what is common from its prior; each bubble reads G + 0.75 θ kPa
to 0.2 kPa and 5 % of G, and its posterior over (ln G, θ) on a grid is drawn from. All behind these draws is the
program's.
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import numpy as np
from scipy.stats import norm

from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.hierarchy import Hierarchy
from en4dvar.estimation.population.own import KEPT, OwnDraws, own_likelihoods

MEDIAN, LOG_STD, ADDED, ERROR = 2.6, 2.0, 0.75, (0.2, 0.05)  # kPa but for the second, and a share
HYPER = HyperPrior(1.0, 0.25, odd=0.0)
X, THETA = np.linspace(-4.5, 4.5, 541), np.linspace(-4.0, 4.0, 121)
OF_X, OF_THETA = np.meshgrid(X, THETA, indexing="ij")
READ = MEDIAN * np.exp(LOG_STD * OF_X) + ADDED * OF_THETA
PRIOR = norm.pdf(OF_X) * norm.pdf(OF_THETA)
BETWEEN = (0.0, 1.0, 3.0, np.inf)  # kPa: bounds of the levels of the table


def rank_of(bubbles: int, seed: int) -> tuple[float, float, float]:
    """Median of the gel in kPa, the share of draws below it, and the ratio of the 95 % to the 5 % quantile."""
    rng = np.random.default_rng([seed, bubbles])
    nu, tau, theta = rng.standard_normal(), HYPER.spread * abs(rng.standard_normal()), rng.standard_normal()
    modulus = MEDIAN * np.exp(LOG_STD * (nu + tau * rng.standard_normal(bubbles)))
    sets = []
    errors = np.hypot(ERROR[0], ERROR[1] * modulus)
    for reading, error in zip(modulus + ADDED * theta + errors * rng.standard_normal(bubbles), errors, strict=True):
        shares = (norm.pdf(reading, READ, error) * PRIOR).ravel()
        taken = rng.choice(OF_X.size, size=KEPT, p=shares / shares.sum())
        within = np.array([X[1] - X[0], THETA[1] - THETA[0]]) * rng.uniform(-0.5, 0.5, (KEPT, 2))
        z = np.stack([OF_X.ravel()[taken], OF_THETA.ravel()[taken]], axis=1) + within
        sets.append(OwnDraws(z, 0.0, float(KEPT), 0))
    names = [f"bubble{i}" for i in range(bubbles)]
    likelihoods = own_likelihoods(sets, [0], [1], seed, names, np.array([LOG_STD]))
    draws = Hierarchy(likelihoods, HYPER).sampled(seed, Effort()).nu[:, 0]
    low, high = np.quantile(draws, [0.05, 0.95])
    return MEDIAN * float(np.exp(LOG_STD * nu)), float(np.mean(draws < nu)), float(np.exp(LOG_STD * (high - low)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bubbles", type=int, default=6)
    asked = parser.parse_args()
    level, rank, ratio = np.array([rank_of(asked.bubbles, 1000 * asked.seed + i) for i in range(asked.n)]).T
    print("| G, kPa | gels | held by 5–95 % | below 5 % | above 95 % | held by 25–75 % | 95 % over 5 % (median) |")
    print("|---|---|---|---|---|---|---|")
    for low, high in pairwise(BETWEEN):
        of_it = (level >= low) & (level < high)
        inside = [np.mean((rank[of_it] > p) & (rank[of_it] < 1 - p)) for p in (0.05, 0.25)]
        outside = np.mean(rank[of_it] <= 0.05), np.mean(rank[of_it] >= 0.95)
        words = f"| {low:g} to {high:g} | {of_it.sum()} | {inside[0]:.0%} | {outside[0]:.0%} | {outside[1]:.0%} "
        print(f"{words}| {inside[1]:.0%} | {np.median(ratio[of_it]):.1f} |")


if __name__ == "__main__":
    main()
