"""Campaigns in child processes that are killed, and what is left of them.

The children are forked from a process that has imported everything, so that a kill and the resume after it cost tenths
of a second. ``python killing.py`` is such a process: tests and ``benchmarks/faults.py`` start it with a time limit,
tell it what to do as JSON and read what it found as JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
NAMES = ("replace", "rename", "unlink", "mkdir", "fsync")  # of the module os


class Boundary:
    """Counts what a process asks of the file system; at number ``kill_at`` the process is gone, a write half done."""

    def __init__(self, kill_at: int = 0):
        self.kill_at, self.seen = kill_at, list[str]()

    def pass_by(self, what: str, path: object, half: Callable[[], object] = lambda: None) -> None:
        self.seen.append(f"{what} {path}")
        if len(self.seen) == self.kill_at:
            half()
            os.kill(os.getpid(), signal.SIGKILL)

    def install(self) -> None:
        for name in NAMES:
            setattr(os, name, self._guarded(name, getattr(os, name)))
        for name in ("write_bytes", "write_text"):
            setattr(Path, name, self._halved(name, getattr(Path, name)))

    def _guarded(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def guarded(path: Any, *rest: Any, **options: Any) -> Any:
            self.pass_by(name, path)
            return call(path, *rest, **options)

        return guarded

    def _halved(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def halved(path: Path, content: Any, *rest: Any, **options: Any) -> Any:
            self.pass_by(name, path, lambda: call(path, content[: len(content) // 2], *rest, **options))
            return call(path, content, *rest, **options)

        return halved


def in_child(action: Callable[[], object], kill_after: float | None = None) -> int:
    """Exit code of a forked child that does ``action``; negative: the signal that ended it."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            action()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    end = None if kill_after is None else time.monotonic() + kill_after
    while end is not None and time.monotonic() < end:
        if (ended := os.waitpid(pid, os.WNOHANG))[0]:
            return os.waitstatus_to_exitcode(ended[1])
        time.sleep(0.002)
    if end is not None:
        os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


class Campaign:
    """A campaign of the toy oscillator in ``folder``: how to run it, and how to judge what a kill left."""

    def __init__(self, folder: Path, sets: int, report: bool, executor: str, force: bool):
        from run_files import make_campaign

        self.folder, self.report, self.executor, self.force = folder, report, executor, force
        self.config = make_campaign(folder, sets, "execution_models:Slow")
        self.quiet = folder / "quiet"
        start = time.monotonic()
        if in_child(lambda: self.run(self.quiet, False)) != 0:
            raise SystemExit("the undisturbed run failed")
        self.seconds = time.monotonic() - start

    def run(self, out: Path, resume: bool) -> None:
        from en4dvar.config import load_config
        from en4dvar.runs.runner import run_campaign

        settings: dict[str, Any] = {"output.directory": str(out)}
        settings |= {"output.report": self.report, "output.figures": self.report}
        settings |= {"execution.executor": self.executor, "execution.checkpoint_every": 0}
        if self.executor != "serial":
            settings["execution.workers"] = 2
        force = self.force and out != self.quiet and not resume
        run_campaign(load_config(self.config, settings), force=force, resume=resume)

    def operations(self, out: Path) -> list[str]:
        """What an undisturbed run asks of the file system, in order."""
        read, write = os.pipe()

        def count() -> None:
            boundary = Boundary()
            boundary.install()
            self.run(out, False)
            with os.fdopen(write, "w") as pipe:
                pipe.write(json.dumps(boundary.seen))

        pid = os.fork()
        if pid == 0:
            try:
                count()
            finally:
                os._exit(0)
        os.close(write)
        with os.fdopen(read) as pipe:
            seen = json.loads(pipe.read())
        os.waitpid(pid, 0)
        return [str(item) for item in seen]

    def prepare(self, out: Path) -> None:
        """Where the run replaces an earlier one: that one."""
        import shutil

        if self.force:
            shutil.copytree(self.quiet, out)

    def finish(self, out: Path, draw: Callable[[], float] | None = None) -> int:
        """Resume until the run is whole; returns how many of these resumes were killed too."""
        kills = 0
        while True:
            resume = (out / ".en4dvar-files").exists() or (out / ".en4dvar-next").exists()
            code = in_child(lambda resume=resume: self.run(out, resume), draw() if draw else None)
            if code == 0:
                self.check(out)
                return kills
            if code != -signal.SIGKILL or draw is None:
                raise SystemExit(f"{out}: resume ended with {code}")
            kills += 1

    def check(self, out: Path) -> None:
        from run_files import assert_same_results

        assert_same_results(out, self.quiet)
        left = {p.relative_to(out).as_posix() for p in out.rglob("*")}
        wanted = {p.relative_to(self.quiet).as_posix() for p in self.quiet.rglob("*")}
        if left != wanted:
            raise SystemExit(f"{out}: {sorted(left ^ wanted)} differ from the undisturbed run")
        for name in ("summary.csv", "report.html"):
            if self.report and name == "summary.csv" and (out / name).read_text() != (self.quiet / name).read_text():
                raise SystemExit(f"{out}: {name} differs from the undisturbed run")


