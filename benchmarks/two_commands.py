"""From a folder of measured bubbles to the gel's number in two commands: what they cost, and what becomes of each file.

    python benchmarks/two_commands.py ../shared/data/bubbles/stiff_polyacrylamide [FOLDER …] [--minutes 60]
    python benchmarks/two_commands.py … --splits 10        and random halves of each finished run against each other
    python benchmarks/two_commands.py … --twins 8          and how far bubbles of one value would be from each other
    python benchmarks/two_commands.py … --set KEY=VALUE    the second command with another value, any number of times
    python benchmarks/two_commands.py … --medium 'polyacrylamide 8 %'    the first with another medium than the page has
    python benchmarks/two_commands.py … --since 'trough 1'    only what follows the first trough of each recording

``init --data FOLDER`` with the law and the medium of a folder of known name (``measured_page.py``), and ``run`` of what
it writes, on one worker and with its page. Printed are the processor time of each, the medians of the gel with their
90 % intervals, and the files without a number, with the reason.

Halves: the bubbles of a finished run are sampled once and split at random into halves with a population each; z of the
difference of the medians of ln θ, what is common apart, which is of one value in both. Three bubbles, which have no
such halves, are held against each other: z of the difference of two draws of the population.

Twins: the readings of a finished run are drawn anew, of a truth that is a draw of each bubble's posterior but for one
value in all of what varies; its errors are drawn, too, with what the model misses. Printed is the standard deviation of
the medians of ln θ over bubbles, measured and of each set of twins, beside what one bubble is known to, and by how much
bubbles are told to differ (5 %, median, 95 % of the std of ln θ) where as much was expected as the run says, or 0.5.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from measured_page import GROUPS
from recordings import commit
from records import Record, fill

from en4dvar.ensemble.forecast import Composite
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import FEWEST_SETS, Population, population_from, sampled_sets, terms_of
from en4dvar.estimation.population.own import OwnDraws
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.report.together import summaries
from en4dvar.results.together import POPULATION, load_population
from en4dvar.runs.finished import finished

COMMAND = [sys.executable, "-c", "from en4dvar.cli import main; main()"]
MORE = {"water": ["--start", "laser"]}  # init asks where its files suggest different starts
SHOWN = {"G": ("G, kPa", 1.0), "mu": ("μ, mPa s", 1e3)}  # display units of the parameters are kPa and Pa s


def processor_time(words: Sequence[str], log: Path) -> tuple[float, int]:
    """Of a command and its workers, s, and its exit code."""
    before = os.times()
    with log.open("w") as file:
        code = subprocess.run([*COMMAND, *words], stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    after = os.times()
    return sum(after[2:4]) - sum(before[2:4]), code


def two_commands(folder: Path, out: Path, changed: Sequence[str], medium: str, since: str = "") -> Record:
    """What both cost and say; ``out`` is made anew. ``changed``: values of the second, as KEY=VALUE. ``medium``: of the
    folder, unless it is empty. ``since``: as init takes it.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    group, config = GROUPS[folder.name], out / "gel.yaml"
    words = ["--law", group.law, "--medium", medium or group.medium, *MORE.get(folder.name, [])]
    words += ["--since", since] * bool(since)
    begun, code = processor_time(["init", "--data", str(folder), *words, "--out", str(config)], out / "init.log")
    record: Record = {"commit": commit(), "init": begun, "words": shlex.join(words)}
    if code:
        return {**record, "failed": (out / "init.log").read_text().splitlines()[-1]}
    record["run"], code = processor_time(
        ["run", str(config), *(word for value in changed for word in ("--set", value)), "--out", str(out / "run")],
        out / "run.log",
    )
    if not (out / "run" / POPULATION).is_file():
        return {**record, "failed": (out / "run.log").read_text().splitlines()[-1]}
    stored = load_population(out / "run" / POPULATION)
    of = dict(zip(stored.words, (rows for _, rows, _ in summaries(stored)), strict=False))
    for row in of[stored.headline]:
        record[row.name] = [row.q50, row.q05, row.q95]
        record[f"{row.name} trusted"] = not row.untrusted
    with (out / "run" / "summary.csv").open(encoding="utf-8") as file:
        reasons = {row["dataset"]: row["failure"] for row in csv.DictReader(file)}
    names = [file.stem for file in sorted(folder.glob("*.csv"))]
    record["left out"] = {name: reasons.get(name, "") for name in names if name not in stored.datasets}
    record["used"], record["code"] = list(stored.datasets), code
    record["warnings"] = [c.line for c in stored.cautions]
    return record


