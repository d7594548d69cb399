"""Is the posterior calibrated? Synthetic acoustic experiments with truths drawn from the prior, in one command.

    python benchmarks/calibration.py                       cases a, b and c, 500 experiments (hours)
    python benchmarks/calibration.py --case a --n 100      30 % priors, En4D-Var alone

Case a: 30 % priors, En4D-Var; 20 of them against a Markov chain. Case b: wide priors, ``refine: mcmc``. Case c: wide
priors without refinement: does the diagnostic flag the runs that differ from a chain? For a and b: rank histograms
of every parameter uniform (chi-squared, p > 0.01), central 50 and 90 % intervals cover within binomial error, standard
deviation of the z-scores in [0.9, 1.1].
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior
from scipy.stats import binomtest, chisquare

from en4dvar import mcmc
from en4dvar.assimilate import assimilate
from en4dvar.diagnostics import is_non_gaussian
from en4dvar.forecast import log_posterior
from en4dvar.prior import Prior
from en4dvar.problem import Analysis, AssimilationSettings, InverseProblem
from en4dvar.state import Array

BINS = 7  # of 49 ranks
OFF = (0.5, 0.3)  # mean by posterior standard deviations, std by a fraction: what case c must flag


def against_chain(problem: InverseProblem, analysis: Analysis, seed: int) -> tuple[Array, Array]:
    """(Shift of the mean in std of the chain, std relative to the chain's), each (n,)."""
    x = problem.prior.from_physical(analysis.posterior)
    chain = mcmc.sample(lambda z: log_posterior(problem, z), x, 10_000 + seed)
    std = chain.flat.std(axis=0)
    return (x.mean(axis=0) - chain.flat.mean(axis=0)) / std, x.std(axis=0, ddof=1) / std


def verdict(passed: bool) -> str:
    return "ok" if passed else "MISSED"


def calibrated(of: Prior, settings: AssimilationSettings, n: int, time_std: float, chains: int) -> None:
    """Print ranks, coverage and z-scores of ``n`` experiments; compare the first ``chains`` with a chain."""
    ranks, scores, levels, differences, failed = [], [], [], [], 0
    for seed in range(n):
        twin = make_twin(seed, of, time_std=time_std)
        try:
            analysis = assimilate(twin.problem, settings, seed)
        except Exception as error:  # counted: no run may fail
            failed += 1
            print(f"  experiment {seed} failed: {error}")
            continue
        x = of.from_physical(analysis.posterior)
        mean, std = x.mean(axis=0), x.std(axis=0, ddof=1)
        ranks.append(np.sum(x < twin.truth, axis=0))
        scores.append((twin.truth - mean) / std)
        # distance from the median in ranks: half of a central interval
        levels.append(np.abs((np.sum(x < twin.truth, axis=0) + 0.5) / (len(x) + 1) - 0.5) * 2)
        if seed < chains:
            differences.append(against_chain(twin.problem, analysis, seed))
    print(f"failed runs: {failed} of {n} {verdict(failed == 0)}")
    z, level, rank = np.array(scores), np.array(levels), np.array(ranks)
    for j, name in enumerate(of.names):
        counts = np.histogram(rank[:, j], bins=BINS, range=(-0.5, 48.5))[0]
        p, spread = chisquare(counts).pvalue, z[:, j].std(ddof=1)
        line = f"{name:6} rank p {p:.3f} {verdict(p > 0.01)}; z std {spread:.3f} {verdict(0.9 <= spread <= 1.1)}"
        for target in (0.5, 0.9):
            inside = int(np.sum(level[:, j] < target))
            fits = binomtest(inside, len(level), target).pvalue > 0.01
            line += f"; {target:.0%} covers {inside / len(level):.1%} {verdict(fits)}"
        print(line)
    if differences:
        shift, ratio = (np.abs(np.array(d)).max(axis=1) for d in ([s for s, _ in differences], _off(differences)))
        print(
            f"against a chain, {len(shift)} runs: mean off by {shift.max():.2f} std {verdict(shift.max() < 0.3)}, ",
            end="",
        )
        print(f"std off by {ratio.max():.0%} {verdict(ratio.max() < 0.15)}")


def _off(differences: list[tuple[Array, Array]]) -> list[Array]:
    return [ratio - 1 for _, ratio in differences]


def flagged(of: Prior, n: int, time_std: float) -> None:
    """Print how well the non-Gaussianity diagnostic tells runs that differ from a chain."""
    off, flags = [], []
    for seed in range(n):
        problem = make_twin(seed, of, time_std=time_std).problem
        analysis = assimilate(problem, AssimilationSettings(), seed)
        shift, ratio = against_chain(problem, analysis, seed)
        off.append(bool(np.max(np.abs(shift)) > OFF[0] or np.max(np.abs(ratio - 1)) > OFF[1]))
        flags.append(is_non_gaussian(analysis.shape))
    wrong, warned = np.array(off), np.array(flags)
    print(f"runs off: {wrong.sum()} of {n}; flagged of them: {(warned & wrong).sum()}; ", end="")
    print(f"false alarms: {(warned & ~wrong).sum()} of {(~wrong).sum()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=("a", "b", "c", "all"), default="all")
    parser.add_argument("--n", type=int, default=500, help="experiments of cases a and b; case c takes a fifth")
    parser.add_argument("--chains", type=int, default=20, help="runs of case a to compare with a chain")
    parser.add_argument("--time-std", type=float, default=0.0, help="timing error, s")
    options = parser.parse_args()
    for case in "abc" if options.case == "all" else options.case:
        began = time.perf_counter()
        print(f"case {case}")
        if case == "a":
            calibrated(prior(NARROW), AssimilationSettings(), options.n, options.time_std, options.chains)
        elif case == "b":
            calibrated(prior(WIDE), AssimilationSettings(refine="mcmc"), options.n, options.time_std, 0)
        else:
            flagged(prior(WIDE), max(1, options.n // 5), options.time_std)
        print(f"{time.perf_counter() - began:.0f} s\n", flush=True)


if __name__ == "__main__":
    main()
