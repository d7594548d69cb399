"""How often does a good data set warn? Truths from the prior, errors as stated, the model that made the data.

    python benchmarks/false_alarms.py                  200 sets of each design
    python benchmarks/false_alarms.py --minutes 4      a piece of it: records are kept and the next call goes on
    python benchmarks/false_alarms.py --scale          of readings that are wrong by a factor, how often is the model's
                                                       doubt (``implausible-data``) told, without an estimate?

A set warns where any warning is graver than a note. Not all are false: ``model-validity`` is true where the bubble that
made the readings itself leaves what the model assumes, and ``several-modes`` where the peaks do not overlap. All others
are counted as false, though a reading that the very collapse meets does put a kink into J. The number of a set is its
seed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from acoustic_twin import NARROW, WIDE, make_twin, prior, through_the_collapse
from laser_twin import make_laser_twin
from records import Record, fill
from worlds import Twin

from en4dvar.diagnosis.honesty.examine import doubts
from en4dvar.diagnosis.response.what_if import changed_problem
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.laws import NeoHookeanKelvinVoigt

SETTINGS = AssimilationSettings(what_if=False)  # whose warnings are the same
LASER = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser")


FACTORS = (1.0, 1.34, 2.0, 0.5)
FIFTEEN = np.linspace(4e-6, 32e-6, 15)  # s
DESIGNS: dict[str, Callable[[int], Twin]] = {
    "acoustic, until 65 % of the maximum": lambda seed: make_twin(seed, prior(NARROW)),
    "the same, wide priors": lambda seed: make_twin(seed, prior(WIDE)),
    "acoustic, through the collapse": through_the_collapse(FIFTEEN, NARROW),
    "the same, accuracy: fast": through_the_collapse(FIFTEEN, NARROW, "fast"),
    "laser, with rebounds": lambda seed: make_laser_twin(seed, LASER),
}


def warnings_of(key: str) -> Record:
    design, seed = key.rsplit("/", 1)
    twin = DESIGNS[design](int(seed))
    problem = twin.problem
    analysis = assimilate(problem, SETTINGS, int(seed))
    reached = forecast(problem, twin.truth[None], None, problem.observations.times).extremes[0]
    return {
        "warnings": [[c.severity, c.code] for c in analysis.cautions],
        "runs": analysis.forward_runs,
        "beyond": any(x > limit.value for x, limit in zip(reached, problem.model.validity, strict=True)),
    }


def doubted(key: str) -> Record:
    """By which factors the readings and their errors may be wrong without a doubt of the model."""
    design, seed = key.rsplit("/", 1)
    problem = DESIGNS[design](int(seed)).problem
    members = problem.prior.sample(SETTINGS.members, int(seed), SETTINGS.sampling)
    predicted, physical = forecast(problem, members).predictions, problem.prior.to_physical(members)
    wrong = (changed_problem(problem, Alternative("scale", "", values=factor)) for factor in FACTORS)
    return {"doubted": [bool(doubts(one, physical, predicted)) for one in wrong]}


def graver(record: Record) -> set[str]:
    """Codes of the warnings that are graver than a note."""
    return {code for severity, code in record["warnings"] if severity != "note"}


def false(record: Record) -> bool:
    """Whether it warns although the bubble that was read is what the model holds for, and has one peak."""
    true = {"several-modes"} | ({"model-validity"} if record["beyond"] else set())
    return bool(graver(record) - true)


def table_of_scales(found: dict[str, Record]) -> None:
    """How many sets are doubted, by the factor of their readings."""
    print(
        f"| readings times | sets | {' | '.join(f'{factor:g}' for factor in FACTORS)} |\n{'|---' * (2 + len(FACTORS))}|"
    )
    for design in DESIGNS:
        counts = np.array([r["doubted"] for key, r in found.items() if key.rsplit("/", 1)[0] == design])
        print(f"| {design} | {len(counts)} | {' | '.join(str(count) for count in counts.sum(axis=0))} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--start", type=int, default=0, help="first set (its seed)")
    parser.add_argument("--n", type=int, default=200, help="sets of each design")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no set after so long")
    parser.add_argument("--scale", action="store_true", help="readings that are wrong by a factor")
    parser.add_argument("--records", type=Path, default=Path("runs/false_alarms"), help="folder of the records")
    options = parser.parse_args()
    keys = [f"{design}/{seed}" for seed in range(options.start, options.start + options.n) for design in DESIGNS]
    if options.scale:
        table_of_scales(fill(options.records / "scales.jsonl", keys, doubted, options.minutes))
        return
    found = fill(options.records / "warnings.jsonl", keys, warnings_of, options.minutes)
    print("| design | sets | warn | falsely | which | notes |\n|---|---|---|---|---|---|")
    for design in DESIGNS:
        records = [record for key, record in found.items() if key.rsplit("/", 1)[0] == design]
        notes = Counter(code for r in records for code in {c for severity, c in r["warnings"] if severity == "note"})
        which = Counter(code for r in records for code in graver(r))
        asked = (sum(bool(ask(r)) for r in records) for ask in (graver, false))
        warn, falsely = (f"{count} ({count / max(1, len(records)):.1%})" for count in asked)
        told = (", ".join(f"{code} {count}" for code, count in counts.most_common()) for counts in (which, notes))
        print(f"| {design} | {len(records)} | {warn} | {falsely} | {' | '.join(told)} |")


if __name__ == "__main__":
    main()
