"""The siege of docs/faults.md again, by random seeds: python benchmarks/siege.py [--seconds 300] [--seed 1] [KIND ...]

Every attack is a command in a process of its own, given files that were damaged (also such as are sealed again, so that
no checksum tells), or stopped at a random moment. It holds where the command ends within its time with an exit code of
ours and words, without a traceback; where no data set that a run has kept vanishes without a word; where a stop is
heeded within two seconds (of a machine that does nothing else: a loop beside tells how busy it is), nothing that the
command has started is left, and --resume ends in the same bits. Whatever does not hold is printed with the place it
comes from, and its files are kept below ``runs/siege``.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("tests/faults", "tests", "tests/fuzz", "tests/model", "", "models")
ATTACKED = [str(ROOT / name) for name in FOLDERS]  # where commands find modules: in this tree, before what is installed
sys.path[:0] = ATTACKED

import damage  # noqa: E402
import fuzz_seeds  # noqa: E402
from children import Children, Outcome, Task  # noqa: E402
from drift_series import write as write_series  # noqa: E402
from run_files import assert_same_results, make_campaign  # noqa: E402
from siege_commands import Command, commands  # noqa: E402
from siege_files import movies, pest_case, small_study  # noqa: E402
from test_commands import CAMPAIGN, TWIN  # noqa: E402

from en4dvar.plumbing.errors import OutputError  # noqa: E402
from en4dvar.results.pack import PACK  # noqa: E402
from en4dvar.results.provenance import cpu_model, git_commit  # noqa: E402

FOUND = ROOT / "runs" / "siege"
LONGEST = 600  # s for a command of which an undisturbed one takes a second, on a machine that is never quiet
HEEDED = 2.0  # s of a machine that does nothing else; times the slowness of Outcome
OURS = (0, 1, 2, 3, 130)


@dataclass
class Attack:
    """A command, and what else must hold: the reason why it does not, or ""."""

    task: Task
    holds: Callable[[Outcome], str] = lambda _: ""


@dataclass
class Siege:
    """What all attacks begin from: results and configurations in ``base``."""

    base: Path
    children: Children = field(default_factory=Children)
    made: dict[str, list[str]] = field(default_factory=dict)
    heeded: list[tuple[float, float]] = field(default_factory=list)  # s after which a stop was, and the slowness then

    def prepare(self) -> None:
        make_campaign(self.base, 3)
        (self.base / "series").mkdir()
        write_series(self.base / "series")
        pest_case(self.base / "pest")
        movies(self.base / "movies")
        small_study(self.base / "study", ROOT / "configs")
        (self.base / "twin.yaml").write_text(TWIN)
        (self.base / "synthetic.yaml").write_text(CAMPAIGN)
        toy, one = str(self.base / "toy.yaml"), str(self.base / "data" / "set0.csv")
        self.made = {
            "campaign": ["run", toy, "--no-report"],
            "other": ["run", toy, "--no-report", "--set", "seed=4"],
            "single": ["run", toy, "--data", one, "--no-report"],
            "twin": ["run", str(self.base / "twin.yaml"), "--no-report"],
            "series-run": ["run", str(next((self.base / "series").glob("*.yaml"))), "--no-report"],
            "plan": ["design", str(ROOT / "configs" / "linear_design.yaml")],
            "calibration": ["calibrate", toy, "--sets", "4"],
            "rings": ["sweep-twin", str(self.base / "twin.yaml"), "--vary", "assimilation.members=[14, 15]"],
            "joint": ["joint", str(self.base / "campaign"), "--share", "k"],
            "population": ["population", str(self.base / "campaign"), "--of", "k"],
        }
        for name, words in self.made.items():
            (done,) = self.children.attempt([Task([*words, "--out", str(self.base / name)], seconds=LONGEST)])
            assert done.code == 0, (words, done.told)

    def undisturbed(self, command: Command) -> Path:
        """Where the results are of a command that nothing has stopped."""
        out = self.base / "whole" / str(zlib.crc32(" ".join(command.words).encode()))
        if not out.exists():
            (done,) = self.children.attempt([Task(command.into(out), seconds=LONGEST)])
            assert done.code == 0, (command, done.told)
        return out

    def copy(self, name: str, to: Path) -> Path:
        shutil.copytree(self.base / name, to)
        return to


READERS = ("export", "export --members", "export --latex", "report", "rerun", "compare --stored", "joint", "population")


def _reading(siege: Siege, run: Path, rng: np.random.Generator) -> list[str]:
    """A command that reads a run directory."""
    if run.name in ("plan", "joint", "population"):
        return ["report", str(run)]
    name, *options = READERS[rng.integers(len(READERS) - 2 * (run.name in ("twin", "series-run")))].split()
    more = [str(siege.base / ("series-run" if run.name == "series-run" else "other"))] if name == "compare" else []
    more += ["--share", "k"] if name == "joint" else ["--of", "k"] if name == "population" else []
    out = ["--out", str(run.parent / "out")] if name in ("export", "compare", "joint", "population") else []
    return [name, str(run), *options, *more, *out]


def results(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """A netCDF file with a good seal and anything in it."""
    name = ("single", "single", "twin", "series-run", "plan", "joint", "population")[rng.integers(7)]
    run = siege.copy(name, folder / name)
    files = sorted(run.glob("*.nc"))
    damage.resealed_result(files[rng.integers(len(files))], rng)
    return Attack(Task(_reading(siege, run, rng)))


def kept(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """One damage to what a finished campaign keeps: every data set is there, or missed by name."""
    run = siege.copy("campaign", folder / "campaign")
    files = [p for p in sorted(run.rglob("*")) if p.is_file() and p.suffix not in (".html", ".csv", ".log")]
    path = files[rng.integers(len(files))]
    path.write_bytes(damage.of_bytes(path.read_bytes(), rng))
    words = _reading(siege, run, rng)

    def holds(found: Outcome) -> str:
        if words[0] != "export" or words[2] == "--latex" or not (folder / "out").exists():
            return ""
        with (folder / "out").open(newline="") as file:
            lost = {f"set{i}" for i in range(3)} - {row["dataset"] for row in csv.DictReader(file)}
        if all(f"{name} (" in found.told for name in lost) and bool(lost) == bool(found.code):
            return ""
        return f"{sorted(lost)} vanished without a word, exit code {found.code}"

    return Attack(Task(words), holds)


def resumed(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """One damage to what a finished run of any kind keeps, and ``--resume``: it mends, to the same bits, or refuses."""
    names = ("campaign", "campaign", "campaign", "single", "twin", "series-run", "plan", "calibration", "rings")
    name = names[rng.integers(len(names))]
    run = siege.copy(name, folder / name)
    # the log is only added to; a page is written anew by report
    files = [p for p in sorted(run.rglob("*")) if p.is_file() and p.suffix not in (".log", ".html")]
    path = files[rng.integers(len(files))]
    path.write_bytes(damage.of_bytes(path.read_bytes(), rng))
    task = Task([*siege.made[name], "--out", str(run), "--resume"])
    return Attack(task, lambda found: same(run, siege.base / name) if found.code == 0 else "")


def checkpoints(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """A checkpoint with a good checksum and anything in it, and ``--resume``."""
    run = folder / "run"
    words = ["run", str(siege.base / "toy.yaml"), "--out", str(run), "--no-report"]
    words += ["--set", "execution.checkpoint_every=0", "--set", "execution.executor=serial"]
    siege.children.attempt([Task(words, kill_at=int(rng.integers(20, 80)))])
    if files := sorted(run.rglob("*.iteration")):
        damage.resealed_checkpoint(files[rng.integers(len(files))], rng)
    return Attack(Task([*words, "--resume"]))


def movies_of_anybody(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    files = sorted((siege.base / "movies").glob("*"))
    path = files[rng.integers(len(files))]
    to = folder / path.name
    to.write_bytes(damage.of_bytes(path.read_bytes(), rng, first=4 * int(rng.integers(2))))
    out = ["--workers", "1", "--out", str(folder / "out.csv")]
    return Attack(Task(["track", str(to), "--pixel", "2.5 um", "--frame-rate", "400 kHz", *out]))


def tables(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """Data files, through ``init``: of text, of spreadsheets, of MATLAB."""
    target, suffix, change = (
        ("csv", ".csv", damage.of_text),
        ("workbook", ".xlsx", damage.of_archive),
        ("mat", ".mat", damage.of_bytes),
        ("mat 7.3", ".mat", damage.of_bytes),
    )[rng.integers(4)]
    seeds = fuzz_seeds.of(target)
    path = folder / f"case{suffix}"
    path.write_bytes(change(seeds[rng.integers(len(seeds))], rng))
    units = ["--time-unit", "us", "--radius-unit", "um"]
    return Attack(Task(["init", "--data", str(path), "--out", str(folder / "case.yaml"), *units]))


def pest(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """Control files, templates and instructions."""
    case = siege.copy("pest", folder / "pest")
    files = sorted(case.glob("line.*"))
    path = files[rng.integers(len(files))]
    path.write_bytes(damage.of_text(path.read_bytes(), rng))
    return Attack(Task(["python", "siege_files", "pest", str(case / "line.pst"), str(folder / "out")]))


def stops(siege: Siege, folder: Path, rng: np.random.Generator) -> Attack:
    """SIGTERM, SIGINT or SIGKILL at a random moment; what can be continued ends in the same bits."""
    known, out = commands(siege.base), folder / "out"
    name = list(known)[rng.integers(len(known))]
    command = known[name]
    number = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)[rng.integers(3)]
    (folder / "tmp").mkdir()
    words = command.into(out)
    task = Task(words, stop=number, after=float(rng.exponential(0.6)), mark=str(folder / "tmp"))

    def holds(found: Outcome) -> str:
        if found.code not in (0, 130, -number):
            return f"{name}: exit code {found.code}\n{found.told}"
        if number != signal.SIGKILL and found.code:
            siege.heeded.append((found.seconds, found.slowness))
            if found.seconds > HEEDED * found.slowness:
                told = f"{found.seconds:.1f} s, on a machine slower {found.slowness:.1f} times"
                return f"{name}: {signal.Signals(number).name} heeded after {told}"
        if left := _left(folder / "tmp"):
            return f"{name}: left behind: {left}"
        if command.again is None:
            return ""
        for _ in range(2):  # the second finds everything done
            (done,) = siege.children.attempt([Task([*words, *command.again], seconds=LONGEST)])
            if done.code:
                return f"{name}: continued after {signal.Signals(number).name}: exit code {done.code}\n{done.told}"
        return same(out, siege.undisturbed(command))

    return Attack(task, holds)


def _left(mark: Path) -> str:
    """Processes, and files in the temporary folder, that are there two seconds after the end."""
    end = time.monotonic() + HEEDED
    while True:
        processes = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if f"EN4DVAR_TEST_MARK={mark}\0".encode() in (process / "environ").read_bytes():
                    processes.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:80])
            except OSError:
                continue
        files = [p.name for p in mark.iterdir() if not p.name.startswith(("en4dvar-numba", "matplotlib"))]
        if not (processes or files) or time.monotonic() > end:
            return ", ".join([*processes, *files])
        time.sleep(0.05)


def same(a: Path, b: Path) -> str:
    tables = [p.relative_to(b) for p in sorted(b.rglob("*.csv"))]
    if different := [str(p) for p in tables if not (a / p).exists() or (a / p).read_bytes() != (b / p).read_bytes()]:
        return f"other numbers in {', '.join(different)}"
    try:
        if [*b.rglob("*.nc"), *b.rglob(PACK)]:
            assert_same_results(a, b)
    except (AssertionError, OutputError) as error:
        return f"other results: {str(error)[:200]}"
    return ""


KINDS: dict[str, Callable[[Siege, Path, np.random.Generator], Attack]] = {
    "results": results, "kept": kept, "resumed": resumed, "checkpoints": checkpoints, "movies": movies_of_anybody,
    "tables": tables, "pest": pest, "stops": stops,
}  # fmt: skip


def fault_of(attack: Attack, found: Outcome) -> str:
    """Why an attack did not hold; "" where it did."""
    if "Traceback" in found.told or "Exception ignored" in found.told:
        return found.told
    if found.code not in OURS and not attack.task.stop:
        ended = signal.Signals(-found.code).name if found.code < 0 else f"exit code {found.code}"
        return f"{ended}\n{found.told}"
    return attack.holds(found)


def besiege(siege: Siege, kind: str, seed: int, number: int) -> tuple[str, str]:
    """Make attack ``number`` of a kind; its outcome in a word, and the fault."""
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind), number])
    folder = Path(tempfile.mkdtemp(prefix=f"{kind}{number}-", dir=siege.base.parent))
    try:
        attack = KINDS[kind](siege, folder, rng)
        attack.task.seconds = attack.task.seconds or LONGEST
        (found,) = siege.children.attempt([attack.task])
        fault = fault_of(attack, found)
        if fault:
            to = FOUND / f"{kind}-{seed}-{number}"
            shutil.rmtree(to, ignore_errors=True)
            shutil.copytree(folder, to, symlinks=True)
            (to / "told.txt").write_text(f"{attack.task}\n{fault}\n")
            return "findings", fault
        words = {0: "done", 1: "refused", 2: "refused", 3: "refused", 130: "stopped", -9: "killed", -15: "killed"}
        return words[found.code], ""
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def place_of(fault: str) -> str:
    """What is the same of findings that have one cause: the last line of the program's own, and the exception."""
    own = re.findall(r'File ".*?/(en4dvar[^"]*)", line (\d+)', fault)
    last = fault.rstrip().splitlines()[-1] if own else fault.splitlines()[0]
    return f"{':'.join(own[-1])}: {last[:120]}" if own else re.sub(r"[\d.]+ s", "n s", last[:120])


