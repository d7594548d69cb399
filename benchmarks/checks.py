"""What the checks of files and results cost where nothing is wrong: python benchmarks/checks.py [TIMES] [WORK …]

Every check is timed within a work: the processor time that is spent in checks, as a share of that of the whole work.
Digests of results and the test of names in a run directory count as checks, and so does a process that decodes files or
matches patterns, from its start on, which is told apart. Printed is the median, with its spread.
"""

from __future__ import annotations

import functools
import os
import pkgutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil
from cheap_model import write_campaign

from en4dvar.config import load_config
from en4dvar.plumbing import decoding
from en4dvar.report.export import export_table
from en4dvar.results.provenance import cpu_model, git_commit
from en4dvar.runs.runner import run_campaign

ROOT = Path(__file__).resolve().parents[1]
SETS = 300


CHECKS = (
    "en4dvar.results.netcdf.check_seal",
    "en4dvar.results.netcdf.require_whole",
    "en4dvar.results.store.check_complete",
    "en4dvar.results.netcdf.Group.check",
    "en4dvar.results.run_results.RunResults._look_for",
    "en4dvar.results.run_results._planned",
    "en4dvar.results.pack.open_plain",
    "en4dvar.results.pack.digest",
    "en4dvar.runs.worklist.digest",
    "en4dvar.results.checkpoint.open_plain",
    "en4dvar.plumbing.files.open_plain",
    "en4dvar.plumbing.decoding.require_plain",
    "en4dvar.config.document.open_plain",
    "en4dvar.runs.rundir.inside",
    "en4dvar.runs.rundir.RunDirectory._refuse_foreign",
)


class Clock:
    """The processor time that is spent in checks, of which one may call another, in s."""

    def __init__(self) -> None:
        self.spent, self.depth = 0.0, 0

    def timed(self, check: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(check)
        def run(*args: Any, **options: Any) -> Any:
            self.depth += 1
            begin = time.process_time()
            try:
                return check(*args, **options)
            finally:
                self.depth -= 1
                self.spent += 0.0 if self.depth else time.process_time() - begin

        return run


@contextmanager
def timed() -> Iterator[Clock]:
    """Within, every check is timed."""
    clock = Clock()
    with ExitStack() as held:
        for name in CHECKS:
            held.enter_context(mock.patch(name, clock.timed(pkgutil.resolve_name(name))))
        yield clock


def one_bubble(folder: Path) -> Callable[[Path], object]:
    """The run of configs/quickstart.yaml, without its page."""
    return lambda out: run_campaign(_to(ROOT / "configs" / "quickstart.yaml", out))


def campaign(folder: Path) -> Callable[[Path], object]:
    """A campaign of a straight line, the cheapest model there is."""
    path = write_campaign(folder, SETS)
    return lambda out: run_campaign(_to(path, out))


def reading(folder: Path) -> Callable[[Path], object]:
    """The export of such a campaign."""
    campaign(folder)(folder / "read")
    return lambda out: export_table(folder / "read")


def program(folder: Path) -> Callable[[Path], object]:
    """The run of configs/external_program.yaml, whose numbers are found by a pattern: many programs of 20 ms."""
    pattern = {"unit": "m", "pattern": r"(?m)^[^t,]+,(\S+)$"}
    path = ROOT / "configs" / "external_program.yaml"
    return lambda out: run_campaign(_to(path, out, **{"model.outputs": {"x": pattern}}))


WORKS = {"one bubble": one_bubble, "campaign": campaign, "its export": reading, "a program": program}


def _to(path: Path, out: Path, **more: Any) -> Any:
    settings = {"output.directory": str(out), "output.report": False, "execution.executor": "serial", **more}
    return load_config(path, settings)


def main() -> None:
    times = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    print(f"commit {git_commit(Path(__file__))}, {times} times, {cpu_model()}", flush=True)
    print("| work | processor time | in checks | 5 to 95 % | of it another process |\n|---|---|---|---|---|")
    for name in sys.argv[2:] or WORKS:
        with tempfile.TemporaryDirectory() as folder:
            work = WORKS[name](Path(folder))
            taken = np.array([_taken(work, Path(folder) / f"out{i}") for i in range(times + 1)])[1:]  # one compiles
        checks, whole, beside = taken.T
        low, middle, high = np.quantile(100 * checks / whole, [0.05, 0.5, 0.95])
        print(f"| {name} | {np.median(whole):.3g} s | {middle:.2f} % | {low:.2f} to {high:.2f} % | "
              f"{np.median(beside):.2f} s |", flush=True)  # fmt: skip


def _taken(work: Callable[[Path], object], out: Path) -> tuple[float, float, float]:
    """Processor time in checks, of all, and of the processes that decode, which begin anew; each in s."""
    begin = _worked()
    with timed() as clock:
        work(out)
    beside = sum(sum(psutil.Process(child.process.pid).cpu_times()[:2]) for child in decoding._idle)
    decoding._end_idle()  # what has ended is counted
    return clock.spent + beside, _worked() - begin, beside


def _worked() -> float:
    """Processor time of this process and of those that it has waited for, s."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    main()
