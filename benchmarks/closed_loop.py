"""Does an experiment that is planned after another tell more than one that is planned beforehand?

    python benchmarks/closed_loop.py              50 campaigns, some minutes of one core
    python benchmarks/closed_loop.py --minutes 2  a piece of it: records are kept, the next call goes on

A campaign is a twin: rate k and amplitude A of y = A exp(−k t) are drawn from their priors (k lognormal about 1 with a
factor of e; A about 1, known to 5 % and common to all experiments), and experiments of three readings each with an
error of 0.03 are planned, made and estimated by the commands. The first is the one that ``design`` chooses from the
prior. The second is chosen after it (``closed``: ``design --after`` the first run), or is the first one once more
(``again``); its prior is the posterior of the first run. Beside them the six readings that are best together, chosen
from the prior (``at once``). Readings of all three have the same errors.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from records import Record, fill

import en4dvar
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.runs.design_run import run_design

CENTRE, WIDTH, KNOWN, ERROR, COUNT = 1.0, 1.0, 0.05, 0.03, 3
KINDS = ("closed", "again", "at once")


class Decay(FunctionModel):
    """y = A exp(−k t)."""

    def __init__(self) -> None:
        super().__init__(decay, [Parameter("k", "1"), Parameter("A", "1")], {"y": "1"})


def decay(p: dict[str, float], t: np.ndarray) -> np.ndarray:
    """(K,) at times (K,)."""
    return p["A"] * np.exp(-p["k"] * t)


def plan(folder: Path, name: str, count: int = COUNT, after: Path | None = None) -> dict[str, Any]:
    """A configuration of ``design`` and of ``run``."""
    file = {
        "name": name,
        "seed": 1,
        "model": {"name": "closed_loop:Decay"},
        "data": {
            "path": str(folder / f"{name}.csv"),
            "columns": {"time": {"name": "t", "unit": "1"}, "y": {"name": "y", "unit": "1"}},
            "error": {"y_std": ERROR},
        },
        "parameters": {
            "k": {"prior": "lognormal", "median": CENTRE, "log_std": WIDTH},
            "A": {"prior": "lognormal", "median": 1, "log_std": KNOWN},
        },
        "design": {
            "about": ["k"],
            "common": ["A"],
            "times": {"from": 0.05, "to": 12, "step": 0.05},
            "choose": {"readings": count},
            "method": "laplace",
        },
        "assimilation": {"what_if": False},
        "output": {"report": False, "directory": str(folder / name)},
    }
    if after is not None:
        file["prior"] = {"ensemble": str(after / "posterior.nc")}
        file["parameters"] = {"k": {"prior": "ensemble"}, "A": {"prior": "ensemble"}}
    return file


def times_of(file: dict[str, Any], after: Path | None = None) -> np.ndarray:
    """The readings that a plan chooses."""
    with tempfile.TemporaryDirectory() as folder:
        found, _ = run_design(file, after=after, out=Path(folder) / "design")
    result = found.rows[0].result
    assert result is not None
    return result.times


def measured(file: dict[str, Any], times: np.ndarray, truth: dict[str, float], errors: np.ndarray) -> Path:
    """Make the experiment and estimate; where the result lies."""
    rows = [f"{t:.9g},{y:.9g}" for t, y in zip(times, decay(truth, times) + ERROR * errors, strict=True)]
    Path(file["data"]["path"]).write_text("\n".join(["t,y", *rows]) + "\n")
    en4dvar.run(file)
    return Path(file["output"]["directory"])


def known(run: Path, truth: dict[str, float]) -> list[float]:
    """Mean, std and z of ln k."""
    values = np.log(np.asarray(en4dvar.load_result(run / "posterior.nc").posterior["k"].values).ravel())
    values = values[np.isfinite(values)]
    mean, std = float(values.mean()), float(values.std(ddof=1))
    return [mean, std, (mean - math.log(truth["k"])) / std]


def campaign(key: str) -> Record:
    """One truth, and what each way of planning comes to know of it."""
    rng = np.random.default_rng([20261125, int(key)])
    z = rng.standard_normal(2)
    truth = {"k": CENTRE * math.exp(WIDTH * z[0]), "A": math.exp(KNOWN * z[1])}
    errors = rng.standard_normal((2, COUNT))
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        first = times_of(plan(folder, "first"))
        run = measured(plan(folder, "first"), first, truth, errors[0])
        later = times_of(plan(folder, "next"), after=run)
        ways = {"closed": later, "again": first}
        found = {
            name: known(measured(plan(folder, name, after=run), times, truth, errors[1]), truth)
            for name, times in ways.items()
        }
        at_once = plan(folder, "once", 2 * COUNT)
        found["at once"] = known(measured(at_once, times_of(at_once), truth, errors.ravel()), truth)
    return {"truth": truth["k"], "first": first, "later": later, **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=50, help="campaigns")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no campaign after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/closed_loop"), help="folder of the records")
    options = parser.parse_args()
    found = fill(options.records / "decay.jsonl", map(str, range(options.n)), campaign, options.minutes)
    stds = {name: np.array([record[name][1] for record in found.values()]) for name in KINDS}
    for name in KINDS:
        mean, _, z = np.array([record[name] for record in found.values()]).T
        truth = np.log([record["truth"] for record in found.values()])
        gain = np.log(stds[name] / stds["closed"])
        wins = f"; closed narrower in {np.sum(gain > 0)} of {len(gain)}, by {gain.mean():.2f} ± {_error(gain):.2f} nats"
        print(
            f"{name}: std of ln k {np.exp(np.log(stds[name]).mean()):.3f} (geometric mean), error rms "
            f"{np.sqrt(np.mean((mean - truth) ** 2)):.3f}, z {z.mean():+.2f} ± {z.std(ddof=1):.2f}, "
            f"90 % held {np.mean(np.abs(z) < 1.645):.2f}{wins if name != 'closed' else ''}"
        )


def _error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values)))


if __name__ == "__main__":
    main()
