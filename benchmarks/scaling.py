"""Scaling and cost of a campaign.

    python benchmarks/scaling.py [--docs] [profile] [workers] [campaign] [many]

Prints Markdown tables; ``--docs`` writes them between the markers of ``docs/performance.md``. ``profile``: what one
worker's time goes into in the 19 data sets of ``configs/agarose_03_qs.yaml``, without and with the emulator that
examines the shape of the posterior. ``workers``: 40 synthetic acoustic data sets (quadratic law, truths from the 30 %
priors, 1.4 µm noise, 15 points) on one and two workers that are already there. ``campaign``: such sets as `en4dvar run`
estimates them, start of the workers, files and campaign file included. ``many``: up to 20 000 data sets of a straight
line on two processes, so that the framework is what is measured, in processor time of the main process and of the
workers; then the same run resumed, of which nothing is left to do. Times are by the wall clock, medians, taken in
turns; in the profile processor time, but for the disk. Compilation is not counted. Ratios mean something on an idle
machine only.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from cheap_model import write_campaign

import en4dvar.results.store
import en4dvar.runs.worklist
import en4dvar_bubble
from en4dvar.assembly.build import data_files, inverse_plan
from en4dvar.config import Config, load_config
from en4dvar.ensemble.members import Reading
from en4dvar.estimation.summary import ParameterSummary
from en4dvar.executor import Executor, ProcessesExecutor, SerialExecutor, ThreadsExecutor, one_blas_thread
from en4dvar.executor.base import CommonValue
from en4dvar.results.pack import PACK, Pack
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.worklist import Job, estimate
from en4dvar_bubble.model import BubbleModel

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "performance.md"
STUDY = ROOT / "configs" / "agarose_03_qs.yaml"
SETS, CAMPAIGNS, MANY = 40, (40, 160), (1000, 5000, 20_000)
REPEATS = 5
MEDIAN = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
YAML = """\
name: scaling
seed: 1
data:
  path: "*.csv"
  columns:
    time: {name: t_us, unit: us}
    radius: {name: R_um, unit: um}
  error: {radius_std: 1.4 um}
model: {name: bubble, law: quadratic-kelvin-voigt, start: acoustic, gas: heat}
parameters:
  G: {prior: lognormal, median: 0.5 kPa, log_std: 0.3}
  alpha: {prior: lognormal, median: 0.03, log_std: 0.3}
  mu: {prior: lognormal, median: 0.1 Pa s, log_std: 0.3}
  R0: {prior: lognormal, median: 0.5 um, log_std: 0.3}
  t_s: {prior: normal, mean: 0 us, std: 0.3 us}