def _tell_stops(heeded: list[tuple[float, float]]) -> None:
    """How soon stops were heeded, by the clock and for a machine that does nothing else."""
    if heeded:
        clock, slowness = np.array(heeded).T
        print(f"{len(clock)} stops heeded after {np.median(clock):.2f} s (median), at most {clock.max():.2f} s, "
              f"{np.sum(clock > HEEDED)} beyond {HEEDED:g} s; slowness {np.median(slowness):.2f}, at most "
              f"{slowness.max():.2f}; time by slowness at most {np.max(clock / slowness):.2f} s")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"default: all of {', '.join(KINDS)}")
    parser.add_argument("--seconds", type=float, default=300, help="for all kinds together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first attack of each kind")
    asked = parser.parse_args()
    kinds = asked.kinds or list(KINDS)
    os.environ["PYTHONPATH"] = os.pathsep.join(ATTACKED)
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    places: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        siege = Siege(Path(folder) / "base")
        siege.base.mkdir()
        siege.prepare()
        print(f"commit {git_commit(Path(__file__))}, seed {asked.seed}, from {asked.first}, {cpu_model()}", flush=True)
        begin, number, latest = time.monotonic(), asked.first, 0.0
        while time.monotonic() - begin < asked.seconds:
            for kind in kinds:
                outcome, fault = besiege(siege, kind, asked.seed, number)
                counts[kind][outcome] += 1
                if fault:
                    place, latest = place_of(fault), time.monotonic() - begin
                    places[place] += 1
                    print(f"{latest:.0f} s: {kind} {number}: {place}", flush=True)
            number += 1
        print(f"{time.monotonic() - begin - latest:.0f} s since the last finding, or the beginning")
        siege.children.close()
    _tell_stops(siege.heeded)
    print("| attacks | tried | done | refused | stopped or killed | findings |\n|---|---|---|---|---|---|")
    for kind, count in (*counts.items(), ("in all", sum(counts.values(), Counter()))):
        ended = count["stopped"] + count["killed"]
        print(f"| {kind} | {count.total()} | {count['done']} | {count['refused']} | {ended} | {count['findings']} |")
    return int(bool(places))


if __name__ == "__main__":
    sys.exit(main())
