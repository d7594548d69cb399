"""Is the posterior calibrated? Synthetic acoustic experiments with truths drawn from the prior, in one command.

    python benchmarks/calibration.py a                 30 % priors, En4D-Var alone; 20 of them against a Markov chain
    python benchmarks/calibration.py b                 wide priors, ``refine: mcmc``
    python benchmarks/calibration.py laser             laser-induced bubbles with rebounds, default settings
    python benchmarks/calibration.py rebound           acoustic, through the rebound, wide priors, default settings
    python benchmarks/calibration.py stiff             a stiff gel, polytropic gas, priors of ``init``, default settings
    python benchmarks/calibration.py proposed          the same, gas of ``init``: heat, vapour, conducting medium
    python benchmarks/calibration.py b --minutes 4     a piece of it: records are kept and the next call goes on

Over ``--n`` experiments: ranks of every parameter uniform (as ``en4dvar calibrate`` tests them, p > 0.01), central 50
and 90 % intervals cover within binomial error (p > 0.01), standard deviation of the z-scores in [0.9, 1.1]. Intervals
are those between members that hold 25 and 45 of the 49 ranks. The records of b are also those of case c
(benchmarks/gaussianity.py).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior, through_the_collapse
from laser_twin import PROPOSED, laser_prior, make_laser_twin, stiff_gel
from records import Record, fill
from scipy.stats import binomtest
from worlds import Twin

from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis.ranks import uniform_ranks
from en4dvar.ensemble.forecast import log_posterior
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.sampling import mcmc
from en4dvar.sampling.shape import guide
from en4dvar.schemes.settings import AssimilationSettings

CENTRAL = (25, 45)  # of 49 ranks: the central intervals nearest to 50 and 90 %
CHAINS = 20  # runs of case a that are compared with a chain
CLOSE = (0.3, 0.15)  # mean by standard deviations of the chain, std by a fraction
LEVEL = 0.01  # of every test


def narrow(key: str) -> Record:
    """En4D-Var under 30 % priors and, for the first experiments, a chain."""
    settings = AssimilationSettings(refine="none")
    return experiment(int(key), make_twin(int(key), prior(NARROW)), settings, chain=int(key) < CHAINS)


def wide(key: str) -> Record:
    """Wide priors with refinement."""
    return experiment(int(key), make_twin(int(key), prior(WIDE)), AssimilationSettings(refine="mcmc"))


def laser(key: str) -> Record:
    """As a user would run it."""
    return experiment(int(key), make_laser_twin(int(key)), AssimilationSettings(what_if=False))


def experiment(seed: int, twin: Twin, settings: AssimilationSettings, chain: bool = False) -> Record:
    """Ranks, moments (n,) of the posterior ensemble in transformed space, the truth, and what a chain says."""
    of = twin.problem.prior
    try:
        analysis = assimilate(twin.problem, settings, seed)
    except En4dvarError as error:  # counted: no run may fail
        return {"failure": str(error)}
    x = of.from_physical(analysis.posterior)[:, : len(twin.truth)]  # amplitude and length of a discrepancy are last
    record = {
        "truth": twin.truth,
        "mean": x.mean(axis=0),
        "std": x.std(axis=0, ddof=1),
        "rank": np.sum(x < twin.truth, axis=0),
        "converged": analysis.converged,
        "warned": [c.code for c in analysis.cautions],
        "graver": [c.code for c in analysis.cautions if c.severity != "note"],
        "log_evidence": analysis.log_evidence,
        "runs": analysis.forward_runs,
        "what_if": {shift.name: shift.in_std for shift in analysis.what_if if shift.settled},
        **analysis.refinement,
    }
    if chain:
        emulated = guide(WeightSpace(twin.problem, settings, seed, SerialExecutor()), x, seed)
        sampled = mcmc.sample(lambda z: log_posterior(twin.problem, z), x, 10_000 + seed, emulated=emulated)
        record |= {
            "chain_mean": sampled.flat.mean(axis=0),
            "chain_std": sampled.flat.std(axis=0),
            "chain_converged": sampled.converged,
        }
    return record


def rebound(key: str) -> Record:
    """Wide priors, a window through collapse and rebound, as a user would run it."""
    return experiment(int(key), REBOUND(int(key)), AssimilationSettings(what_if=False))


def stiff(key: str) -> Record:
    """A stiff gel with the priors of ``init`` and a polytropic gas, as a user would run it."""
    return experiment(int(key), stiff_gel(int(key)), AssimilationSettings(what_if=False))


def proposed(key: str) -> Record:
    """A stiff gel with the priors and the gas of ``init``, truth and fit, as a user would run it."""
    return experiment(int(key), stiff_gel(int(key), PROPOSED), AssimilationSettings(what_if=False))


REBOUND = through_the_collapse(np.linspace(4e-6, 60e-6, 30), WIDE)
STIFF = stiff_gel(0).problem.prior
CASES = {
    "a": (narrow, prior(NARROW)),
    "b": (wide, prior(WIDE)),
    "laser": (laser, laser_prior()),
    "rebound": (rebound, prior(WIDE)),
    "stiff": (stiff, STIFF),
    "proposed": (proposed, STIFF),
}


def verdict(passed: bool) -> str:
    return "ok" if passed else "MISSED"


def table(records: list[Record], names: tuple[str, ...]) -> None:
    """Print ranks, z-scores and coverage of every parameter."""
    good = [record for record in records if "failure" not in record]
    print(f"{len(records)} experiments, failed runs: {len(records) - len(good)} {verdict(len(good) == len(records))}")
    for record in records:
        if "failure" in record:
            print(f"  experiment {record['key']}: {record['failure']}")
    truth, mean, std, rank = (np.array([r[key] for r in good]) for key in ("truth", "mean", "std", "rank"))
    z, members = (truth - mean) / std, 48
    # between two members lies a whole number of the 49 ranks: 25 of them make 51.0 %, 45 of them 91.8 %
    within = {ranks / (members + 1): 2 * np.abs(rank - members / 2) < ranks for ranks in CENTRAL}
    heads = " | ".join(f"inside {share:.1%}" for share in within)
    print(f"| parameter | p of uniform ranks | std of z | mean of z | {heads} | |")
    print("|---|---|---|---|---|---|---|")
    for j, name in enumerate(names):
        p = uniform_ranks(len(good), members).p_value(rank[:, j])
        spread = z[:, j].std(ddof=1)
        inside = [int(np.sum(each[:, j])) for each in within.values()]
        passed = p > LEVEL and 0.9 <= spread <= 1.1
        passed &= all(binomtest(i, len(z), share).pvalue > LEVEL for i, share in zip(inside, within, strict=True))
        cells = [f"{p:.3f}", f"{spread:.3f}", f"{z[:, j].mean():+.3f}", *(f"{i / len(z):.1%}" for i in inside)]
        print(f"| {name} | {' | '.join(cells)} | {verdict(passed)} |")


def against_chain(records: list[Record]) -> None:
    """Print the largest differences from the chains."""
    pairs = [r for r in records if "chain_mean" in r]
    if not pairs:
        return
    mean, std, m, s = (np.array([r[k] for r in pairs]) for k in ("mean", "std", "chain_mean", "chain_std"))
    shift = np.max(np.abs(mean - m) / s, axis=1)
    ratio = np.max(np.abs(std / s - 1), axis=1)
    print(f"against a chain, {len(pairs)} runs ({sum(r['chain_converged'] for r in pairs)} chains converged): ", end="")
    print(f"mean off by at most {shift.max():.2f} std {verdict(shift.max() < CLOSE[0])}, ", end="")
    print(f"std by at most {ratio.max():.0%} {verdict(ratio.max() < CLOSE[1])}")


def chains(records: list[Record]) -> None:
    """Print what the refinement cost and whether it converged."""
    refined = [r for r in records if "mcmc_steps" in r]
    if refined:
        steps, size = (np.array([r[k] for r in refined]) for k in ("mcmc_steps", "mcmc_effective_sample_size"))
        print(f"chains converged: {sum(bool(r['mcmc_converged']) for r in refined)} of {len(refined)}; ", end="")
        print(f"steps: median {np.median(steps):.0f}, most {steps.max()}; least effective sample size {size.min():.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=tuple(CASES))
    parser.add_argument("--start", type=int, default=0, help="first experiment (its seed)")
    parser.add_argument("--n", type=int, default=500, help="number of experiments")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no experiment after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/calibration"), help="folder of the records")
    options = parser.parse_args()
    keys = [str(seed) for seed in range(options.start, options.start + options.n)]
    run, of = CASES[options.case]
    found = list(fill(options.records / f"{options.case}.jsonl", keys, run, options.minutes).values())
    print(f"case {options.case}: seeds {options.start} to {options.start + options.n - 1}, {len(found)} done")
    table(found, of.names)
    against_chain(found)
    chains(found)


if __name__ == "__main__":
    main()
