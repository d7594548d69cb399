"""A campaign in trouble: python benchmarks/soak.py [--sets 2000] [--every 10] [--seed 1]

Two worker processes estimate SETS data sets. One file in a hundred cannot be used, one member in a hundred fails, and a
worker is killed (SIGKILL) every EVERY seconds. Then: is each good set's posterior that of a quiet run, bit for bit; is
each bad set named with its reason in summary.csv; did memory stay flat?
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import netCDF4
import numpy as np
from cheap_model import write_campaign

from en4dvar.results.pack import read_result, unpacked
from en4dvar.results.provenance import cpu_model, git_commit
from en4dvar.results.run_results import result_files

HERE = Path(__file__).resolve().parent
ALLOWED = {0, 1}  # exit codes: 1 where data sets have failed, as they must


@dataclass
class Watch:
    """Resident memory (MB) of the main process, second by second, and the workers killed."""

    memory: list[float] = field(default_factory=list)
    killed: list[int] = field(default_factory=list)
    seconds: float = 0.0

    def quarter(self, i: int) -> float:
        """Median of a quarter of the run."""
        n = len(self.memory)
        return float(np.median(self.memory[i * n // 4 : (i + 1) * n // 4]))


def start(path: Path, out: Path, *settings: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "en4dvar.cli", "run", str(path), "--out", str(out), "--no-report"]
    words += [word for setting in settings for word in ("--set", setting)]
    known = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    with (out.parent / f"{out.name}.txt").open("w") as told:
        return subprocess.Popen(words, stdout=told, stderr=told, text=True, env={**os.environ, "PYTHONPATH": known})


def resident(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return float(line.split()[1]) / 1e3
    return 0.0


def workers(pid: int) -> list[int]:
    """Processes that were spawned to work, without the one that only counts shared resources."""
    found = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        try:
            words = Path(f"/proc/{child}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in words:
            found.append(int(child))
    return found


def disturb(process: subprocess.Popen[str], every: float, draw: random.Random) -> Watch:
    """Watch a run until it ends; kill one of its workers now and then."""
    watch, begin = Watch(), time.monotonic()
    due = begin + every
    while process.poll() is None:
        time.sleep(0.5)
        try:
            watch.memory.append(resident(process.pid))
            if time.monotonic() > due and (there := workers(process.pid)):
                victim = draw.choice(there)
                os.kill(victim, signal.SIGKILL)
                watch.killed.append(victim)
                due = time.monotonic() + every
        except (OSError, ProcessLookupError):
            continue
    watch.seconds = time.monotonic() - begin
    return watch


def same_bits(a: Path, b: Path) -> bool:
    """Every number and word of every group; the path of the data and the time of the making may differ."""

    def values(file: Path) -> dict[str, bytes]:
        groups = unpacked(read_result(file)).items()
        return {
            f"{path}/{name}": np.asarray(v.values, dtype=str if v.values.dtype == object else None).tobytes()
            for path, group in groups
            for name, v in {**group.variables, **group.coords}.items()
        }

    return values(a) == values(b)


def soak(sets: int, every: float, seed: int) -> dict[str, object]:
    """Run and compare; figures by name."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = write_campaign(folder, sets, "cheap_model:Unreliable", bad=100, seed=seed)
        bad = {f"set{i:05d}" for i in range(sets) if i % 100 == 50}
        troubled = start(path, folder / "troubled", "execution.executor=processes", "execution.workers=2")
        watch = disturb(troubled, every, random.Random(seed))
        quiet = start(path, folder / "quiet", "execution.executor=serial")
        for label, process in (("troubled", troubled), ("quiet", quiet)):
            if process.wait() not in ALLOWED:
                raise SystemExit(f"the {label} run: exit {process.returncode}\n{(folder / f'{label}.txt').read_text()}")
        files = result_files(folder / "quiet")
        troubled_files = {file.name: file for file in result_files(folder / "troubled")}
        equal = sum(same_bits(file, troubled_files[file.name]) for file in files if file.name in troubled_files)
        with (folder / "troubled" / "summary.csv").open(newline="") as file:
            named = {row["dataset"]: row["failure"] for row in csv.DictReader(file) if row["failure"]}
        with netCDF4.Dataset(folder / "troubled" / "posterior.nc") as result:
            lost = 1 - float(np.mean(result["sample_stats/active"][...]))
        return {
            "sets completed": len(files),
            "of them with the bits of the quiet run": equal,
            "bad files": len(bad),
            "of them named with a reason": sum(bool(named.get(name)) for name in bad),
            "good files named as bad": len(set(named) - bad),
            "workers killed": len(watch.killed),
            "members lost in the posterior forecast": f"{100 * lost:.2f} %",
            "seconds": round(watch.seconds),
            "memory of the main process by quarter of the run, MB": [round(watch.quarter(i)) for i in range(4)],
            "held": equal == len(files) == sets - len(bad) and set(named) == bad,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=2000)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two kills")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(f"commit {git_commit(Path(__file__))}, seed {given.seed}, {cpu_model()}")
    figures = soak(given.sets, given.every, given.seed)
    for name, value in figures.items():
        print(f"{name:55} {value}")
    if not figures["held"]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
