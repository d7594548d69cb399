"""Is a posterior that the product calls sampled the posterior?

Against a tempered population that shares none of its samplers: laser-induced bubbles with rebounds where J has two
minima that count (``laser:SEED``), and the measured bubbles in polyacrylamide where their files are there; each with
its own settings (the default ones) and, ``mcmc:``, by a chain of 6000 effective draws (``refine: mcmc, draws: 6000``).
For each parameter, transformed: how far the mean is from the population's in its standard deviations, and the ratio of
standard deviations; the largest are shown. Of modes, the weights that the product gives and their shares of the
population.

    python benchmarks/against_tempered.py [--find 60] [--data FOLDER] [--minutes 5]
    python benchmarks/against_tempered.py --sets laser:54 mcmc:laser:54 --particles 6000     this one, held against more

Both sides are draws. The error of ours is that of so many independent ones, 1/√n of the mean and 1/√(2n) of the spread
in standard deviations; that of the reference is how far one of its two populations is from both together.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from laser_twin import make_laser_twin
from records import Record, fill
from tempered import Tempered, tempered

from en4dvar.assembly.build import build
from en4dvar.config.load import load_config
from en4dvar.descent.minima import Minimum
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.ensemble.forecast import log_posterior
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.stages import Stages
from en4dvar.executor import SerialExecutor
from en4dvar.priors.prior import Prior, own_seed
from en4dvar.problem import InverseProblem
from en4dvar.sampling.modes import belonging
from en4dvar.sampling.refine import that_count
from en4dvar.schemes.settings import AssimilationSettings

CHAIN, LASER, DRAWS = "mcmc:", "laser:", 6000
ROOT = Path(__file__).resolve().parents[1]
WALK = 40
TOLERANCE = 0.05
RIGHT_SCALE = 2.76e-6 / 3.7037e-6  # of PA1_exp2: metres a pixel instead of seconds a frame (shared/data/README.md)
STIFF, SOFT = ("polyacrylamide_estrada", "PA1_exp2_RofTdata_0.mat"), ("polyacrylamide_soft", "A_E2_002.mat")
SCALED = {"data.columns.radius.unit": f"{RIGHT_SCALE:.6f}*m", "parameters.R_eq.median": "47 um"}
WIDE = {"parameters.G.log_std": 1.0, "parameters.mu.log_std": 0.7}
MEASURED = {
    "PA1_exp2, as it is": (*STIFF, {}),
    "PA1_exp2, right scale": (*STIFF, SCALED),
    "soft gel A_E2_002": (*SOFT, {}),
    "soft gel, wide priors": (*SOFT, WIDE),
}


class Case(NamedTuple):
    """The arguments of :func:`~en4dvar.estimation.assimilate.assimilate`."""

    problem: InverseProblem
    settings: AssimilationSettings
    seed: int


def reference(case: Case, particles: int) -> Record:
    """Moments (n,) of two populations together; by how much the mean of one differs from that of both, in standard
    deviations, and ln of the ratio of these; what share of both, and of either, belongs to each mode."""
    problem, seed = case.problem, case.seed
    prior = problem.prior

    def log_likelihood(x: np.ndarray) -> np.ndarray:
        return log_posterior(problem, x) + 0.5 * np.sum(((x - prior.mean) / prior.std) ** 2, axis=1)

    a, b = (tempered(log_likelihood, prior.mean, prior.std, s, particles, WALK) for s in (seed, seed + 10_000))
    both = Tempered(np.concatenate([a.draws, b.draws]), a.runs + b.runs)
    spread = float(np.max(np.abs(np.log(a.std / both.std))))
    error = [float(np.max(np.abs(a.mean - both.mean) / both.std)), spread]
    minima = minima_of(case)
    modes = [_shares(prior, minima, population.draws) for population in (both, a, b)]
    return {"mean": both.mean, "std": both.std, "error": error, "runs": both.runs, "modes": modes}


def _shares(prior: Prior, minima: Sequence[Minimum], draws: np.ndarray) -> np.ndarray:
    """(M,) of equally likely draws (D, n), that belong to each of M minima."""
    equal = np.full(len(draws), 1 / len(draws))
    return np.bincount(belonging(prior, minima, draws, equal), equal, minlength=len(minima))


def minima_of(case: Case) -> Sequence[Minimum]:
    """Those that count, which say to which mode a draw belongs."""
    stages = Stages(*case, SerialExecutor())
    prior_run, start = stages.descend()
    found, _ = stages.searched(start, prior_run)
    return that_count(found.minima, case.problem.prior)


def estimate(case: Case) -> Record:
    """What the product says (n,)."""
    analysis = assimilate(*case)
    x = case.problem.prior.from_physical(analysis.survivors)
    return {
        "mean": x.mean(axis=0),
        "std": x.std(axis=0, ddof=1),
        "runs": analysis.forward_runs,
        "draws": max(analysis.refinement.get(f"{by}_effective_sample_size", 0) for by in ("importance", "mcmc")),
        "modes": [float(mode.weight) for mode in analysis.modes],
        "how": how(analysis),
        "warned": [c.code for c in analysis.cautions if c.severity != "note"],
    }


def how(analysis: Analysis) -> str:
    """Where the members come from."""
    if "importance_draws" in analysis.refinement:
        return "importance"
    return "chain" if analysis.refinement else "Gaussian"


def case(key: str, data: Path) -> Case:
    """What is estimated, and how: a set, or ``mcmc:`` and a set."""
    name, chain = key.removeprefix(CHAIN), key.startswith(CHAIN)
    if name.startswith(LASER):
        seed, settings = int(name.removeprefix(LASER)), AssimilationSettings(what_if=False)
        found = Case(make_laser_twin(seed).problem, settings, seed)
    else:
        file, path, changes = MEASURED[name]
        config = load_config(ROOT / "configs" / f"{file}.yaml", {"data.path": str(data / path), **changes})
        (problem,) = build(config)
        found = Case(problem, config.assimilation, own_seed(config.seed, problem.observations.name))
    settings = replace(found.settings, refine="mcmc", draws=DRAWS) if chain else found.settings
    return found._replace(settings=settings)


def compared(keys: Sequence[str], given: argparse.Namespace) -> dict[str, Record]:
    """The sets, each beside its reference (``of``), as far as the minutes suffice."""
    data, end = given.data, time.monotonic() + 60 * given.minutes
    mine = fill(given.records / "estimates.jsonl", keys, lambda key: estimate(case(key, data)), given.minutes)
    names = dict.fromkeys(key.removeprefix(CHAIN) for key in mine)

    def population(name: str) -> Record:
        return reference(case(name, data), given.particles)

    theirs = fill(
        given.records / f"references_{given.particles}.jsonl", names, population, (end - time.monotonic()) / 60
    )
    known = {key: theirs[key.removeprefix(CHAIN)] for key in mine if key.removeprefix(CHAIN) in theirs}
    return {key: {**mine[key], "of": of} for key, of in known.items()}


def with_two_modes(path: Path, count: int, minutes: float) -> list[int]:
    """Those of the first laser twins where two minima count, by descents alone."""
    settings = AssimilationSettings(what_if=False, refine="none", emulator="off")

    def modes(key: str) -> Record:
        return {"modes": len(assimilate(make_laser_twin(int(key)).problem, settings, int(key)).modes)}

    found = fill(path, [str(i) for i in range(count)], modes, minutes)
    return [int(key) for key, record in found.items() if record["modes"] > 1]


def table(records: dict[str, Record]) -> None:
    heads = ["set", "by", "draws that count", "modes", "in the reference", "mean off by", "std ratio", "reference ±"]
    heads += ["runs (its)", "warns"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    within = 0
    for key, r in records.items():
        of = r["of"]
        shift = float(np.max(np.abs(np.subtract(r["mean"], of["mean"])) / of["std"]))
        ratio = float(np.max(np.abs(np.log(np.divide(r["std"], of["std"])))))
        within += max(shift, ratio) < TOLERANCE
        modes = ", ".join(f"{w:.2f}" for w in r["modes"])
        theirs = ", ".join(f"{w:.2f}" for w in of["modes"][0])
        theirs += f" ± {np.max(np.abs(np.subtract(of['modes'][1], of['modes'][0]))):.2f}"
        error = ", ".join(f"{e:.3f}" for e in of["error"])
        cells = [key, r["how"], f"{r['draws']:.0f}", modes, theirs, f"{shift:.3f}", f"{np.exp(ratio):.3f}", error]
        cells += [f"{r['runs']} ({of['runs']})", ", ".join(r["warned"])]
        print(f"| {' | '.join(cells)} |")
    print(f"\nwithin {TOLERANCE} in mean and spread: {within} of {len(records)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--find", type=int, default=60, help="laser twins among which those with two modes are found")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="the measured bubbles")
    parser.add_argument("--particles", type=int, default=2000, help="of each population")
    parser.add_argument("--minutes", type=float, default=1e9)
    parser.add_argument("--records", type=Path, default=Path("runs/against_tempered"))
    parser.add_argument("--sets", nargs="*", help="the sets, instead of those that --find says")
    given = parser.parse_args()
    if given.sets:
        table(compared(given.sets, given))
        return
    seeds = with_two_modes(given.records / "modes.jsonl", given.find, given.minutes)
    measured = [key for key, (_, file, _) in MEASURED.items() if (given.data / file).is_file()]
    for key in MEASURED.keys() - measured:
        print(f"skipped, no file: {key}")
    sets = [*measured, *(f"{LASER}{i}" for i in seeds)]
    keys = [by + name for name in sets for by in ("", CHAIN)]
    table(compared(keys, given))


if __name__ == "__main__":
    main()
