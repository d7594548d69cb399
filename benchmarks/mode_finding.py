"""Does the assimilation end at the global minimum of J? Counts and forward runs of several ways to start.

    python benchmarks/mode_finding.py --set narrow --n 48      acoustic, priors of 30 %
    python benchmarks/mode_finding.py --set wide --n 400       acoustic, std 1.0 in ln G, ln alpha; 0.7 in ln mu, ln R0
    python benchmarks/mode_finding.py --set laser --n 240      laser-induced bubbles with rebounds
    python benchmarks/mode_finding.py --set wide --minutes 4   a piece of it: records are kept, the next call goes on

The reference is the lowest J among all ways, twenty starts of another, random ensemble of 120 members, and a Markov
chain of 100 steps of 48 walkers. A plain run is one descent from the member of lowest J. A run is wrong where it ends
more than 0.5 above the lowest J, silently so where it has no warning either.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior
from laser_twin import make_laser_twin
from records import Record, fill
from worlds import Twin

from en4dvar.ensemble.forecast import log_posterior
from en4dvar.estimation.assimilate import assimilate
from en4dvar.problem import InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.schemes.settings import AssimilationSettings

PLAIN = "best member (plain)"


def counted(**keys: object) -> AssimilationSettings:
    """Settings without what follows the descents."""
    return AssimilationSettings(emulator="off", refine="none", what_if=False, **keys)


WAYS = {
    "prior mean": counted(start="prior-mean"),
    PLAIN: counted(starts=1),
    "2 starts": counted(),
    "3 starts": counted(starts=3),
    "8 starts": counted(starts=8),
    "2 starts, Levenberg-Marquardt": counted(step_control="levenberg-marquardt"),
    "default": AssimilationSettings(what_if=False),
}
TOLERANCE = 0.1  # of J: closer ends are the same minimum
WRONG = 0.5  # of J
CHAIN_STEPS = 100
SETS: dict[str, Callable[[int], Twin]] = {
    "narrow": lambda seed: make_twin(seed, prior(NARROW)),
    "wide": lambda seed: make_twin(seed, prior(WIDE)),
    "laser": make_laser_twin,
}


def experiment(seed: int, twin: Callable[[int], Twin]) -> Record:
    """J at the end and forward runs of every way, and the lowest J of the two stronger searches."""
    problem = twin(seed).problem
    record: Record = {"cost": {}, "runs": {}, "converged": {}, "warned": {}}
    for way, settings in WAYS.items():
        analysis = assimilate(problem, settings, seed)
        record["cost"][way] = analysis.iterations[-1].cost
        record["runs"][way] = analysis.forward_runs
        record["converged"][way] = analysis.converged
        record["warned"][way] = [c.code for c in analysis.cautions if c.severity != "note"]
    return {**record, **reference(problem, seed)}


def reference(problem: InverseProblem, seed: int) -> Record:
    """Lowest J of twenty starts of a random ensemble, and of a Markov chain from where they end."""
    settings = counted(starts=20, members=120, sampling="random")
    end = assimilate(problem, settings, 10_000 + seed)
    x = problem.prior.from_physical(end.survivors)
    chain = mcmc.sample(lambda z: log_posterior(problem, z), x[:48], seed, max_steps=CHAIN_STEPS)
    # J of the prior itself, not of its ensemble
    centre = float(log_posterior(problem, problem.prior.from_physical(end.centre)[None])[0])
    return {"twenty starts": -centre, "chain": -float(chain.log_density.max())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", choices=tuple(SETS), default="wide")
    parser.add_argument("--start", type=int, default=0, help="first experiment (its seed)")
    parser.add_argument("--n", type=int, default=400, help="number of experiments")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no experiment after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/mode_finding"), help="folder of the records")
    options = parser.parse_args()
    keys = [str(seed) for seed in range(options.start, options.start + options.n)]
    path = options.records / f"{options.set}.jsonl"
    found = fill(path, keys, lambda key: experiment(int(key), SETS[options.set]), options.minutes)
    lowest = {k: min(r["twenty starts"], r["chain"], *r["cost"].values()) for k, r in found.items()}
    print(f"{options.set}: seeds {options.start} to {options.start + options.n - 1}, {len(found)} done")
    print("| way | at the minimum | share | wrong | silently | forward runs | of a plain run |")
    print("|---|---|---|---|---|---|---|")
    plain = np.mean([r["runs"][PLAIN] for r in found.values()])
    missed = []
    for way in WAYS:
        above = {k: r["cost"][way] - lowest[k] for k, r in found.items()}
        missed += [f"seed {k}: {way} ends {a:.2f} above J = {lowest[k]:.2f}" for k, a in above.items() if a > TOLERANCE]
        reached, runs = sum(a <= TOLERANCE for a in above.values()), np.mean([r["runs"][way] for r in found.values()])
        wrong = [k for k, a in above.items() if a > WRONG]
        silent = sum(not found[k]["warned"][way] for k in wrong)
        print(
            f"| {way} | {reached} / {len(found)} | {reached / len(found):.1%} | {len(wrong)} | {silent} | "
            f"{runs:.0f} | {runs / plain:.2f} |"
        )
    print("\n".join(missed))


if __name__ == "__main__":
    main()
