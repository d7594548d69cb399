"""A command of the page: a process of its own that outlives the server, and a folder of files that tells about it.

``python -m en4dvar_app.job FOLDER`` runs ``FOLDER/command.json`` in the folder two above; it writes ``output`` and, at
the end, ``code``.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

JOBS = ".en4dvar_app"


def start(folder: Path, step: str, words: list[str]) -> Path:
    """Begin ``en4dvar WORDS`` in ``folder``; return the job's folder."""
    jobs = folder / JOBS
    jobs.mkdir(exist_ok=True)
    number = 1 + max((int(p.name) for p in jobs.iterdir() if p.name.isdigit()), default=0)
    job = jobs / str(number)
    job.mkdir()
    (job / "command.json").write_text(json.dumps({"step": step, "words": words}), encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, "-m", "en4dvar_app.job", str(job)], start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    (job / "pid").write_text(str(process.pid), encoding="utf-8")
    return job


def told(job: Path) -> dict[str, Any]:
    """What the page shows of a job: its command line, output and state (running, done, failed or stopped)."""
    command = json.loads((job / "command.json").read_text(encoding="utf-8"))
    output = (job / "output").read_text(encoding="utf-8", errors="replace") if (job / "output").exists() else ""
    state = "running"
    if (job / "code").exists():
        code = int((job / "code").read_text(encoding="utf-8"))
        state = "done" if code == 0 else "stopped" if code in (-signal.SIGINT, 130) else "failed"
    elif not _alive(job):
        state = "stopped"
    line = shlex.join(["en4dvar", *command["words"]])
    return {"number": int(job.name), "step": command["step"], "line": line, "output": output[-20_000:], "state": state}


def every(folder: Path) -> list[dict[str, Any]]:
    """Jobs of a folder, the oldest first."""
    jobs = folder / JOBS
    found = [p for p in jobs.iterdir() if (p / "command.json").is_file()] if jobs.is_dir() else []
    return [told(job) for job in sorted(found, key=lambda p: int(p.name))]


def cancel(job: Path) -> None:
    """Interrupt a running job as Ctrl-C does; what it has written stays, and ``--resume`` continues a run."""
    if told(job)["state"] == "running":
        with suppress(ProcessLookupError):
            os.killpg(int((job / "pid").read_text(encoding="utf-8")), signal.SIGINT)


def _alive(job: Path) -> bool:
    """Whether the job's process is there, and is this job's: numbers of processes are used again."""
    try:
        pid = int((job / "pid").read_text(encoding="utf-8"))
        with suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)
        command = Path(f"/proc/{pid}/cmdline")
        if Path("/proc/self").exists():
            return str(job).encode() in command.read_bytes()
        os.kill(pid, 0)
    except (OSError, ValueError):
        return False
    return True


def _main(job: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for the command
    words = json.loads((job / "command.json").read_text(encoding="utf-8"))["words"]
    with (job / "output").open("wb") as output:
        code = subprocess.call(
            [sys.executable, "-m", "en4dvar.cli", *words], cwd=job.parent.parent, stdin=subprocess.DEVNULL,
            stdout=output, stderr=subprocess.STDOUT, env={**os.environ, "COLUMNS": "100"}, preexec_fn=_listen,
        )  # fmt: skip
    (job / "code.partial").write_text(str(code), encoding="utf-8")
    (job / "code.partial").replace(job / "code")


def _listen() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