def said(record: Record, name: str) -> str:
    if name not in record:
        return "–"
    middle, low, high = (SHOWN[name][1] * x for x in record[name])
    return f"{middle:.3g} ({low:.3g} to {high:.3g}){'' if record[f'{name} trusted'] else ', not to be trusted'}"


def table(records: Sequence[Record]) -> str:
    """Markdown."""
    heads = [head for head, _ in SHOWN.values()]
    lines = [f"| folder | files used | `init`, s | `run`, s | {' | '.join(heads)} | without a number |"]
    lines.append("|---" * (5 + len(SHOWN)) + "|")
    for r in records:
        if "failed" in r:
            cells = ["–", f"{r['init']:.0f}", f"{r['run']:.0f}" if "run" in r else "–", "–", "–", r["failed"]]
        else:
            left = "; ".join(f"{name}: {why}" for name, why in r["left out"].items())
            used = f"{len(r['used'])} of {len(r['used']) + len(r['left out'])}"
            cells = [used, f"{r['init']:.0f}", f"{r['run']:.0f}", *(said(r, name) for name in SHOWN), left or "none"]
        lines.append(f"| {' | '.join([r['key'], *cells])} |")
    return "\n".join(lines)


def told(result: Population) -> Array:
    """Draws (M, p) of ν, what is common apart."""
    centred = result.theta - result.theta.mean(axis=0)
    return np.asarray(result.posterior.nu - centred @ np.linalg.lstsq(centred, result.posterior.nu, rcond=None)[0])


