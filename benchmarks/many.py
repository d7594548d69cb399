"""Joint estimates of campaigns of which one bubble is odd: is it named, and is a clean campaign left in peace?

    python benchmarks/many.py bubbles [--n 10] [--minutes 8]     12 synthetic bubbles of one gel, G and mu shared
    python benchmarks/many.py lines [--n 100]                    12 straight lines, in closed form but for the naming

Campaign ``i`` has seed ``i`` and is estimated clean and with its first bubble odd: its radii 8 % too large (``scale``),
its times 8 % too long (``clock``), a gel of four times the modulus (``gel``), another gel, as soft polyacrylamide is
beside the stiff one (``other``), or one that stiffens, with alpha 0.5 (``law``). Counted are the campaigns whose odd
bubble is named and no other, those in which another is named, and how often the 5-95 % interval of the answer holds the
truth: of the estimate without what was named, and with all.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from joint import SETTINGS, laser_campaign
from laser_twin import MODEL, STD
from records import Record, fill

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.joint import JointProblem, estimate_jointly, sharing
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar_bubble import QuadraticKelvinVoigt

OFF, STIFFER, STIFFENING = 1.08, 4.0, 0.5
KINDS = ("clean", "scale", "clock", "gel", "other", "law")
FACTORS = {"gel": {"G": STIFFER}, "other": {"G": 2.1 / 7.7, "mu": 0.118 / 0.101}}  # other: Estrada et al. 2018
LINES, ERROR, SHIFT = ("clean", "odd"), 0.1, 0.5


def spoilt(problem: InverseProblem, truth: Array, kind: str, seed: int) -> InverseProblem:
    """The bubble of a truth (n,), transformed, as it is read in a campaign of this kind."""
    observed = problem.observations
    if kind == "scale":
        return replace(problem, observations=replace(observed, values=OFF * observed.values))
    if kind == "clock":
        return replace(problem, observations=replace(observed, times=OFF * observed.times))
    other, at = problem, truth.copy()
    if kind in FACTORS:
        at += [np.log(FACTORS[kind].get(name, 1.0)) for name in problem.prior.names]
    else:
        stiffening = replace(MODEL, law=QuadraticKelvinVoigt())
        other = replace(problem, model=stiffening, fixed={"alpha": STIFFENING})
    run = forecast(other, at[None])
    rng = np.random.default_rng([20265, seed])
    values = run.predictions[0] + STD * rng.standard_normal(len(observed))
    return replace(problem, observations=replace(observed, values=values))


def bubbles(count: int, key: str) -> Record:
    """One campaign."""
    seed, kind = int(key.split("/")[0]), key.split("/")[1]
    joint, truth = laser_campaign(seed, count)
    problems = list(joint.experiments)
    if kind != "clean":
        problems[0] = spoilt(problems[0], truth, kind, seed)
    if not np.all(np.isfinite(problems[0].observations.values)):
        return {"failure": "the odd bubble cannot be run"}
    shared = tuple(name for name, _ in joint.shared)
    where = [joint.experiments[0].prior.names.index(name) for name in shared]
    return judged(sharing(problems, shared), joint.experiments[0].prior.to_physical(truth)[where], seed)


def line(values: Mapping[str, float], times: Array) -> Array:
    """a + b t."""
    return values["a"] + values["b"] * times


def lines(key: str) -> Record:
    """Twelve lines y = a + b t; a is 0.5 in all but an odd one."""
    seed, kind = int(key.split("/")[0]), key.split("/")[1]
    rng = np.random.default_rng([20266, seed])
    model = FunctionModel(line, [Parameter("a", "1"), Parameter("b", "1")], {"y": "1"})
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problems = []
    for i in range(12):
        times = np.sort(rng.uniform(0.1, 2.5, 8 + i % 4))
        a = 0.5 + SHIFT * (kind == "odd" and i == 0)
        values = a + rng.standard_normal() * times + ERROR * rng.standard_normal(len(times))
        ones = np.ones(len(times))
        data = Observations(times, values, noise_of(ERROR * ones, 0 * ones), ones, name=f"bubble{i}")
        problems.append(InverseProblem(model, model.observables[0], data, prior))
    return judged(sharing(problems, ["a"]), np.array([0.5]), seed)


def judged(joint: JointProblem, truth: Array, seed: int) -> Record:
    """Who is named, and whether the intervals hold the truth (c,), with and without the named."""
    estimate = estimate_jointly(joint, SETTINGS, seed)
    inside = [
        np.abs(np.mean(members < truth, axis=0) - 0.5) < 0.45 for members in (estimate.rest.shared, estimate.shared)
    ]
    return {
        "odd": list(estimate.odd),
        "codes": [c.code for c in estimate.cautions],
        "rest": inside[0],
        "all": inside[1],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("bubbles", "lines"))
    parser.add_argument("--n", type=int)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--records", type=Path, default=Path("runs/many"), help="folder of the records")
    asked = parser.parse_args()
    n, kinds = asked.n or (10 if asked.what == "bubbles" else 100), KINDS if asked.what == "bubbles" else LINES
    run = partial(bubbles, 12) if asked.what == "bubbles" else lines
    keys = [f"{seed}/{kind}" for seed in range(n) for kind in kinds]
    records = list(fill(asked.records / f"{asked.what}.jsonl", keys, run, asked.minutes).values())
    print("| campaign | number | the odd one named | others named | inside 90 %, without the named | with all |")
    print("|---|---|---|---|---|---|")
    for kind in kinds:
        of_it = [r for r in records if r["key"].endswith(kind) and "failure" not in r]
        named = sum("bubble0" in r["odd"] for r in of_it) if kind != "clean" else "–"
        others = sum(bool(set(r["odd"]) - ({"bubble0"} if kind != "clean" else set())) for r in of_it)
        inside = [f"{100 * np.mean([r[key] for r in of_it]):.0f} %" for key in ("rest", "all")]
        print(f"| {kind} | {len(of_it)} | {named} | {others} | {' | '.join(inside)} |")


if __name__ == "__main__":
    main()
