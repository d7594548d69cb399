"""Joint estimates of synthetic bubbles: are they calibrated, and what do they cost beside single ones?

    python benchmarks/joint.py laser         200 campaigns of 8 laser-induced bubbles, G and mu shared
    python benchmarks/joint.py acoustic      the same of driven bubbles, quadratic law: G, alpha and mu shared
    python benchmarks/joint.py amplitude     100 twins whose pulse is 10 % off, its amplitude estimated and fixed
    python benchmarks/joint.py cost          forward runs and time against single estimates
    python benchmarks/joint.py laser --minutes 4    a piece of it: records are kept and the next call goes on

Campaign ``i`` has seed ``i``: shared truths from the prior, and for every bubble its own. Ranks of what is shared and
of the first bubble's own among the 48 members, as benchmarks/worlds.py has them.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from acoustic_twin import MODEL as DRIVEN
from acoustic_twin import WIDE, make_twin, prior, read_twin
from laser_twin import MODEL, STD, TIMES, laser_prior
from records import Record, fill
from worlds import CENTRAL, Twin, World, experiment, table

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.joint import JointProblem, estimate_jointly, sharing
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import Prior, PriorTerm, own_seed
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

SHARED = {"laser": ("G", "mu"), "acoustic": ("G", "alpha", "mu")}
SETTINGS = AssimilationSettings(what_if=False)
OFF = 0.1  # of the amplitude of a pulse


def laser_campaign(seed: int, bubbles: int, tension: bool = False) -> tuple[JointProblem, Array]:
    """Bubbles of one gel and the truth (n,) of the first; they share the surface ``tension`` too where it is estimated.

    A truth that cannot be integrated is drawn again.
    """
    model, prior, shared, ones = MODEL, laser_prior(), SHARED["laser"], np.ones(len(TIMES))
    if tension:
        model = MODEL.with_parameters(["surface_tension"])
        prior = Prior((*prior.terms, PriorTerm.lognormal(model.parameters[-1], 0.06, 0.15)))
        shared = (*shared, "surface_tension")
    rng = np.random.default_rng([20261, seed])
    where = [prior.names.index(name) for name in shared]
    common = prior.mean[where] + prior.std[where] * rng.standard_normal(len(where))
    problems, truths = [], []
    while len(problems) < bubbles:
        truth = prior.mean + prior.std * rng.standard_normal(len(prior.names))
        truth[where] = common
        observed = Observations(TIMES, ones, noise_of(STD * ones, 0 * ones), ones, name=f"bubble{len(problems)}")
        problem = InverseProblem(model, model.observables[0], observed, prior)
        run = forecast(problem, truth[None])
        if run.failures[0]:
            continue
        values = run.predictions[0] + STD * rng.standard_normal(len(TIMES))
        problems.append(replace(problem, observations=replace(observed, values=values)))
        truths.append(truth)
    return sharing(problems, shared), truths[0]


def acoustic_campaign(seed: int, bubbles: int) -> tuple[JointProblem, Array]:
    """The same of driven bubbles, wide priors. All truths are drawn again where one bubble yields too few readings:

    drawing that bubble alone again would prefer gels in which few bubbles do, which the fit knows nothing of.
    """
    of, rng = prior(WIDE), np.random.default_rng([20262, seed])
    where = [of.names.index(name) for name in SHARED["acoustic"]]
    twins: list[Twin | None] = []
    while len(twins) < bubbles or None in twins:
        truths = of.mean + of.std * rng.standard_normal((bubbles, len(of.names)))
        truths[:, where] = truths[0, where]
        twins = [read_twin(1000 * seed + i, rng, of, truth) for i, truth in enumerate(truths)]
    good = [twin for twin in twins if twin is not None]
    return sharing([twin.problem for twin in good], SHARED["acoustic"]), good[0].truth


def calibration(kind: str, bubbles: int, key: str) -> Record:
    """Ranks and moments (n,) of the first bubble's quantities, what is shared among them."""
    seed = int(key)
    joint, truth = laser_campaign(seed, bubbles) if kind == "laser" else acoustic_campaign(seed, bubbles)
    try:
        found = estimate_jointly(joint, SETTINGS, seed)
    except En4dvarError as error:  # counted: no campaign may fail
        return {"failure": str(error)}
    x = joint.experiments[0].prior.from_physical(found.control(0)[:-1])
    return {
        "truth": truth,
        "mean": x.mean(axis=0),
        "std": x.std(axis=0, ddof=1),
        "rank": np.sum(x < truth, axis=0),
        "warned": [one.code for one in found.cautions],
        "effective": found.members.effective,
    }


