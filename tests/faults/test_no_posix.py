"""A system without POSIX: run, resume, track and report as on Windows, in processes that lack what Windows lacks."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from run_files import TESTS, assert_same_results, command, environment, make_campaign

ROOT = TESTS.parent
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="needs /proc to be refused by")]


@pytest.fixture(scope="module")
def away(tmp_path_factory):
    """Variables of the environment of a process that lacks POSIX, at a console of Western Europe."""
    folder = tmp_path_factory.mktemp("away")
    shutil.copy(Path(__file__).with_name("no_posix.py"), folder / "sitecustomize.py")
    (folder / "taskkill").write_text(f"#!/bin/sh\nPYTHONPATH= exec '{sys.executable}' '{folder}/sitecustomize.py' $@\n")
    (folder / "taskkill").chmod(0o755)
    path = os.pathsep.join((str(folder), *environment()["PYTHONPATH"].split(os.pathsep)))
    return {"PYTHONPATH": path, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "PYTHONIOENCODING": "cp1252"}


def ran(away, *words, code=0, cwd=None):
    """What a command says."""
    done = subprocess.run(command(*words), capture_output=True, env={**environment(), **away}, cwd=cwd)
    told = (done.stdout + done.stderr).decode("cp1252")
    assert done.returncode == code, told
    assert not any(words in told for words in ("Traceback", "Exception ignored")), told
    return told


def test_it_is_away(away):
    code = (
        "import os, signal, en4dvar; print(hasattr(os, 'fork') or hasattr(os, 'killpg') or hasattr(signal, 'SIGHUP'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**environment(), **away})
    assert done.stdout == "False\n", done.stderr
    done = subprocess.run([sys.executable, "-c", "import fcntl"], env={**environment(), **away}, capture_output=True)
    assert b"ModuleNotFoundError" in done.stderr


def test_the_quick_start(away, tmp_path):
    run = tmp_path / "run"
    assert str(run / "report.html") in ran(away, "run", ROOT / "configs" / "quickstart.yaml", "--out", run)
    assert "report.html" in ran(away, "report", run)
    assert "in use" not in ran(away, "run", ROOT / "configs" / "quickstart.yaml", "--out", run, "--force")
    assert sorted(p.name for p in run.iterdir() if p.name.startswith(".")) == [".en4dvar-files"]
    assert "set" in ran(away, "export", run)


def test_a_campaign_with_processes_killed_and_resumed(away, tmp_path):
    path = make_campaign(tmp_path, 4)
    words = ("run", path, "--no-report", "--set", "execution.executor=processes", "--workers", "2")
    subprocess.run(command(*words, "--out", tmp_path / "quiet"), check=True, env=environment(), capture_output=True)
    for after in (1.0, 2.0, 3.0):
        run = tmp_path / f"run{after}"
        process = subprocess.Popen(
            command(*words, "--out", run, "--set", "execution.checkpoint_every=0"), env={**environment(), **away},
            stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        time.sleep(after)
        process.send_signal(signal.SIGKILL)
        process.wait()
        ran(away, *words, "--out", run, "--resume", "--set", "execution.checkpoint_every=0")
        assert_same_results(run, tmp_path / "quiet")
        assert (run / "summary.csv").read_bytes() == (tmp_path / "quiet" / "summary.csv").read_bytes()


def test_tracking_a_movie(away, tmp_path):
    from siege_files import movies

    movies(tmp_path / "movies")
    told = ran(
        away, "track", tmp_path / "movies" / "a.tif", "--pixel", "2.5 um", "--frame-rate", "400 kHz", cwd=tmp_path
    )
    assert "frames read" in told


PROGRAM = """\
name: program
model:
  command: "{command}"
  parameters: {{a: "1"}}
  templates: in.txt.j2
  outputs: {{y: {{file: out, pattern: '(\\S+)$'}}}}
  time_unit: "1"
  time_limit: 5 s
data: {{path: data.csv, columns: {{time: {{name: t, unit: "1"}}, y: {{name: y, unit: "1"}}}}, error: {{y_std: "0.1"}}}}
parameters: {{a: {{prior: normal, mean: 0, std: 1}}}}
assimilation: {{members: 6}}
output: {{report: false}}
"""


def test_a_program_whose_files_end_lines_as_there(away, tmp_path):
    (tmp_path / "in.txt.j2").write_bytes(b"{{ a }}\r\n")
    (tmp_path / "data.csv").write_bytes(b"t,y\r\n0,1\r\n1,2\r\n2,3\r\n")
    (tmp_path / "line.py").write_text(
        "a = float(open('in.txt').read())\n"
        "open('out', 'wb').write(''.join(f'y = {a + t}\\r\\n' for t in range(3)).encode())\n"
    )
    text = PROGRAM.format(command="{python} -S {here}/line.py")
    (tmp_path / "config.yaml").write_bytes(text.replace("\n", "\r\n").encode())
    ran(away, "run", tmp_path / "config.yaml", "--out", tmp_path / "run")
    (tmp_path / "line.py").write_text("import time\ntime.sleep(60)\n")
    text = text.replace("5 s", "0.3 s")
    (tmp_path / "config.yaml").write_text(text)
    assert "not done after 0.3 s" in ran(away, "run", tmp_path / "config.yaml", "--out", tmp_path / "late", code=3)


def test_the_page_in_the_browser_begins_and_cancels_commands(away, tmp_path):
    from page_server import start

    shutil.copytree(ROOT / "configs" / "data", tmp_path / "data")
    shutil.copy(ROOT / "configs" / "quickstart.yaml", tmp_path)
    server = start(tmp_path, **{**environment(), **away})
    try:
        assert server.post("validate", config="quickstart.yaml")[0] == 200
        assert server.last()["state"] == "done", server.last()
        assert server.post("run", config="quickstart.yaml", run="a")[0] == 200
        while b"iteration" not in server.ask("/look/live?run=a")[1]:
            assert server.state()["jobs"][-1]["state"] == "running", server.last()
            time.sleep(0.05)
        assert server.post("cancel")[0] == 200
        assert server.last()["state"] == "stopped"
        assert server.post("resume", config="quickstart.yaml", run="a")[0] == 200
        assert server.last()["state"] == "done", server.last()
    finally:
        server.end()


def test_a_file_that_something_else_holds_open_is_replaced_a_little_later(away, tmp_path):
    code = """
import os, threading, time
from en4dvar.plumbing.files import write_text
write_text("a.txt", "before")
held = open("a.txt")
threading.Timer(0.3, held.close).start()
write_text("a.txt", "after")
held = open("a.txt")
try:
    write_text("a.txt", "never")
except Exception as error:
    print(error)
print(held.read(), os.listdir())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env={**environment(), **away}
    )
    first, second = done.stdout.splitlines()
    assert first.startswith("a.txt: cannot be written: The process cannot access the file"), done.stderr
    assert second == "after ['a.txt']"
