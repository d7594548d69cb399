"""What a user waits for: `en4dvar run` with and without its page, as ratios within one run of this program.

    python benchmarks/user_time.py [--docs] [--repeats 3] [--sets 200 800]

Rows: the quick start, the 19 bubbles of ``configs/agarose_03_qs.yaml`` on two workers, and synthetic campaigns of
``--sets`` data sets (those of ``scaling.py``), whose slope between the first and the last is what one data set costs;
of these also the resume of a finished run. Processor time of the command and its workers, medians of runs taken in
turns, after one that compiles; seconds by the wall clock mean something on an idle machine only. ``--docs`` writes the
table into ``docs/performance.md``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scaling import DOCS, ROOT, make
from solver import machine, replaced

QUICK, STUDY = ROOT / "configs" / "quickstart.yaml", ROOT / "configs" / "agarose_03_qs.yaml"
HEAD = """\
| processor time, s (by the clock) | without page | with | ratio | resume of the finished run |
|---|---|---|---|---|"""
COMMAND = [sys.executable, "-c", "from en4dvar.cli import main; main()", "run"]


def cost(config: Path, folder: Path, *words: str) -> tuple[float, float]:
    """Processor seconds and seconds of one command."""
    before, start = os.times(), time.perf_counter()
    command = [*COMMAND, str(config), "--out", str(folder), *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return spent, time.perf_counter() - start


def row(label: str, config: Path, repeats: int, scratch: Path) -> tuple[str, float]:
    """A line of the table, and the processor seconds without a page."""
    cost(config, scratch / "first", "--no-report", "--force")
    runs = [
        (*cost(config, scratch / "without", "--no-report", "--force"), *cost(config, scratch / "with", "--force"))
        for _ in range(repeats)
    ]
    without, wall, with_page, wall_page = np.median(runs, axis=0)
    resumed = cost(config, scratch / "without", "--no-report", "--resume")[0]
    times = (
        f"{without:.1f} ({wall:.1f}) | {with_page:.1f} ({wall_page:.1f}) | {with_page / without:.2f} | {resumed:.1f}"
    )
    return f"| {label} | {times} |", float(without)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--sets", type=int, nargs="*", default=[200, 800], help="sizes of the synthetic campaigns")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/performance.md")
    options = parser.parse_args()
    print(f"{machine()}\n\n{HEAD}")
    lines, spent = [HEAD], []
    with tempfile.TemporaryDirectory() as name:
        for label, config in (("quick start", QUICK), ("19 bubbles", STUDY)):
            lines.append(row(label, config, options.repeats, Path(name, label.split()[0]))[0])
            print(lines[-1], flush=True)
        for count in options.sets:
            folder = Path(name, str(count))
            folder.mkdir()
            line, seconds = row(f"{count} synthetic", make(folder, count), 1, folder / "runs")
            spent.append((count, seconds))
            lines.append(line)
            print(line, flush=True)
    if len(spent) > 1:
        (few, first), (many, last) = spent[0], spent[-1]
        slope = 1e3 * (last - first) / (many - few)
        lines.append(f"\nSlope without page: {slope:.1f} ms of processor time a data set.")
        print(lines[-1])
    if options.docs:
        table = "\n".join([*lines, f"\n{machine()}, {time.strftime('%Y-%m-%d')}."])
        DOCS.write_text(replaced(DOCS.read_text(encoding="utf-8"), "user time", table), encoding="utf-8")


if __name__ == "__main__":
    main()