def halves(run_dir: Path, splits: int) -> None:
    """z of the difference of the medians of two random halves, in the transformed coordinate."""
    config, sets = finished([run_dir], True, None)
    assert config.population is not None
    names, problems, start = config.population.of, [s.problem for s in sets], [s.white for s in sets]
    hyper = config.population.part(HyperPrior)
    kept = [s.drawn for s in sets]
    drawn, left_out = sampled_sets(problems, start, config.seed, None, lambda words: print(words, flush=True), kept)
    rng, usable, z = np.random.default_rng(config.seed), sorted(drawn), []

    def of(chosen: Sequence[int]) -> Population:
        some = {s: drawn[s] for s in sorted(chosen)}
        return population_from(some, left_out, start, problems, names, config.seed, hyper, Effort())

    if len(usable) < 2 * FEWEST_SETS:
        result = of(usable)
        spread = np.sqrt(np.mean(2 * result.posterior.tau**2, axis=0))
        columns = [problems[0].prior.names.index(name) for name in names]
        each = [drawn[s].z[:, columns] for s in usable]
        for i, first in enumerate(each):
            for second in each[:i]:
                std = np.sqrt(first.var(axis=0) + second.var(axis=0) + spread**2)
                z.append((first.mean(axis=0) - second.mean(axis=0)) / std)
    else:
        for _ in range(splits):
            order = rng.permutation(usable).tolist()
            nu = [told(of(half)) for half in (order[: len(order) // 2], order[len(order) // 2 :])]
            z.append((nu[0].mean(axis=0) - nu[1].mean(axis=0)) / np.hypot(nu[0].std(axis=0), nu[1].std(axis=0)))
    inside = np.sum(np.abs(z) < 2, axis=0)
    for name, count, values in zip(names, inside, np.transpose(z), strict=True):
        print(
            f"{run_dir}: {name}: |z| < 2 in {count} of {len(z)}: {', '.join(f'{v:+.1f}' for v in values)}", flush=True
        )


def scatter(label: str, drawn: dict[int, OwnDraws], of: Sequence[InverseProblem], start: Sequence[Array],
            names: Sequence[str], seed: int, hyper: HyperPrior) -> Population:  # fmt: skip
    """Print how far the data sets are from each other; the population with the hyperprior of the run."""
    told = {h.spread: population_from(drawn, {}, start, of, names, seed, h, Effort())
            for h in (hyper, replace(hyper, spread=HyperPrior().spread))}  # fmt: skip
    for j, (name, term) in enumerate(zip(names, terms_of(of, names), strict=True)):
        own = term.std * np.array([d.z[:, of[s].prior.names.index(name)] for s, d in drawn.items()])
        spreads = []
        for expected, p in told.items():
            shares = ", ".join(
                f"{100 * q:.0f}" for q in term.std * np.quantile(p.posterior.tau[:, j], (0.05, 0.5, 0.95))
            )
            spreads.append(f"{shares} % where {100 * expected * term.std:.0f} were expected")
        print(f"{label}: {name}: medians of ln scatter by {np.median(own, axis=1).std(ddof=1):.2f}, one is known to "
              f"{own.std(axis=1).mean():.2f}; bubbles differ by {'; '.join(spreads)}", flush=True)  # fmt: skip
    return told[hyper.spread]


def twins(run_dir: Path, count: int, seed: int) -> None:
    """How far bubbles that have one value are from each other, beside the measured ones."""
    config, sets = finished([run_dir], True, None)
    assert config.population is not None
    names, hyper = config.population.of, config.population.part(HyperPrior)
    problems, start = [s.problem for s in sets], [s.white for s in sets]
    drawn, _ = sampled_sets(problems, start, config.seed, None, lambda words: None, [s.drawn for s in sets])
    nu = scatter("measured", drawn, problems, start, names, config.seed, hyper).posterior.nu
    columns = [problems[0].prior.names.index(name) for name in names]
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        one, made, begun = nu[rng.integers(len(nu))], [], []
        for s, problem in enumerate(problems):
            distances = np.sum((drawn[s].z[:, columns] - one) ** 2, axis=1)
            truths = drawn[s].z[rng.permutation(np.argsort(distances)[:20])]
            truths[:, columns] = one
            runs = Composite(problem)(problem.prior.from_white(truths))
            at = runs.predicted[next(i for i, reason in enumerate(runs.failures) if not reason)]
            values = problem.observations.noise.drawn(at, rng)
            twin = replace(problem, observations=replace(problem.observations, values=values, continued=None))
            members = assimilate(twin, replace(config.assimilation, what_if=False), seed).survivors
            made.append(twin)
            begun.append(twin.prior.white(twin.prior.from_physical(members[np.isfinite(members).all(axis=1)])))
        of_twins, _ = sampled_sets(made, begun, config.seed, None, lambda words: print(words, flush=True))
        scatter(f"twins {number}", of_twins, made, begun, names, config.seed, hyper)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--splits", type=int, default=0, help="random halves of each folder")
    parser.add_argument("--twins", type=int, default=0, help="sets of twins of each folder")
    parser.add_argument("--seed", type=int, default=1, help="of the twins")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no folder after so long")
    parser.add_argument("--out", type=Path, default=Path("runs/two_commands"), help="folder of the runs and records")
    parser.add_argument("--medium", default="", help="of the first command, for all folders")
    parser.add_argument("--since", default="", metavar="INSTANT", help="of the first command")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the second command")
    asked = parser.parse_args()
    of = {folder.name: folder.resolve() for folder in asked.folders}
    made = partial(two_commands, changed=asked.set, medium=asked.medium, since=asked.since)
    records = fill(asked.out / "records.jsonl", of, lambda key: made(of[key], asked.out / key), asked.minutes)
    print(table(list(records.values())))
    for key in (key for key, record in records.items() if "used" in record):
        if asked.splits:
            halves(asked.out / key / "run", asked.splits)
        if asked.twins:
            twins(asked.out / key / "run", asked.twins, asked.seed)


if __name__ == "__main__":
    main()
