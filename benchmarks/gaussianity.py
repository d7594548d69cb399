"""Does the result say when a posterior is not the Gaussian that its ensemble describes? (case c of the calibration)

    python benchmarks/gaussianity.py --n 20               20 experiments of each of the 25 designs below
    python benchmarks/gaussianity.py --start 100 --n 20   others, for validation
    python benchmarks/gaussianity.py --design "wide priors" --n 500   of one design
    python benchmarks/gaussianity.py --linearisation transform        the plain smoother, which is off

A run is off where the mean of a parameter lies more than 0.5 standard deviations of a long Markov chain from the
chain's, or its standard deviation differs by more than 30 %. The flag (``sample_stats.non_gaussian``) is of the same
run, without refinement. A run that is off is repeated with ``refine: auto``, the default: it is mended where it then is
off no longer, told where it warns (graver than a note), else silent. Chains are kept as records; flags are made anew.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior
from records import Record, fill

from en4dvar.data.noise import noise_of
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.ensemble.forecast import log_posterior
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.problem import InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.sampling.refine import guide
from en4dvar.schemes.settings import AssimilationSettings

OFF = (0.5, 0.3)  # mean by standard deviations of the chain, std by a fraction
TARGET = 500.0  # effective sample size of a chain: its mean to 0.045, its std to 3 %
SETTINGS = AssimilationSettings(refine="none")


def wide(widen: float, few: int | None = None, **errors: float) -> Callable[[int], InverseProblem]:
    """Experiments whose priors are ``widen`` times the wide ones, of all readings or ``few`` of them."""
    return lambda seed: thinned(make_twin(seed, prior(WIDE, widen), **errors).problem, few)


def narrow(seed: int) -> InverseProblem:
    return thinned(make_twin(seed, prior(NARROW)).problem, None)


def thinned(problem: InverseProblem, few: int | None) -> InverseProblem:
    """The same experiment with ``few`` evenly spread readings."""
    o = problem.observations
    if few is None or few >= len(o.times):
        return problem
    kept = np.linspace(0, len(o.times) - 1, few).astype(int)
    noise = noise_of(o.noise.std[kept], o.noise.time_std[kept])
    few_of_them = replace(o, times=o.times[kept], values=o.values[kept], noise=noise, weights=o.weights[kept])
    return replace(problem, observations=few_of_them)


WIDENED = {"wide priors": 1.0, "1.5 x wide": 1.5, "2 x wide": 2.0, "3 x wide": 3.0}
FEW: dict[str, int | None] = {"": None, ", 5 readings": 5}
ERRORS: dict[str, dict[str, float]] = {"": {}, ", 4.2 um": {"std": 4.2e-6}, ", 0.3 us": {"time_std": 0.3e-6}}
DESIGNS: dict[str, Callable[[int], InverseProblem]] = {"30 % priors": narrow} | {
    f"{width}{count}{kind}": wide(WIDENED[width], FEW[count], **ERRORS[kind])
    for width, count, kind in itertools.product(WIDENED, FEW, ERRORS)
}


def of_key(key: str) -> tuple[InverseProblem, int]:
    design, seed = key.rsplit("/", 1)
    return DESIGNS[design](int(seed)), int(seed)


def chain_of(key: str) -> Record:
    """Mean and standard deviation (n,) of a long chain, transformed."""
    problem, seed = of_key(key)
    analysis = assimilate(problem, SETTINGS, seed)
    x = problem.prior.from_physical(analysis.survivors)
    emulated = guide(WeightSpace(problem, SETTINGS, seed, SerialExecutor()), x, seed)
    chain = mcmc.sample(
        lambda z: log_posterior(problem, z), x, 10_000 + seed, target=TARGET, max_steps=600, emulated=emulated
    )
    return {
        "mean": chain.flat.mean(axis=0),
        "std": chain.flat.std(axis=0),
        "mcmc_steps": chain.steps,
        "mcmc_r_hat": chain.r_hat.max(),
        "mcmc_effective_sample_size": chain.effective.min(),
        "mcmc_converged": chain.converged,
        "lowest": -chain.log_density.max(),
    }


def judged(key: str, chain: Record, settings: AssimilationSettings = SETTINGS) -> Record:
    """How far the run was off, whether it says so, and what it cost to say."""
    problem, seed = of_key(key)
    began = time.process_time()
    analysis = assimilate(problem, settings, seed)
    took = time.process_time() - began
    record = {
        **distance(problem, analysis, chain),
        "seconds": took,
        "runs": analysis.forward_runs,
        "missed": analysis.iterations[-1].cost - chain.get("lowest", np.nan),
        **analysis.shape,
    }
    if is_off(record):
        default = assimilate(problem, replace(settings, refine="auto"), seed)
        told = any(c.severity != "note" for c in default.cautions)
        record |= {"mended": not is_off(distance(problem, default, chain)), "told": told}
    return record


def distance(problem: InverseProblem, analysis: Analysis, chain: Record) -> Record:
    """Of an ensemble from what the chain says: the farthest mean, the farthest ratio of standard deviations."""
    x = problem.prior.from_physical(analysis.survivors)
    mean, std = np.array(chain["mean"]), np.array(chain["std"])
    ratio = x.std(axis=0, ddof=1) / std
    return {
        "shift": float(np.max(np.abs(x.mean(axis=0) - mean) / std)),
        "ratio": float(ratio[np.argmax(np.abs(np.log(ratio)))]),
        "off_by": float(np.max(np.abs(ratio - 1))),
    }


def is_off(record: Record) -> bool:
    return bool(record["shift"] > OFF[0] or record["off_by"] > OFF[1])


def table(found: dict[str, Record]) -> None:
    """Print, design by design and for all, how many runs are off and how many of which are flagged."""
    heads = ["design", "runs", "off", "flagged of them", "false alarms", "emulated", "auto: mended", "told", "silent"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    by_design: dict[str, list[Record]] = {}
    for key, record in found.items():
        by_design.setdefault(key.rsplit("/", 1)[0], []).append(record)
    for design, records in {**by_design, "all": list(found.values())}.items():
        off = np.array([is_off(r) for r in records])
        mended = sum(r.get("mended", False) for r in records)
        told = sum(r.get("told", False) and not r["mended"] for r in records)
        flag = np.array([bool(r["non_gaussian"]) for r in records])
        emulated = sum("emulator_fit" in r for r in records)
        print(
            f"| {design} | {len(off)} | {off.sum()} | {(flag & off).sum()} | {(flag & ~off).sum()} of {(~off).sum()} | "
            f"{emulated} | {mended} | {told} | {off.sum() - mended - told} |"
        )
    seconds = {e: [r["seconds"] for r in found.values() if ("emulator_fit" in r) == e] for e in (True, False)}
    words = [f"{'with' if e else 'without'} emulator {1e3 * np.median(s):.0f} ms" for e, s in seconds.items() if s]
    print(f"processor time of a run, median: {', '.join(words)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--design", choices=tuple(DESIGNS), action="append", help="of these alone, any number")
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--n", type=int, default=20, help="number of seeds (of each design)")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no chain after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/calibration"), help="folder of the records")
    parser.add_argument("--linearisation", choices=("bundle", "transform"), default=SETTINGS.linearisation)
    parser.add_argument("--step-control", choices=("line-search", "full"), default=SETTINGS.step_control)
    parser.add_argument("--list", action="store_true", help="print every run")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.n)
    keys = [f"{design}/{seed}" for seed in seeds for design in options.design or DESIGNS]
    chains = fill(options.records / "mixed.jsonl", keys, chain_of, options.minutes)
    usable = {key: chain for key, chain in chains.items() if chain.get("mcmc_converged")}
    print(f"seeds {seeds.start} to {seeds.stop - 1}, {len(chains)} chains, {len(usable)} converged")
    steps = {"linearisation": options.linearisation, "step_control": options.step_control}
    settings = AssimilationSettings(refine="none", **steps)
    found = {key: judged(key, chain, settings) for key, chain in usable.items()}
    table({key: found[key] for key in sorted(found, key=lambda k: [*DESIGNS].index(k.rsplit("/", 1)[0]))})
    if options.list:
        for key, record in found.items():
            print(key, {name: round(float(value), 3) for name, value in record.items()})


if __name__ == "__main__":
    main()
