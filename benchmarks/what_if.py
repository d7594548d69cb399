"""Rows of the what-if table beside fits that are done again under their assumptions.

    python benchmarks/what_if.py --seed 401 --n 15 --measured ../shared/data/bubbles/stiff_polyacrylamide/pa_0[1-9].csv

Synthetic recordings as recordings.py makes them, and measured bubbles, each through ``init``; then every assumption of
the table is put in and J is minimised again, descents from several members of the prior, as a run does before it
samples. A shift of G or μ agrees if it has the sign of the fit's and lies within 0.3 posterior standard deviations of
it or a quarter; where both end in different minima, the one with the lower J counts, and the row is listed. Where
neither is lower than the other by half a unit of J, a descent from the row's place tells whether the row is of a
minimum, "one of two"; else it is "apart".
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from click.testing import CliRunner
from recordings import FULL, recording

from en4dvar.assembly.build import build
from en4dvar.cli import main as command_line
from en4dvar.config import load_config
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.response.what_if import changed_problem, prior_shift
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

NUMBERS = ("G", "mu")
NEAR, SHARE = 0.3, 0.25  # posterior standard deviations, and of the shift
SETTINGS = AssimilationSettings(refine="none", what_if=False)  # rows are of modes
LOWER = 0.5  # of J, by which one of two minima is the other's better


def problem_of(text: str, words: list[str]) -> InverseProblem | None:
    """What ``init`` proposes for a file; None where it refuses."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bubble.csv").write_text(text)
        asked = ["--data", str(folder / "bubble.csv"), "--time-unit", "us", "--radius-unit", "um", *words]
        made = CliRunner().invoke(command_line, ["init", *asked, "--out", str(folder / "bubble.yaml")])
        if made.exit_code:
            return None
        return build(load_config(folder / "bubble.yaml"))[0]


def compared(problem: InverseProblem, name: str) -> list[str]:
    """What became of each row: "agrees", "one of two", "apart", "elsewhere" (the fit's minimum is lower), "above" (the
    row's is), or "not told".
    """
    fit, ends = assimilate(problem, AssimilationSettings(), 1), []
    for alternative in problem.alternatives:
        (row,) = [shift for shift in fit.what_if if shift.name == alternative.name] or [None]
        if row is None:
            continue
        if not row.settled:
            ends.append("not told")
            print(f"{name} {row.name}: not told, {row.reason}")
            continue
        changed = changed_problem(problem, alternative)
        moved = prior_shift(problem, tuple(alternative.parameters.items()))
        terms = tuple(replace(t, mean=t.mean + by) for t, by in zip(changed.prior.terms, moved, strict=True))
        changed, beside = replace(changed, prior=Prior(terms)), partial(_beside, problem, fit)
        again = assimilate(changed, SETTINGS, 1)
        end = beside(again, row.in_std, row.cost_change, words := f"{name} {row.name}")
        if end == "apart":
            start = dict(zip(problem.prior.names, fit.centre + row.change, strict=True))
            there = assimilate(changed, AssimilationSettings(refine="none", what_if=False, start=start), 1)
            end = "one of two" if beside(there, row.in_std, row.cost_change, f"{words} from there") == "agrees" else end
        ends.append(end)
    return ends


def _beside(
    problem: InverseProblem, fit: Analysis, again: Analysis, in_std: np.ndarray, gained: float, words: str
) -> str:
    transform, names = problem.prior.from_physical, problem.prior.names
    std = transform(fit.survivors).std(axis=0, ddof=1)
    shift = (transform(again.centre) - transform(fit.centre)) / std
    at = [names.index(number) for number in NUMBERS if number in names]
    off = np.abs(in_std - shift)[at]
    signed = np.all((np.sign(in_std) == np.sign(shift))[at] | (np.abs(shift[at]) < NEAR))
    if signed and np.all((off <= NEAR) | (off <= SHARE * np.abs(shift[at]))):
        return "agrees"
    lower = gained - (again.iterations[-1].cost - fit.iterations[-1].cost)
    end = "elsewhere" if lower > LOWER else "above" if lower < -LOWER else "apart"
    both = f"row {np.round(in_std[at], 2)}, fit {np.round(shift[at], 2)} std"
    print(f"{words}: {end}; {both}, J {lower:+.2f} below the row's")
    return end


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=401)
    parser.add_argument("--n", type=int, default=15)
    parser.add_argument("--measured", type=Path, nargs="*", default=[])
    parser.add_argument("--medium", default="polyacrylamide", help="of the measured bubbles")
    o = parser.parse_args()
    warnings.simplefilter("ignore")
    texts = {str(key): recording(key, FULL)[::2] for key in range(1000 * o.seed, 1000 * o.seed + o.n)}
    sets = {key: (text, ["--law", law]) for key, (law, text) in texts.items()}
    sets |= {path.stem: (path.read_text(), ["--medium", o.medium]) for path in o.measured}
    counts: Counter[str] = Counter()
    for name, (text, words) in sets.items():
        problem = problem_of(text, words)
        counts.update(compared(problem, name) if problem else ["set refused by init"])
        print(f"{name}: so far {dict(counts)}", flush=True)


if __name__ == "__main__":
    main()