def kill_at_boundaries(campaign: Campaign, share: float, seed: int) -> dict[str, Any]:
    """Kill once at each of a share of the operations, resume, compare."""
    out = campaign.folder / "counted"
    campaign.prepare(out)
    operations = campaign.operations(out)
    draw, at = random.Random(seed), {}
    numbers = [i for i in range(1, len(operations) + 1) if draw.random() < share]
    for number in numbers:
        out = campaign.folder / f"at{number}"
        campaign.prepare(out)

        def run(out: Path = out, number: int = number) -> None:
            Boundary(number).install()
            campaign.run(out, False)

        code = in_child(run)
        if code != -signal.SIGKILL:
            raise SystemExit(f"operation {number} was not reached: the child ended with {code}")
        if campaign.force:  # the earlier run, or the new one, and nothing between
            from run_files import assert_same_results

            whole = (out / ".en4dvar-next" / ".en4dvar-complete").exists()
            if not whole and (out / ".en4dvar-next").exists():
                before = {p.relative_to(campaign.quiet) for p in campaign.quiet.rglob("*.nc")}
                assert all((out / name).read_bytes() == (campaign.quiet / name).read_bytes() for name in before)
            elif not whole:
                assert_same_results(out, campaign.quiet)
        campaign.finish(out)
        at[number] = operations[number - 1].split("/")[-1]
    return {"operations": len(operations), "kills": len(numbers), "at": at}


def kill_at_random(campaign: Campaign, kills: int, seed: int) -> dict[str, Any]:
    """Kill after random times, resumes included, until that many have been killed and the last run is whole."""
    draw, killed, finished = random.Random(seed), 0, 0
    while killed < kills:
        out = campaign.folder / f"random{finished}"
        campaign.prepare(out)
        killed += campaign.finish(out, lambda: draw.uniform(0.0, campaign.seconds))
        finished += 1
    return {"kills": killed, "finished": finished}


def main() -> None:
    task = json.loads(sys.stdin.read())
    sys.path.insert(0, str(TESTS))
    import en4dvar.report
    import en4dvar.runs.runner  # noqa: F401
    from en4dvar.results.provenance import source_digest

    source_digest("en4dvar")  # once for all children
    with tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(Path(folder), task["sets"], task["report"], task["executor"], task["force"])
        if "kills" in task:
            found = kill_at_random(campaign, task["kills"], task["seed"])
        else:
            found = kill_at_boundaries(campaign, task["share"], task["seed"])
    print(json.dumps(found))


def survive(
    timeout: float, sets: int = 2, report: bool = False, executor: str = "serial", force: bool = False, **how: Any
) -> dict[str, Any]:
    """Do it in a process of its own; ``how``: ``share`` or ``kills``, and ``seed``.

    Raises
    ------
    AssertionError: a resumed run differs from the undisturbed one, or cannot be resumed.
    """
    task = {"sets": sets, "report": report, "executor": executor, "force": force, **how}
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "EN4DVAR_TEST_PAUSE": "0", "MPLBACKEND": "agg"}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    process = subprocess.Popen([sys.executable, __file__], text=True, env=environment, start_new_session=True, **pipes)
    with process:
        try:
            out, told = process.communicate(json.dumps(task), timeout=timeout)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, told[-4000:]
    return dict(json.loads(out))


if __name__ == "__main__":
    main()
