"""How often does a good data set warn? Truths from the prior, errors as stated, the model that made the data.

    python benchmarks/false_alarms.py                  200 sets of each design
    python benchmarks/false_alarms.py --minutes 4      a piece of it: records are kept and the next call goes on

A set warns where any warning is graver than a note. Not all are false: a reading that the very collapse meets puts a
kink into J, and a posterior of wide priors need not be Gaussian. The number of a set is its seed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior
from laser_twin import STD, TIMES, laser_prior
from records import Record, fill

from en4dvar.assimilate import assimilate
from en4dvar.ensemble.forecast import forecast
from en4dvar.noise import noise_of
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.state import Array
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.laws import NeoHookeanKelvinVoigt
from en4dvar_bubble.solver.driver import AccuracyName, preset

SETTINGS = AssimilationSettings(what_if=False)  # whose warnings are the same
LASER = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser")


def drawn(model: BubbleModel, of: Prior, times: Array, std: float, seed: int) -> InverseProblem:
    """Readings at ``times`` of a truth from the prior; one that cannot be run is drawn again."""
    random, ones = np.random.default_rng([17, seed]), np.ones(len(times))
    observed = Observations(times, ones, noise_of(std * ones, 0 * ones), ones, name=f"good{seed:04d}")
    while True:
        truth = of.mean + of.std * random.standard_normal(len(of.names))
        run = forecast(InverseProblem(model, model.observables[0], observed, of), truth[None])
        if not run.failures[0]:
            break
    values = run.predictions[0] + std * random.standard_normal(len(times))
    return InverseProblem(model, model.observables[0], replace(observed, values=values), of)


def through_the_collapse(accuracy: AccuracyName) -> Callable[[int], InverseProblem]:
    model = BubbleModel(accuracy=preset(accuracy, "acoustic"))
    return lambda seed: drawn(model, prior(NARROW), np.linspace(4e-6, 32e-6, 15), 1.4e-6, seed)


def laser(seed: int) -> InverseProblem:
    """With rebounds, of a neo-Hookean gel."""
    terms = {term.parameter.name: term for term in laser_prior().terms}
    of = Prior(tuple(terms[name] for name in ("G", "mu", "R_max", "R_eq")))  # the order in which truths are drawn
    return drawn(LASER, of, TIMES, STD, seed)


DESIGNS: dict[str, Callable[[int], InverseProblem]] = {
    "acoustic, until 65 % of the maximum": lambda seed: make_twin(seed, prior(NARROW)).problem,
    "the same, wide priors": lambda seed: make_twin(seed, prior(WIDE)).problem,
    "acoustic, through the collapse": through_the_collapse("standard"),
    "the same, accuracy: fast": through_the_collapse("fast"),
    "laser, with rebounds": laser,
}


def warnings_of(key: str) -> Record:
    design, seed = key.rsplit("/", 1)
    analysis = assimilate(DESIGNS[design](int(seed)), SETTINGS, int(seed))
    return {"warnings": [[c.severity, c.code] for c in analysis.cautions], "runs": analysis.forward_runs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=200, help="sets of each design")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no set after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/false_alarms"), help="folder of the records")
    options = parser.parse_args()
    keys = [f"{design}/{seed}" for seed in range(options.n) for design in DESIGNS]
    found = fill(options.records / "warnings.jsonl", keys, warnings_of, options.minutes)
    print("| design | sets | warn | which | notes |\n|---|---|---|---|---|")
    for design in DESIGNS:
        records = [record for key, record in found.items() if key.rsplit("/", 1)[0] == design]
        graver = [{code for severity, code in r["warnings"] if severity != "note"} for r in records]
        notes = Counter(code for r in records for code in {c for severity, c in r["warnings"] if severity == "note"})
        which, warn = Counter(code for codes in graver for code in codes), sum(map(bool, graver))
        told = (", ".join(f"{code} {count}" for code, count in counts.most_common()) for counts in (which, notes))
        print(f"| {design} | {len(records)} | {warn} ({warn / max(1, len(records)):.1%}) | {' | '.join(told)} |")


if __name__ == "__main__":
    main()
