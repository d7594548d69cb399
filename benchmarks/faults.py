"""What the faults of docs/faults.md were tried with: python benchmarks/faults.py [--quick] [--seed 1]

Inputs are derived from valid ones by coverage-guided fuzzing (``fuzz.py``, needs atheris). Runs are killed at every
operation on the file system and at random moments (forecasts, checkpoints, netCDF, report), resumed and compared bit by
bit with an undisturbed run; every command is given disks that are full or fail, and run directories that somebody else
prepared; a folder of 10 000 data sets is estimated; the soak is run. Prints inputs tried, kills survived, refusals in
words and sets completed. Half an hour; ``--quick`` does a little of each in three minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "faults"), str(ROOT / "tests"), str(ROOT / "tests" / "fuzz")]

import fuzz  # noqa: E402
from children import Children, Task  # noqa: E402
from first_starts import start_together  # noqa: E402
from fuzz_targets import TARGETS  # noqa: E402
from killing import survive  # noqa: E402
from many_sets import estimate_many  # noqa: E402
from mat_damage import survive as survive_mats  # noqa: E402
from run_files import make_campaign  # noqa: E402
from soak import soak  # noqa: E402
from test_commands import calls, prepare  # noqa: E402
from test_foreign_directory import ATTACKS, beside_own_files, call, withstood  # noqa: E402

from en4dvar.results.provenance import cpu_model, git_commit  # noqa: E402

HOUR = 3600.0  # s, nothing takes that long


def inputs(quick: bool, seed: int) -> None:
    """Inputs tried at each reader, and how many of the readers failed at one."""
    if not find_spec("atheris"):
        print("inputs tried: none, atheris is not installed")
        return
    total = findings = 0
    for target in (*TARGETS, fuzz.SHAPE):
        tried, _, _, failed = fuzz.campaign(target, 500 if quick else 15_000, seed)
        print(f"inputs tried {target:39} {tried:6}   {failed} findings", flush=True)
        total, findings = total + tried, findings + failed
    print(f"inputs tried {'in all':39} {total:6}   {findings} findings")


def mats(quick: bool, seed: int) -> None:
    """Damaged ``.mat`` files, plain and compressed, of every kind of variable."""
    with tempfile.TemporaryDirectory() as folder:
        found = survive_mats(Path(folder), 1000 if quick else 50_000, seed)
    for outcome, count in found.items():
        print(f"damaged .mat files {outcome:33} {count:6}", flush=True)


def kills(quick: bool, seed: int) -> int:
    """Kills survived; an :class:`AssertionError` says which was not."""
    share, each = (0.1, 4) if quick else (1.0, 20)
    total = 0
    for label, task in {
        "at file operations, new run": {"share": share},
        "at file operations, with --force": {"share": share, "force": True},
        "at file operations, with the report": {"share": 0.5 * share, "sets": 1, "report": True},
        "at random moments, serial": {"kills": each, "sets": 4},
        "at random moments, threads": {"kills": each, "sets": 4, "executor": "threads"},
        "at random moments, processes": {"kills": each, "sets": 4, "executor": "processes"},
    }.items():
        found = survive(HOUR, seed=seed, **task)["kills"]
        print(f"kills survived {label:37} {found:6}", flush=True)
        total += found
    return total


def disks(quick: bool, children: Children) -> None:
    """Commands that met a disk that was full or failed, and said so in words."""
    told = given = 0
    faults = [{"limit": 0}, {"fails": "fsync", "error": "EIO"}]
    if not quick:
        faults += [{"limit": n} for n in (300, 3000, 9000, 30_000, 100_000)]
        faults += [{"fails": f, "error": e} for f in ("fsync", "replace") for e in ("ENOSPC", "EDQUOT")]
    with tempfile.TemporaryDirectory() as folder:
        quiet = prepare(Path(folder), children)
        for fault in faults:
            tasks = []
            for number, name in enumerate(calls(quiet, "")):
                words, before = calls(quiet, f"{folder}/out{number}")[name]
                if name != "study" or fault == {"limit": 0}:
                    tasks.append(Task(words, before, f"{folder}/out{number}", **fault))
            for task, found in zip(tasks, children.attempt(tasks, HOUR), strict=True):
                given += 1
                if found.code:
                    assert found.code == 2, (task.words, found.told)
                    assert "Traceback" not in found.told, (task.words, found.told)
                    told += 1
    print(
        f"commands on disks that are full or fail {given:18}   {told} refused in words, the others had room", flush=True
    )


def foreign() -> None:
    """Commands that opened a run directory which somebody else had prepared, and touched nothing outside."""
    tried = 0
    with tempfile.TemporaryDirectory() as folder:
        path = make_campaign(Path(folder), 2)
        assert call("run", path, "--out", f"{folder}/run", "--no-report").exit_code == 0
        for number, attack in enumerate(ATTACKS.values()):
            place = Path(folder) / str(number)
            tried += withstood(*beside_own_files(path, Path(folder) / "run", place), attack)
    print(f"commands in {len(ATTACKS)} prepared run directories {tried:21}   nothing outside was touched", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(f"commit {git_commit(Path(__file__))}, seed {given.seed}, {cpu_model()}")
    inputs(given.quick, given.seed)
    mats(given.quick, given.seed)
    with tempfile.TemporaryDirectory() as folder:
        print(
            f"first starts at once, same bits {start_together(Path(folder), 3 if given.quick else 20):26}", flush=True
        )
    print(f"kills survived {'in all, the same bits after each':37} {kills(given.quick, given.seed):6}")
    children = Children()
    disks(given.quick, children)
    children.close()
    foreign()
    sets = 200 if given.quick else 10_000
    with tempfile.TemporaryDirectory() as folder:
        early, late, first = estimate_many(Path(folder), sets, "processes")
    print(f"sets completed of one folder {sets:29}   first after {first:.1f} s,")
    print(f"{'':60} peak memory {early:.0f} MB after a tenth, {late:.0f} MB at the end")
    for name, value in soak(200 if given.quick else 2000, 10.0, given.seed).items():
        print(f"soak: {name:55} {value}")


if __name__ == "__main__":
    main()
