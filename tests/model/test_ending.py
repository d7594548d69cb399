"""Programs that would not end: their children, pipes in the place of files, templates without end, and a stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rows import row
from run_files import command, environment

from en4dvar.model.forward import Failure
from en4dvar.model.programs.model import CommandModel, CommandSettings

TIMES = np.array([0.0, 1.0])
VALUES = {"y": {"file": "stdout", "pattern": r"(\S+)"}}
CONFIG = """\
name: program
model:
  command: "{command}"
  shell: true
  parameters: {{a: "1"}}
  outputs: {{y: {{file: "{file}", pattern: '(\\S+)'}}}}
  time_unit: "1"
  {more}
data: {{path: data.csv, columns: {{time: {{name: t, unit: "1"}}, y: {{name: y, unit: "1"}}}}, error: {{y_std: "0.1"}}}}
parameters: {{a: {{prior: normal, mean: 0, std: 1}}}}
assimilation: {{members: 6}}
execution: {{workers: 2}}
output: {{report: false}}
"""


def run(folder: Path, line: str, **more: Any) -> Any:
    """What a line of a shell makes of one member; it writes the number of a process of its own to ``pid``."""
    content = {
        "command": line, "shell": True, "parameters": {"a": "1"}, "outputs": VALUES, "time_unit": "1",
        "scratch": str(folder), **more,
    }  # fmt: skip
    model = CommandModel(CommandSettings.model_validate(content, context={"base": folder}))
    (outcome,) = model.trajectories(np.array([[0.5]]), TIMES)
    return outcome


def is_gone(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def wait_until(true: Any, seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while not (held := true()) and time.monotonic() < end:
        time.sleep(0.02)
    return bool(held)


ESCAPES = {
    "background": "sleep 60 & echo $! > {folder}/pid; echo 1; echo 2",
    "with its own session": "setsid sh -c 'echo $$ > {folder}/pid; exec sleep 60' & sleep 0.3; echo 1; echo 2",
    "ended badly": "sleep 60 & echo $! > {folder}/pid; exit 3",
}


@pytest.mark.fault("program-children")
@pytest.mark.parametrize("way", ESCAPES)
def test_no_child_survives_its_program(tmp_path: Path, way: str) -> None:
    began = time.monotonic()
    outcome = run(tmp_path, ESCAPES[way].replace("{folder}", str(tmp_path)))
    assert isinstance(outcome, Failure) == (way == "ended badly")
    assert time.monotonic() - began < 10  # of the 60 of a child with our pipe in its hand
    assert wait_until(lambda: is_gone(int((tmp_path / "pid").read_text())))
    assert [p.name for p in tmp_path.iterdir()] == ["pid"]


@pytest.mark.fault("program-output")
@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("mkfifo out", "out: is a pipe, not a file"),
        ("ln -s /dev/zero out", "out: is a device, not a file"),
        ("mkdir out", "out: is a directory, not a file"),
        ("truncate -s 1T out", "out: 1.1 TB; at most 256 MB are read"),
    ],
)
@pytest.mark.parametrize("way", [{"pattern": r"(\S+)"}, {"column": 1}], ids=["pattern", "column"])
def test_an_output_that_cannot_be_read_is_a_lost_member(
    tmp_path: Path, line: str, told: str, way: dict[str, Any]
) -> None:
    outcome = run(tmp_path, line, outputs={"y": {"file": "out", **way}}, time_limit="5 s")
    assert row("program-output").told(outcome.reason)
    assert told in outcome.reason


@pytest.mark.fault("program-output")
def test_a_template_without_end_is_past_its_time(tmp_path: Path) -> None:
    body = "{% for i in range(99999) %}{% for j in range(99999) %}{% endfor %}{% endfor %}{{ a }}"
    (tmp_path / "in.j2").write_text(body)
    began = time.monotonic()
    outcome = run(tmp_path, "echo 1; echo 2", templates="in.j2", time_limit="0.3 s")
    assert outcome.reason.endswith("not done after 0.3 s")
    assert time.monotonic() - began < 10


@pytest.mark.fault("program-output")
def test_a_template_that_swells_is_refused(tmp_path: Path) -> None:
    (tmp_path / "in.j2").write_text("{% for i in range(99999) %}{{ 'x' * 10 ** 7 }}{% endfor %}{{ a }}")
    before = psutil.Process().memory_info().rss
    outcome = run(tmp_path, "echo 1; echo 2", templates="in.j2")
    assert "in.j2: makes an input file of more than 256 MB" in outcome.reason
    assert psutil.Process().memory_info().rss - before < 300e6


@pytest.mark.slow
@pytest.mark.fault("program-output")
def test_a_pattern_without_end_is_past_its_time(tmp_path: Path) -> None:
    outputs = {"y": {"file": "stdout", "pattern": r"(?:a*)*(\d)b"}}
    outcome = run(tmp_path, "printf '%5000s' | tr ' ' a", outputs=outputs, time_limit="1 s")
    assert "stdout: takes more than 1 s of processor time" in outcome.reason or "not done after" in outcome.reason


def test_a_program_that_says_without_end_what_is_wrong_takes_no_memory(tmp_path: Path) -> None:
    before = psutil.Process().memory_info().rss
    outcome = run(tmp_path, "head -c 300000000 /dev/zero | tr '\\0' 'x' >&2; echo; echo sorry >&2; exit 1")
    assert outcome.reason.endswith("sorry")
    assert psutil.Process().memory_info().rss - before < 100e6


STUCK = {
    "program": ("touch {folder}/begun; sleep 1000", "stdout", ""),
    "child": ("sleep 1000 & touch {folder}/begun; sleep 1000", "stdout", ""),
    "template": (
        "touch {folder}/begun; echo 1; echo 2", "stdout",
        "templates: in.j2",
    ),
    "pattern": ("printf '%5000s' | tr ' ' a; touch {folder}/begun", "stdout", ""),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.fault("program-stop")
@pytest.mark.parametrize(
    ("where", "number", "executor"),
    [
        ("program", signal.SIGTERM, "serial"), ("child", signal.SIGTERM, "threads"),
        ("child", signal.SIGTERM, "processes"), ("child", signal.SIGKILL, "threads"),
        ("child", signal.SIGKILL, "processes"), ("template", signal.SIGTERM, "threads"),
        ("template", signal.SIGTERM, "processes"), ("pattern", signal.SIGTERM, "threads"),
        ("pattern", signal.SIGKILL, "threads"), ("pattern", signal.SIGTERM, "processes"),
    ],
)  # fmt: skip
def test_a_stop_is_heeded_wherever_a_program_stands_and_nothing_survives(
    tmp_path: Path, where: str, number: signal.Signals, executor: str
) -> None:
    line, file, more = STUCK[where]
    (tmp_path / "temporary").mkdir()
    (tmp_path / "in.j2").write_text("{% for i in range(99999) %}{% for j in range(99999) %}{% endfor %}{% endfor %}")
    (tmp_path / "data.csv").write_text("t,y\n0,1\n1,2\n2,3\n")
    text = CONFIG.format(command=line.replace("{folder}", str(tmp_path)), file=file, more=more)
    (tmp_path / "config.yaml").write_text(text.replace("(\\S+)", "(?:a*)*(.)b") if where == "pattern" else text)
    words = command(
        "run", tmp_path / "config.yaml", "--out", tmp_path / "run", "--set", f"execution.executor={executor}"
    )
    process = subprocess.Popen(
        words, env=environment(TMPDIR=tmp_path / "temporary"), stderr=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=_heed_signals,
    )  # fmt: skip
    begun = tmp_path / ("run/run.log" if where == "template" else "begun")
    assert wait_until(lambda: begun.exists() or process.poll() is not None, 60)
    time.sleep(0.1 if where in ("program", "child") else 1.0)
    assert process.poll() is None, process.communicate()[1]
    process.send_signal(number)
    began = time.monotonic()
    _, told = process.communicate(timeout=60)
    assert time.monotonic() - began < 5  # two on a machine with nothing else to do
    if number == signal.SIGTERM:
        assert process.returncode == 130, told
        assert "to continue: en4dvar run" in told
    assert wait_until(lambda: not _left(tmp_path))
    assert wait_until(lambda: not list((tmp_path / "temporary").iterdir()))


def _heed_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _left(folder: Path) -> list[str]:
    """Processes whose command or folder is of this test."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline", "environ"]):
        words = " ".join(process.info["cmdline"] or [])
        places = str((process.info["environ"] or {}).get("TMPDIR", ""))
        if process.pid != os.getpid() and (str(folder) in words or str(folder) in places):
            found.append(f"{process.pid} {words}")
    return found


assert sys.platform != "win32"
