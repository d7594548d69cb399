"""A command of the page: a process of its own that outlives the server, and a folder of files that tells about it.

``python -m en4dvar_app.job FOLDER`` runs the command in ``FOLDER/command.json`` in the folder two above. It holds the
lock of ``FOLDER`` while it works, writes ``output`` and at the end ``code``, and ends the command where a file
``cancel`` appears. Nothing of this needs POSIX. Python's option ``-P`` keeps modules that lie in the folder from being
imported in place of installed ones.
"""

import json
import os
import shlex
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from en4dvar.plumbing.errors import En4dvarError, OutputError
from en4dvar.plumbing.files import inside, write_text
from en4dvar.runs.lock import locked
from en4dvar_app.trusted import require_harmless

JOBS = ".en4dvar_app"
LONGEST = 20_000  # characters of output on the page
INTERRUPTED = 130
_begun: dict[Path, subprocess.Popen[bytes]] = {}  # by this process


def start(root: Path, step: str, subject: str, words: list[str], trust: bool) -> int:
    """Begin ``en4dvar WORDS`` in the folder ``root``; the number of the job. Raises :class:`OutputError`."""
    jobs = inside(root, JOBS)
    try:
        jobs.mkdir(exist_ok=True)
        number = 1 + max(_numbers(jobs), default=0)
        job = jobs / str(number)
        job.mkdir()
    except FileExistsError:
        raise OutputError("another window begins a command: look at the page again") from None
    except OSError as error:
        why = f"no command can write into {root} ({error.strerror})"
        raise OutputError(f"{why}; copy what is in it to a folder of yours, and open that one") from None
    about = {"step": step, "subject": subject, "words": words, "trust": trust}
    write_text(job / "command.json", json.dumps(about))
    _begun[job] = subprocess.Popen(
        [sys.executable, "-P", "-m", "en4dvar_app.job", str(job)], start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    return number


def every(root: Path, most: int = 40) -> list[dict[str, Any]]:
    """The last jobs of a folder, the oldest first: command line, output, state (running, done, failed or stopped)."""
    jobs = inside(root, JOBS)
    return [about for number in _numbers(jobs)[-most:] if (about := _described(jobs / str(number)))]


def cancel(root: Path, number: int) -> None:
    """Interrupt a job as Ctrl-C does; what it has written stays, and ``--resume`` continues a run."""
    write_text(inside(root, f"{JOBS}/{number}/cancel"), "")


def _numbers(jobs: Path) -> list[int]:
    names = os.listdir(jobs) if jobs.is_dir() else []
    return sorted(int(name) for name in names if name.isascii() and name.isdecimal() and len(name) < 9)


def _described(job: Path) -> dict[str, Any] | None:
    """None: the folder is not one of ours."""
    try:
        about = json.loads((job / "command.json").read_text(encoding="utf-8"))
        line = shlex.join(["en4dvar", *map(str, about["words"])])
        named = [str(word)[2:].split("=", 1) for word in about["words"] if str(word).startswith("--")]
        options = {word[0]: word[1] for word in named if len(word) == 2}
        subject = options.get("data", str(about["subject"]))
        whole = {"number": int(job.name), "step": str(about["step"]), "subject": subject, "options": options}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    whole |= {"line": line, "out": options.get("out", ""), "output": end_of(job / "output")}
    return {**whole, "state": _state(job)}


def end_of(path: Path, most: int = LONGEST) -> str:
    """The last characters of a file; "" where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - most))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


def _state(job: Path) -> str:
    with suppress(OSError, ValueError):
        code = int((job / "code").read_text(encoding="utf-8"))
        _begun.pop(job, None)  # another folder may have its name later
        cancelled = code == INTERRUPTED or (job / "cancel").exists()
        return "done" if code == 0 else "stopped" if cancelled else "failed"
    process = _begun.get(job)
    if process is not None:
        return "running" if process.poll() is None else "stopped"
    try:
        with locked(job):
            return "stopped"
    except OutputError:
        return "running"
    except OSError:
        return "stopped"


def _main(job: Path) -> int:
    about = json.loads((job / "command.json").read_text(encoding="utf-8"))
    root, words = job.parent.parent, [str(word) for word in about["words"]]
    with locked(job):
        with (job / "output").open("wb") as output:
            try:
                if about["step"] in ("validate", "prior", "run", "resume"):
                    require_harmless(root, root / words[1], about["trust"])
                code = _command(job, root, words, output)
            except En4dvarError as error:
                output.write(f"{error}\n".encode())
                code = error.exit_code
        write_text(job / "code", str(code))
    return code


def _command(job: Path, root: Path, words: list[str], output: Any) -> int:
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "en4dvar.cli", *words], cwd=root, stdin=subprocess.DEVNULL,
        stdout=output, stderr=subprocess.STDOUT, env={**os.environ, "COLUMNS": "100"},
    )  # fmt: skip
    while process.poll() is None:
        if (job / "cancel").exists():
            process.terminate()
            code = process.wait()
            if not (job / "output").stat().st_size:
                output.write(b"cancelled before the command had begun: nothing was done; click again to begin\n")
            return code
        time.sleep(0.1)
    return process.wait()


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]).resolve()))