"""


def make(folder: Path, n_sets: int) -> Path:
    """Write data files and the configuration; truths are drawn from the prior."""
    draw = np.random.default_rng(7)
    truths = {name: value * np.exp(0.3 * draw.standard_normal(n_sets)) for name, value in MEDIAN.items()}
    times = np.linspace(4e-6, 32e-6, 15)
    radii = en4dvar_bubble.simulate("quadratic-kelvin-voigt", truths, times)["R"].values
    for i, radius in enumerate(radii + 1.4e-6 * draw.standard_normal(radii.shape)):
        rows = "".join(f"{1e6 * t:.6g},{1e6 * r:.6g}\n" for t, r in zip(times, radius, strict=True))
        (folder / f"set{i:03d}.csv").write_text(f"t_us,R_um\n{rows}", encoding="utf-8")
    path = folder / "scaling.yaml"
    path.write_text(YAML, encoding="utf-8")
    return path


def jobs(config: Config) -> list[Job]:
    common = CommonValue((config, {}))
    made = [Job(common, name, file) for name, file in data_files(inverse_plan(config)).items()]
    for job in made:
        _ = job.problem  # the file is read here
    return made


def seconds(action: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    start = clock()
    action()
    return clock() - start


class Stopwatch:
    """Processor seconds spent in functions, by label, while they are watched."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}

    @contextmanager
    def watching(self, label: str, *functions: tuple[Any, str]) -> Iterator[None]:
        """``functions``: the objects that hold them, and their names there."""
        before = [getattr(owner, name) for owner, name in functions]
        for (owner, name), function in zip(functions, before, strict=True):
            setattr(owner, name, self.timed(label, function))
        try:
            yield
        finally:
            for (owner, name), function in zip(functions, before, strict=True):
                setattr(owner, name, function)

    def timed(self, label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            start = time.thread_time()
            try:
                return function(*arguments)
            finally:
                self.spent[label] = self.spent.get(label, 0.0) + time.thread_time() - start

        return call


def profile() -> list[str]:
    """One worker's time by what it is spent on, without and with the examination of the posterior's shape."""
    plain, whole = (spent(load_config(STUDY, {"assimilation.emulator": emulator})) for emulator in ("off", "auto"))
    labels = (
        "reading the data file",
        "forecast: F and H of all members",
        "analysis and bookkeeping: the rest of the estimate",
        "result: summary and packing",
        "result: to disk",
    )
    return [
        f"| {label} | {a:.2f} | {100 * a / plain[1]:.0f} % | {b:.2f} | {100 * b / whole[1]:.0f} % |"
        for label, a, b in zip(labels, plain, whole, strict=True)
    ]


def spent(config: Config) -> list[float]:
    """Milliseconds a data set: reading, forecast, analysis and bookkeeping, making the result, writing it."""
    work = jobs(config)
    contents = [estimate(job).content for job in work]
    clock, rows = time.thread_time, []
    forward = (BubbleModel, "initial_states"), (SerialExecutor, "trajectories"), (Reading, "observe")
    making = (
        (en4dvar.results.store, "build_groups"),
        (en4dvar.runs.worklist, "packed"),
        (ParameterSummary, "of"),
    )
    with tempfile.TemporaryDirectory() as folder:
        pack = Pack(Path(folder, PACK))
        for _ in range(REPEATS):
            read = seconds(lambda: jobs(config), clock)
            watch = Stopwatch()
            with watch.watching("forecast", *forward), watch.watching("result", *making):
                total = seconds(lambda: [estimate(job) for job in work], clock)
            forecast, result = watch.spent["forecast"], watch.spent["result"]
            write = seconds(lambda: [pack.append("set", "", b"", content, "") for content in contents])
            rows.append((read, forecast, total - forecast - result, result, write))
    return list(1e3 * np.median(rows, axis=0) / len(work))


def workers() -> list[str]:
    """One and two workers that are already there."""
    with tempfile.TemporaryDirectory() as folder:
        work = jobs(load_config(make(Path(folder), SETS)))
    estimate(work[0])  # compile
    rows = []
    kinds: tuple[tuple[str, Callable[[int], Executor]], ...] = (
        ("threads", ThreadsExecutor),
        ("processes", ProcessesExecutor),
    )
    for label, make_executor in kinds:
        with make_executor(1) as one, make_executor(2) as two:

            def run(executor: Executor) -> float:
                return seconds(lambda: list(executor.map(estimate, ((job,) for job in work))))

            first = run(one), run(two)  # each with the start of its workers
            times = np.median([(run(one), run(two)) for _ in range(REPEATS)], axis=0)
        started = max(0.0, first[1] - times[1])
        rows.append(f"| {label} | {times[0]:.2f} | {times[1]:.2f} | {times[0] / times[1]:.2f} | {started:.1f} |")
    return rows


def campaign() -> list[str]:
    """Everything of `en4dvar run --no-report`, in a process that has run one before."""
    cases = (("serial", 1), ("threads", 2), ("processes", 2))
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for n_sets in CAMPAIGNS:
            folder = Path(name, str(n_sets))
            folder.mkdir()
            path = make(folder, n_sets)

            def go(kind: str, n_workers: int, path: Path = path, folder: Path = folder) -> float:
                out = tempfile.mkdtemp(dir=folder)
                overrides = {"output.report": False, "execution.workers": n_workers, "execution.executor": kind}
                return seconds(lambda: run_campaign(path, overrides={**overrides, "output.directory": out}))

            one, threads, processes = np.median([[go(*case) for case in cases] for _ in range(2)], axis=0)
            rows.append(f"| {n_sets} | {one:.1f} | {threads:.1f} | {processes:.1f} |")
    return rows


def many() -> list[str]:
    """The framework's own cost a data set, and what each further one adds."""
    rows, found = [], []
    for n_sets in MANY:
        with tempfile.TemporaryDirectory() as name, ProcessPoolExecutor(1, get_context("spawn")) as fresh:
            found.append(fresh.submit(of_many, write_campaign(Path(name), n_sets)).result())
        main, workers, memory, resume, size = found[-1]
        each = f"{1e3 * main / n_sets:.2f} | {1e3 * workers / n_sets:.1f}"
        rows.append(f"| {n_sets} | {each} | {memory:.0f} | {resume:.1f} | {size:.0f} |")
    rise = np.subtract(found[-1], found[0]) / (MANY[-1] - MANY[0])
    more = f"{1e3 * rise[0]:.2f} | {1e3 * rise[1]:.1f} | {1e3 * rise[2]:.1f} kB | {1e3 * rise[3]:.2f} ms"
    return [*rows, f"| each more | {more} | {1e3 * rise[4]:.0f} kB |"]


def of_many(path: Path) -> tuple[float, float, float, float, float]:
    """Processor seconds of this process and its workers, its peak of memory (MB), those of a resume, MB on disk."""

    def spent() -> tuple[float, float]:
        now = os.times()
        return now.user + now.system, now.children_user + now.children_system

    execution = {"execution.executor": "processes", "execution.workers": 2}
    overrides = {**execution, "output.directory": str(path.parent / "run")}
    begun = spent()
    run_campaign(path, overrides=overrides)
    ended = spent()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    run_campaign(path, overrides=overrides, resume=True)
    size = sum(file.stat().st_size for file in (path.parent / "run").rglob("*") if file.is_file())
    return ended[0] - begun[0], ended[1] - begun[1], memory, spent()[0] - ended[0], size / 1e6


TABLES: dict[str, tuple[str, Callable[[], list[str]]]] = {
    "profile": (
        "| one worker, 19 data sets, ms per set | `emulator: off` | of the forecast | `auto` | of the forecast |\n"
        "|---|---|---|---|---|",
        profile,
    ),
    "workers": (
        "| 40 data sets on | one worker, s | two, s | ratio | start of two workers, s |\n|---|---|---|---|---|",
        workers,
    ),
    "campaign": (
        "| data sets, `en4dvar run` | one worker, s | two threads, s | two processes, s |\n|---|---|---|---|",
        campaign,
    ),
    "many": (
        "| data sets of a straight line | main process, ms a set | workers, ms a set | memory, MB | resume, s | "
        "on disk, MB |\n|---|---|---|---|---|---|",
        many,
    ),
}


def main() -> None:
    from solver import machine, replaced

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/performance.md")
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of: {', '.join(TABLES)} (default: all)")
    options = parser.parse_args()
    if unknown := set(options.tables) - set(TABLES):
        parser.error(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    text = DOCS.read_text(encoding="utf-8") if options.docs else ""
    print(machine())
    for name in options.tables or TABLES:
        head, measure = TABLES[name]
        with one_blas_thread():
            table = "\n".join([head, *measure()])
        print(f"\n## {name}\n{table}", flush=True)
        if options.docs:
            text = replaced(text, name, f"{table}\n\n{machine()}, {time.strftime('%Y-%m-%d')}.")
    if options.docs:
        DOCS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
