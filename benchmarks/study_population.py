"""Repeated twin campaigns: how often the population's 95 % interval holds the true mean (slow; run by hand).

    python benchmarks/study_population.py 03 20 [first]     # gel, campaigns, number of the first

Adds a line a campaign and parameter to benchmarks/measured/population.csv, campaigns found there left out, so that a
run which was stopped continues, and prints the table of docs/agarose_study.md.
"""

from __future__ import annotations

import csv
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.config.document import read_document
from en4dvar.config.kinds import resolve_campaign, terms_and_fixed
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population import population_of
from en4dvar.executor import ThreadsExecutor
from en4dvar.priors.prior import own_seed
from en4dvar.runs.simulation import draw_campaign
from en4dvar_agarose.fits import HYPER, LEVELS
from en4dvar_agarose.run import POPULATION

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
FILE = Path(__file__).resolve().parent / "measured" / "population.csv"
GELS = {"03": "0.3 %", "10": "1 %"}
HEAD = ["gel", "seed", "parameter", "low", "median", "high", "true_mean", "mean_of_truths", "stacked_mean"]
HEAD += ["effective_hierarchy", "effective_sets", "effective"]
FIRST_SEED = 100
THREADS = int(os.environ.get("THREADS", "2"))
LEVEL, FIRST = 0.95, 20  # of the intervals; campaigns that the criterion asks for


@dataclass(frozen=True)
class Coverage:
    """The number of ``campaigns``, and those whose 95 % interval of a population mean holds the mean of the lognormal
    that the truths were drawn from (``held``; ``of_first`` among the first 20), and the mean of the truths drawn
    (``of_drawn``).
    """

    gel: str
    parameter: str
    of_first: int
    held: int
    of_drawn: int
    campaigns: int

    @property
    def error(self) -> float:
        """Binomial standard deviation of the share held if what is stated were true."""
        return float(np.sqrt(LEVEL * (1 - LEVEL) / self.campaigns))


def coverage() -> list[Coverage]:
    """Coverage of every gel and parameter."""
    covered: dict[tuple[str, str], list[tuple[bool, bool]]] = {}
    kept = csv.DictReader(FILE.read_text(encoding="utf-8").splitlines())
    for row in sorted(kept, key=lambda row: (row["gel"], int(row["seed"]))):
        low, high = float(row["low"]), float(row["high"])
        held = (low < float(row["true_mean"]) < high, low < float(row["mean_of_truths"]) < high)
        covered.setdefault((row["gel"], row["parameter"]), []).append(held)
    return [
        Coverage(
            gel, name, sum(held for held, _ in rows[:FIRST]), sum(held for held, _ in rows), sum(h for _, h in rows),
            len(rows),
        )
        for (gel, name), rows in covered.items()
    ]  # fmt: skip


def table() -> list[str]:
    """Rows of docs/agarose_study.md."""
    return [
        f"| {c.gel} | {c.parameter} | {c.of_first} | {c.held} of {c.campaigns} | "
        f"{c.held / c.campaigns:.2f} ± {c.error:.2f} | {c.of_drawn} of {c.campaigns} |"
        for c in coverage()
    ]


def campaign(key: str, seed: int) -> list[list[object]]:
    """Rows of the file for one campaign; ``true`` is the mean of the lognormal that the truths were drawn from."""
    plan = resolve_campaign(read_document(CONFIGS / "agarose_twin.yaml"), CONFIGS)
    group = plan.file.campaign.groups[f"agarose_{key}"]
    only = plan.file.campaign.model_copy(update={"groups": {f"agarose_{key}": group}})
    config = load_config(CONFIGS / f"agarose_{key}_qlkv.yaml")
    base = build(config)[0]
    sets = draw_campaign(replace(plan, file=plan.file.model_copy(update={"seed": seed, "campaign": only})))
    problems = []
    for s in sets:
        ones = np.ones(len(s.times))
        observed = Observations(s.times, s.values, noise_of(only.noise * ones), ones, name=s.name)
        problems.append(replace(base, observations=observed))
    with ThreadsExecutor(THREADS) as executor:
        seeds = [own_seed(config.seed, s.name) for s in sets]
        analyses = [assimilate(p, config.assimilation, s, executor) for p, s in zip(problems, seeds, strict=True)]
        start = [base.prior.white(base.prior.from_physical(a.posterior)) for a in analyses]
        found = population_of(problems, start, POPULATION, seed, executor=executor, hyper=HYPER)
    low, median, high = np.quantile(found.posterior.mean, LEVELS, axis=0)
    terms = {t.parameter.name: t for t in terms_and_fixed(group.parameters)[0]}
    rows: list[list[object]] = []
    for j, name in enumerate(POPULATION):
        term = terms[name]
        true, drawn = np.exp(term.mean + term.std**2 / 2), np.mean([s.truth[name] for s in sets])
        stacked = np.mean(np.concatenate([a.posterior[:, base.prior.names.index(name)] for a in analyses]))
        numbers = [low[j], median[j], high[j], true, drawn, stacked]
        judged = [*found.effective, found.size]
        rows.append([GELS[key], seed, name, *(f"{v:.6g}" for v in numbers), *(f"{v:.4g}" for v in judged)])
    return rows


def main() -> None:
    key, count = sys.argv[1], int(sys.argv[2])
    first = FIRST_SEED + (int(sys.argv[3]) if len(sys.argv) > 3 else 0)
    kept = list(csv.reader(FILE.read_text(encoding="utf-8").splitlines())) if FILE.exists() else [HEAD]
    done = {(row[0], row[1]) for row in kept[1:]}
    for seed in range(first, first + count):
        if (GELS[key], str(seed)) in done:
            continue
        start = time.perf_counter()
        rows = campaign(key, seed)
        with FILE.open("a", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerows([*([] if FILE.stat().st_size else [HEAD]), *rows])
        told = ", ".join(f"{r[2]} {float(r[3]) / float(r[6]):.2f}–{float(r[5]) / float(r[6]):.2f}" for r in rows)
        judged = f"effective {rows[0][11]} (hierarchy {rows[0][9]}, data sets {rows[0][10]})"
        print(f"{seed}: interval / truth: {told}; {judged} ({time.perf_counter() - start:.1f} s)", flush=True)
    print("\n".join(table()))


if __name__ == "__main__":
    main()
