"""How far collapses change the gas of measured bubbles: bands of the readings after the window, by ``gas_change``.

    python benchmarks/gas_change.py ../shared/data/bubbles/stiff_polyacrylamide [FOLDER …]    of known names

Each bubble is estimated once, as ``init`` proposes, and its members are run on with each value of ``gas_change``,
which does not change the estimate. Printed are, of each folder and of all, the share of the readings that lie in
their 90 % bands, and the mean interval score of these in per cent of R_max, low where they are narrow and hold the
readings: width + 20 times the distance of a reading from its band (Gneiting & Raftery 2007, J. Am. Stat. Assoc. 102,
359, eq. 43).
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from measured_page import GROUPS
from recordings import commit, to_the_next_minimum
from records import Record, fill
from what_if import problem_of

from en4dvar.diagnosis.withheld import Withheld, predict_withheld
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble.model import BubbleModel

VALUES = (0.0, 0.25, 0.5, 0.6, 0.7, 0.8, 1.0)
BEYOND = 2 / 0.1  # of the interval score of 90 % bands
PARTS = ("to the next minimum", "all after the window")


def bubble(path: Path) -> Callable[[str], Record]:
    """What is expected of the readings of a file."""

    def of(key: str) -> Record:
        group = GROUPS[path.name]
        problem = problem_of((path / f"{key}.csv").read_text(), ["--law", group.law, "--medium", group.medium])
        if problem is None or problem.observations.continued is None:
            return {"reason": "no readings after the window"}
        assert isinstance(problem.model, BubbleModel)
        within = problem.observations.values
        members = problem.prior.from_physical(assimilate(problem, AssimilationSettings(what_if=False), 1).survivors)
        found: Record = {"commit": commit()}
        for value in VALUES:
            changed = replace(problem, model=replace(problem.model, gas_change=value))
            withheld = predict_withheld(changed, members, SerialExecutor())
            if withheld is None:
                return {"reason": "too few members can be run so far"}
            count = to_the_next_minimum(within, withheld.values)
            found[str(value)] = [of_part(withheld, part, max(within)) for part in (count, None)]
        return found

    return of


def of_part(withheld: Withheld, count: int | None, largest: float) -> list[float]:
    """Number of the first ``count`` readings, how many are in their bands, and the sum of their scores over R_max."""
    low, high, y = withheld.low[:count], withheld.high[:count], withheld.values[:count]
    score = high - low + BEYOND * (np.maximum(low - y, 0.0) + np.maximum(y - high, 0.0))
    return [len(y), float(np.sum((low <= y) & (y <= high))), float(np.sum(score)) / largest]


def table(groups: dict[str, list[Record]]) -> None:
    print(f"| gas_change | {' | '.join(f'{name}, {part}' for name in groups for part in PARTS)} |")
    print("|---" * (1 + len(PARTS) * len(groups)) + "|")
    for value in VALUES:
        cells = []
        for records in groups.values():
            sums = np.sum([r[str(value)] for r in records if str(value) in r], axis=0)
            cells += [
                f"{inside / count:.0%} of {count:.0f}, {100 * score / count:.1f}" for count, inside, score in sums
            ]
        print(f"| {value:g} | {' | '.join(cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no bubble after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/gas_change"), help="folder of the records")
    o = parser.parse_args()
    warnings.simplefilter("ignore")
    groups = {}
    for folder in o.folders:
        keys = [file.stem for file in sorted(folder.glob("*.csv"))]
        groups[folder.name] = list(fill(o.records / f"{folder.name}.jsonl", keys, bubble(folder), o.minutes).values())
    table({**groups, "all": [record for records in groups.values() for record in records]})


if __name__ == "__main__":
    main()
