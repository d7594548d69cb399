"""Time and memory of a run against the numbers of observations and members: python benchmarks/growth.py [--quick]

Each is a run of the command line, report and all, of a straight line as model, so that what is measured is the
framework. The slope is that of ln(seconds) against ln(number) between the two largest sizes, the start of the program
taken off: 1 is proportional, 2 would be quadratic.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from cheap_model import YAML

HERE = Path(__file__).resolve().parent
SIZES = {"observations": (10_000, 100_000, 1_000_000), "members": (10_000, 30_000, 100_000)}


def run(folder: Path, observations: int = 100, members: int = 48) -> tuple[float, float]:
    """Seconds of processor time and peak memory (MB) of one run in an empty folder."""
    (folder / "data").mkdir(parents=True)
    t = np.linspace(0.0, 3.0, observations)
    y = 1 + t + 0.1 * np.random.default_rng(1).standard_normal(observations)
    np.savetxt(folder / "data" / "line.csv", np.c_[t, y], "%.9g", ",", header="t,y", comments="")
    text = YAML.format(model="cheap_model:Line").replace("members: 12", f"members: {members}")
    (folder / "line.yaml").write_text(text.replace("report: false", "report: true"), encoding="utf-8")
    words = ["run", str(folder / "line.yaml"), "--out", str(folder / "run"), "--set", "execution.executor=serial"]
    return measured([sys.executable, "-m", "en4dvar.cli", *words])


def measured(command: list[str]) -> tuple[float, float]:
    """Seconds of processor time and peak memory (MB) of a command."""
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(HERE)})
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise AssertionError(f"exit code {child.returncode} of {' '.join(command)}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tenth of each")
    quick = parser.parse_args().quick
    with tempfile.TemporaryDirectory() as folder:
        start, _ = run(Path(folder) / "start")
        for what, sizes in SIZES.items():
            seconds = []
            for size in (n // 10 if quick else n for n in sizes):
                begin = time.perf_counter()
                used, memory = run(Path(folder) / f"{what}{size}", **{what: size})
                wall = time.perf_counter() - begin
                seconds.append(used)
                print(f"{size:8} {what:12} {used:7.1f} s ({wall:.1f} s passed), {memory:6.0f} MB", flush=True)
            grown = (seconds[-1] - start) / (seconds[-2] - start)
            print(f"{'':8} {what:12} slope {math.log(grown) / math.log(sizes[-1] / sizes[-2]):.2f}")


if __name__ == "__main__":
    main()
