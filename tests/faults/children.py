"""Commands in forked children: on a disk that takes files up to a size only, with a failing call, killed half-way.

``python children.py`` has imported everything, so that a child costs tenths of a second; for each line of tasks (JSON)
it writes a line of what came of them. :class:`Children` is one such process, for all tests of a module.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pkgutil
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

PACE = 0.02  # s of work, and of rest
STOPS = (signal.SIGINT, signal.SIGTERM)
TESTS = Path(__file__).resolve().parents[1]
USED_LATER = (
    "dask.array", "distributed", "fontTools.subset", "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf", "matplotlib.backends.backend_svg", "matplotlib.pyplot", "PIL.PngImagePlugin",
    "rich.progress",
)  # fmt: skip
"""What libraries import when they are used."""


@dataclass
class Task:
    """``words`` of the command line. ``copy`` is put in place of ``to`` before.

    ``limit``: bytes that a file may have (the kernel's own refusal, EFBIG); ``fails``: a function of ``os`` that ends
    in ``error``; ``kill_at``: number of the operation on files at which the process is gone. Standard output is thrown
    away, or on a ``full`` device: "output", or "both", standard error too. After ``seconds`` the process is ended
    (SIGALRM). ``stop``: number of a signal that it gets ``after`` seconds. ``mark``: its temporary folder, and a
    variable of its environment, by which what it has started is known.
    """

    words: list[str]
    copy: str = ""
    to: str = ""
    limit: int | None = None
    fails: str = ""
    error: str = ""
    kill_at: int = 0
    full: str = ""
    seconds: int = 0
    stop: int = 0
    after: float = 0.0
    mark: str = ""


@dataclass
class Outcome:
    """``code``: exit code, negative for a signal; ``operations`` on files, where the end was reached; ``seconds`` that
    it took, from the first signal on where it got one; ``slowness``: how long a second of processor time took a plain
    loop beside it meanwhile, in s of the clock (1 on a machine that does nothing else).
    """

    code: int
    told: str
    operations: int
    seconds: float = 0.0
    slowness: float = 1.0


class Children:
    """The process that forks them; what it says itself goes to standard error."""

    def __init__(self) -> None:
        environment = {**os.environ, "PYTHONPATH": _path(), "EN4DVAR_TEST_PAUSE": "0", "MPLBACKEND": "agg"}
        self.process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def attempt(self, tasks: list[Task], timeout: float = 300) -> list[Outcome]:
        """What came of each task, in order, within a ``timeout`` beyond the time that they have themselves."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        timeout += sum(task.seconds for task in tasks)
        watch = threading.Timer(timeout, self.process.kill)
        watch.start()
        try:
            self.process.stdin.write(json.dumps([asdict(t) for t in tasks]) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        finally:
            watch.cancel()
        assert line, f"the process that forks ended, or was not done after {timeout:g} s"
        return [Outcome(**found) for found in json.loads(line)]

    def close(self) -> None:
        self.process.communicate()


def _path() -> str:
    return os.pathsep.join(filter(None, (str(TESTS), os.environ.get("PYTHONPATH"))))


def _child(task: Task, told: int) -> None:
    """Ends the process; its last line is the number of operations."""
    from killing import Boundary

    from en4dvar.cli import main

    boundary = Boundary(task.kill_at)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full if task.full == "both" else told, 2)
    os.dup2(full if task.full else os.open(os.devnull, os.O_WRONLY), 1)
    signal.alarm(task.seconds)
    if task.mark:
        os.environ["EN4DVAR_TEST_MARK"] = os.environ["TMPDIR"] = task.mark
        tempfile.tempdir = None
    if task.limit is not None:
        # Python takes the part of a module's bytecode that had room for the whole, here and in every later process
        sys.dont_write_bytecode = True
        resource.setrlimit(resource.RLIMIT_FSIZE, (task.limit, task.limit))
    if task.fails:
        _break(task.fails, getattr(errno, task.error))
    else:
        boundary.install()
    sys.argv = ["en4dvar", *task.words]
    code = 99
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
        if task.words[0] == "python":  # a function of a module of the tests, of what follows
            from importlib import import_module as module

            getattr(module(task.words[1]), task.words[2])(*task.words[3:])
            code = 0
        else:
            main(task.words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except KeyboardInterrupt:  # before the command has begun
        code = 130
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os.write(told, f"{len(boundary.seen)}\n".encode())
    os._exit(code)


def _stop(pid: int, task: Task, ended: threading.Event, slowness: list[float]) -> None:
    """Send the signal; until the end, a loop that takes half of a core tells how busy the machine is."""
    if ended.wait(task.after):
        return
    os.kill(pid, task.stop)
    clock = worked = 0.0
    while not ended.wait(PACE):
        began, begin = time.monotonic(), time.thread_time()
        while time.thread_time() - begin < PACE:
            pass
        clock, worked = clock + time.monotonic() - began, worked + time.thread_time() - begin
        slowness[:] = [max(1.0, clock / worked)]


def _break(name: str, number: int) -> None:
    def broken(path: Any, *_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number), path if isinstance(path, str | Path) else None)

    setattr(os, name, broken)


def _do(task: Task) -> Outcome:
    if task.to:
        shutil.rmtree(task.to, ignore_errors=True)
    if task.copy:
        shutil.copytree(task.copy, task.to)
    read, write = os.pipe()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)  # a command begins before it is stopped
    pid = os.fork()
    if pid == 0:
        _child(task, write)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
    os.close(write)
    began = time.monotonic() + task.after
    ended, slowness = threading.Event(), [1.0]
    if task.stop:
        threading.Thread(target=_stop, args=(pid, task, ended, slowness), daemon=True).start()
    with os.fdopen(read, errors="replace") as pipe:
        told = pipe.read()
    ended.set()  # before its number can be that of another
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    seconds = time.monotonic() - began
    lines, _, operations = told.rstrip("\n").rpartition("\n")
    if code < 0 or not operations.isdigit():  # ended where it stood
        return Outcome(code, told, 0, seconds, slowness[0])
    return Outcome(code, lines, int(operations), seconds, slowness[0])


def _of_few(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Drawing is nearly all of a report; a second figure shows whatever could happen to the files of a tenth."""

    def few(figures: Iterable[Any], *rest: Any, **options: Any) -> Any:
        return draw(islice(figures, 2), *rest, **options)

    return few


def _import_everything() -> None:
    """What the commands import as they go as well: half of the time of a child was that."""
    import en4dvar.report.page
    import en4dvar.report.sequence
    import en4dvar_agarose
    import en4dvar_bubble
    import en4dvar_lorenz
    from en4dvar.results.provenance import source_digest

    for name in USED_LATER:
        import_module(name)
    for package in (en4dvar, en4dvar_agarose, en4dvar_bubble, en4dvar_lorenz):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            import_module(found.name)
    source_digest("en4dvar")
    for module in (en4dvar.report, en4dvar.report.page, en4dvar.report.sequence):
        module.draw = _of_few(module.draw)  # type: ignore[attr-defined]


def main() -> None:
    sys.path.insert(0, str(TESTS))
    _import_everything()
    for line in sys.stdin:
        print(json.dumps([asdict(_do(Task(**task))) for task in json.loads(line)]), flush=True)


if __name__ == "__main__":
    main()
