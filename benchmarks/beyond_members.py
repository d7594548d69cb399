"""What do draws of the prior beyond the ensemble find that descents from its members do not?

    python benchmarks/beyond_members.py --n 40                      40 sets of each row
    python benchmarks/beyond_members.py --rows "laser, Fung" --n 9  nine of the rows whose name begins so
    python benchmarks/beyond_members.py --minutes 4                 a piece: records are kept, the next call goes on

Each set is searched without such draws and with them, also where J of the lowest minimum is plausible, where an
assimilation would do without. Rows are those of ``misspecification.py``, and a stiff gel with the priors and the gas of
``init``. A minimum counts as lower where J is by more than 0.5. The number of a set is its seed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
from laser_twin import PROPOSED, stiff_gel
from misspecification import ROWS
from records import Record, fill
from worlds import Twin

from en4dvar.descent.start import highest_plausible
from en4dvar.estimation.stages import Stages
from en4dvar.executor import SerialExecutor, one_blas_thread
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

STIFF = "stiff gel, gas of init"
SETS: dict[str, Callable[[int], Twin]] = {**ROWS, STIFF: lambda seed: stiff_gel(seed, PROPOSED)}
LOWER = 0.5  # of J


def searched(problem: InverseProblem, seed: int, drawn: bool) -> tuple[float, int, float, Stages]:
    """J of the lowest minimum, forward runs and processor seconds, with draws whatever J is, or without."""
    begin = time.process_time()
    instead = {"highest_plausible": lambda space: -np.inf} if drawn else {"Search.widened": lambda self, found: found}
    (where, way), *_ = instead.items()
    with mock.patch(f"en4dvar.descent.search.{where}", way), one_blas_thread():
        stages = Stages(problem, AssimilationSettings(), seed, SerialExecutor())
        prior_run, start = stages.descend()
        found, _ = stages.searched(start, prior_run)
    return found.minima[0].cost, stages.space.forward_runs, time.process_time() - begin, stages


def experiment(key: str) -> Record:
    """Of one set."""
    row, seed = key.rsplit("/", 1)
    problem = SETS[row](int(seed)).problem
    cost, runs, seconds, stages = searched(problem, int(seed), drawn=False)
    after, more, longer, _ = searched(problem, int(seed), drawn=True)
    plausible = cost <= highest_plausible(stages.space)
    return {"before": cost, "after": after, "plausible": plausible, "runs": more - runs, "seconds": longer - seconds}


def line(row: str, records: dict[str, Record]) -> str:
    """The row of the table."""
    cells = [str(len(records))]
    for plausible in (True, False):
        of = {key: r for key, r in records.items() if r["plausible"] == plausible}
        lower = {key.rsplit("/", 1)[1]: r for key, r in of.items() if r["after"] < r["before"] - LOWER}
        told = "; ".join(f"{seed}: {r['before']:.0f} → {r['after']:.0f}" for seed, r in lower.items())
        cells += [str(len(of)), f"{len(lower)}" + (f" ({told})" if told else "")]
    runs, seconds = (float(np.median([r[what] for r in records.values()])) for what in ("runs", "seconds"))
    return f"| {row} | {' | '.join(cells)} | {runs:.0f} | {seconds:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--start", type=int, default=0, help="first set (its seed)")
    parser.add_argument("--n", type=int, default=40, help="sets of each row")
    parser.add_argument("--rows", default="", help="beginning of the names of the rows wanted")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no set after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/beyond_members"), help="folder of the records")
    options = parser.parse_args()
    rows = [name for name in SETS if name.startswith(options.rows)]
    keys = [f"{row}/{seed}" for seed in range(options.start, options.start + options.n) for row in rows]
    found = fill(options.records / "sets.jsonl", keys, experiment, options.minutes)
    print("| row | sets | J plausible | lower with draws | not plausible | lower with draws | runs more | s |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        own = {key: found[key] for key in keys if key.rsplit("/", 1)[0] == row and "before" in found.get(key, {})}
        if own:
            print(line(row, own))


if __name__ == "__main__":
    main()