def amplitude(key: str) -> Record:
    """One twin, its pulse 10 % stronger or weaker than stated; fitted with the amplitude estimated, and as stated."""
    seed, estimated = int(key.split("/")[0]), key.endswith("estimated")
    sign = 1 if np.random.default_rng([20263, seed]).random() < 0.5 else -1
    stated = DRIVEN.driving.amplitude
    off = replace(DRIVEN, driving=replace(DRIVEN.driving, amplitude=(1 + sign * OFF) * stated))
    twin = make_twin(seed, prior(WIDE), world=World(off))
    if estimated:
        model = DRIVEN.with_parameters(["p_A"])
        term = PriorTerm.normal({p.name: p for p in model.parameters}["p_A"], stated, abs(OFF * stated))
        of = Prior((*twin.problem.prior.terms, term))
        twin = Twin(replace(twin.problem, model=model, prior=of), np.append(twin.truth, off.driving.amplitude))
    return experiment(seed, twin, SETTINGS)


def covered(records: list[Record], names: tuple[str, ...]) -> None:
    """A row for each fit: how often the interval that holds 45 of 49 ranks has the truth."""
    print("| amplitude | " + " | ".join(f"{name}: inside 91.8 %, std of z" for name in names) + " | warn |")
    print("|---" * (len(names) + 2) + "|")
    for fit in ("estimated", "fixed"):
        of_it = [r for r in records if r["key"].endswith(fit) and "failure" not in r]
        rank, truth, mean, std = (np.array([r[k][:5] for r in of_it]) for k in ("rank", "truth", "mean", "std"))
        inside, z = 2 * np.abs(rank - 24) < CENTRAL[1], (truth - mean) / std
        cells = [f"{inside[:, j].mean():.0%}, {z[:, j].std():.2f}" for j in range(len(names))]
        print(f"| {fit} | {' | '.join(cells)} | {sum(bool(r['graver']) for r in of_it)} of {len(of_it)} |")


def cost(bubbles: int) -> None:
    """Single estimates, then the joint one that starts from scratch and makes its own; the same of half the bubbles."""
    print("| bubbles | quantities | single: runs | CPU, s | joint: runs | CPU, s | times |")
    print("|---|---|---|---|---|---|---|")
    for count in (bubbles // 2, bubbles):
        joint, _ = laser_campaign(0, count, tension=True)
        started, runs = time.process_time(), 0
        for one in joint.experiments:
            runs += assimilate(one, SETTINGS, own_seed(0, one.observations.name)).forward_runs
        single = time.process_time() - started
        started = time.process_time()
        found = estimate_jointly(joint, SETTINGS, 0)
        together = time.process_time() - started
        quantities = len(joint.shared) + sum(len(joint.columns(e)[1]) for e in range(count))
        print(
            f"| {count} | {quantities} | {runs} | {single:.1f} | {found.forward_runs} | {together:.1f} | "
            f"{together / single:.2f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("laser", "acoustic", "amplitude", "cost"))
    parser.add_argument("--n", type=int)
    parser.add_argument("--bubbles", type=int)
    parser.add_argument("--minutes", type=float, default=np.inf)
    parser.add_argument("--records", type=Path, default=Path("runs/joint"), help="folder of the records")
    asked = parser.parse_args()
    if asked.what == "cost":
        cost(asked.bubbles or 39)
        return
    n = asked.n or (100 if asked.what == "amplitude" else 200)
    file = asked.records / f"{asked.what}.jsonl"
    if asked.what == "amplitude":
        keys = [f"{seed}/{fit}" for seed in range(n) for fit in ("estimated", "fixed")]
        covered(list(fill(file, keys, amplitude, asked.minutes).values()), prior().names)
        return
    run = partial(calibration, asked.what, asked.bubbles or 8)
    records = list(fill(file, map(str, range(n)), run, asked.minutes).values())
    table(records, (laser_prior() if asked.what == "laser" else prior()).names)
    good = [record for record in records if "failure" not in record]
    print(f"effective draws: median {np.nanmedian([record['effective'] for record in good]):.0f}")
    print(f"warnings: {dict(Counter(code for record in good for code in record['warned']))}")


if __name__ == "__main__":
    main()
