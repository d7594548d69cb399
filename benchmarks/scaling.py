"""Scaling and bookkeeping of a campaign: python benchmarks/scaling.py [SETS]

Synthetic acoustic data sets (quadratic law, truths from the 30 % priors, 1.4 µm noise, 15 points) are estimated by one
and by two workers, in threads and in processes; one worker's time is split into forecast (forward model), analysis with
bookkeeping, and writing. Times are the best of REPEATS by the wall clock, in the profile processor time (but for the
disk); start-up of the interpreter and compilation are not counted. Ratios mean something on an idle machine only.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import en4dvar_bubble
from en4dvar.build import build_one, data_files, inverse_plan
from en4dvar.config import Config, load_config
from en4dvar.executor import Executor, ProcessesExecutor, SerialExecutor, ThreadsExecutor, one_blas_thread
from en4dvar.files import write_bytes
from en4dvar.jobs import Job, estimate
from en4dvar.runner import run_campaign

REPEATS = 3
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
    return [
        Job(build_one(config, name, path), config.assimilation, config.seed, {})
        for name, path in data_files(inverse_plan(config)).items()
    ]


def best(action: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    def seconds() -> float:
        start = clock()
        action()
        return clock() - start

    return min(seconds() for _ in range(REPEATS))


class Timed(SerialExecutor):
    """Counts the seconds spent in the forward model."""

    seconds = 0.0

    def trajectories(self, *arguments):
        start = time.thread_time()
        try:
            return super().trajectories(*arguments)
        finally:
            self.seconds += time.thread_time() - start


def profile(work: list[Job], folder: Path) -> None:
    """One worker's time by what it is spent on."""
    executor = Timed()
    start = time.thread_time()
    contents = [estimate(job, executor).content for job in work]
    total = time.thread_time() - start
    forecast = executor.seconds

    from en4dvar.assimilate import assimilate
    from en4dvar.netcdf import to_bytes
    from en4dvar.store import Result

    analyses = [assimilate(job.problem, job.settings, job.seed) for job in work]
    encode = best(lambda: [to_bytes(Result.from_analysis(a, {}).tree) for a in analyses], time.thread_time)
    write = best(lambda: [write_bytes(folder / "x.nc", content) for content in contents])
    rest = total - forecast - encode
    n = len(work)
    print(f"\none worker, per data set ({n} sets)                  ms   of the forecast")
    for label, value in (
        ("forecast (forward model)", forecast),
        ("analysis and bookkeeping", rest),
        ("result: netCDF in memory", encode),
        ("result: to disk, flushed", write),
    ):
        print(f"  {label:34} {1e3 * value / n:14.2f} {100 * value / forecast:12.0f} %")
    print(
        f"  writing a result {1e3 * (encode + write) / n:.1f} ms (target < 60); analysis {100 * rest / forecast:.0f} %"
    )


def scaling(work: list[Job], make_executor: Callable[[int], Executor], label: str) -> None:
    times = {}
    for workers in (1, 2):
        with make_executor(workers) as executor:
            start = time.perf_counter()
            for _ in executor.map(estimate, ((job,) for job in work[: 2 * workers])):
                pass
            begin = time.perf_counter() - start
            times[workers] = best(lambda e=executor: list(e.map(estimate, ((job,) for job in work))))
        print(
            f"{label:10} {workers} worker(s): {times[workers]:6.2f} s for {len(work)} sets (first calls {begin:.1f} s)"
        )
    print(f"{label:10} 2 workers are {times[1] / times[2]:.2f} times one (target 1.7)")


def whole(path: Path, folder: Path) -> None:
    """Everything of `en4dvar run --no-report`: checkpoints, files, the campaign's posterior.nc."""
    times = {}
    for workers in (1, 2):
        overrides = {"output.report": False, "execution.workers": workers, "execution.executor": "threads"}

        def go(overrides: dict[str, object] = overrides) -> None:
            out = tempfile.mkdtemp(dir=folder)
            run_campaign(path, overrides={**overrides, "output.directory": out})

        times[workers] = best(go)
    ratio = times[1] / times[2]
    print(f"whole run, threads: {times[1]:.2f} s with one worker, {times[2]:.2f} s with two: {ratio:.2f} times")


def main() -> None:
    n_sets = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    with tempfile.TemporaryDirectory() as name, one_blas_thread():
        folder = Path(name)
        path = make(folder, n_sets)
        work = jobs(load_config(path))
        estimate(work[0])  # compile
        profile(work, folder)
        scaling(work, ThreadsExecutor, "threads")
        scaling(work, ProcessesExecutor, "processes")
        whole(path, folder)


if __name__ == "__main__":
    main()
