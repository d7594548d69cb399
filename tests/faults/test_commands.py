"""Every command on a disk, or with a quota, that is full, on one that fails, and killed: what it says and leaves."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from children import Children, Task
from rows import row
from run_files import command, environment, make_campaign

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
TWIN = """\
name: twin
model: {name: lorenz96, size: 12}
twin: {cycles: 5, burn_in: 1, interval: 0.05, error: {x_std: 1}, initial_std: {x: 0.1}}
assimilation: {scheme: etkf, members: 15, inflation: 1.02}
"""
CAMPAIGN = """\
name: synthetic
seed: 2
model: {name: "toy_models:Oscillator", mass: 2 g}
campaign:
  directory: data/synthetic
  first: [4 ms, 5 ms]
  spacing: [4 ms, 5 ms]
  stop: 0.35
  fewest: 5
  noise: 1 um
  groups:
    a:
      datasets: 3
      parameters:
        A: {prior: normal, mean: 100 um, std: 1 um}
        k: {prior: lognormal, median: 3 N/m, log_std: 0.3}
        c: 0.02 N s/m
"""
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="limits and forks of POSIX")]


@pytest.fixture(scope="module")
def children():
    forks = Children()
    yield forks
    forks.close()


@pytest.fixture(scope="module")
def quiet(tmp_path_factory, children):
    return prepare(tmp_path_factory.mktemp("quiet"), children)


def prepare(folder, children):
    """A folder with configurations and what the commands make of them on a good disk."""
    make_campaign(folder, 2)
    (folder / "twin.yaml").write_text(TWIN)
    (folder / "synthetic.yaml").write_text(CAMPAIGN)
    tasks = [
        Task(["run", str(folder / f"{config}.yaml"), "--out", str(folder / name), "--no-report"])
        for config, name in (("toy", "done"), ("toy", "other"), ("twin", "twin"))
    ]
    for found in children.attempt(tasks):
        assert found.code == 0, found.told
    return folder


def calls(folder, out):
    """Words of each command that writes, and the folder that it starts from."""
    toy, done, twin, other = (str(folder / name) for name in ("toy.yaml", "done", "twin", "other"))
    study = str(CONFIGS / "agarose_study.yaml")
    return {
        "run": (["run", toy, "--out", out], ""),
        "run --force": (["run", toy, "--out", out, "--force", "--no-report"], done),
        "run --resume": (["run", toy, "--out", out, "--resume", "--no-report"], done),
        "run of a twin": (["run", f"{folder}/twin.yaml", "--out", out], ""),
        "report": (["report", out], done),
        "report of a twin": (["report", out], twin),
        "compare": (["compare", done, other, "--stored", "--out", out], ""),
        "export": (["export", done, "--out", f"{out}.csv"], ""),
        "simulate": (["simulate", toy, "--set", "parameters.A=1 mm", "--out", f"{out}.csv"], ""),
        "simulate a campaign": (["simulate", f"{folder}/synthetic.yaml", "--out", out], ""),
        "validate --plot": (["validate", toy, "--plot", "--set", f"output.directory={out}/x"], ""),
        "schema": (["schema", "--out", f"{out}.json"], ""),
        "init": (["init", "--out", f"{out}.yaml"], ""),
        "sweep": (["sweep", toy, "--trajectories", "64", "--shift", "1 ns", "--step", "1 ms", "--out", out], ""),
        "study": (["study", study, "--out", out], ""),
    }


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


def assert_told(task, found, reason):
    """Exit code 2 with one reason, no half-written file, and what was there still there."""
    assert found.code == int(row("disk-failing").exit_code), (task.words, found.told)
    assert reason in found.told, (task.words, found.told)
    assert "Traceback" not in found.told, found.told
    assert "Exception ignored" not in found.told, found.told
    assert not [p for p in Path(task.to).parent.rglob("*") if p.name.endswith(".tmp") or p.name == ".en4dvar-lock"]
    if task.copy:
        after = files(task.to)
        assert all(after[name] for name in files(task.copy) if name.suffix != ".log")


@pytest.mark.parametrize("fault", [("fsync", "EIO"), ("replace", "EDQUOT"), ("fsync", "ENOSPC")], ids="-".join)
@pytest.mark.fault("disk-failing")
def test_a_call_that_fails(quiet, children, tmp_path, fault):
    """Injected where the operating system is asked; every command flushes and renames what it writes."""
    tasks = []
    for number, name in enumerate(calls(quiet, "")):
        words, before = calls(quiet, str(tmp_path / f"out{number}"))[name]
        if name in ("run", "run of a twin", "report", "compare") or (fault[1] == "EIO" and name != "study"):
            tasks.append(Task(words, before, str(tmp_path / f"out{number}"), fails=fault[0], error=fault[1]))
    reason = {"EIO": "Input/output error", "EDQUOT": "Disk quota exceeded", "ENOSPC": "No space left on device"}
    for task, found in zip(tasks, children.attempt(tasks), strict=True):
        assert_told(task, found, reason[fault[1]])
        assert row("disk-failing").told(found.told) or "cannot be used as run directory" in found.told


@pytest.mark.parametrize("limit", [0, pytest.param(300, marks=pytest.mark.long), 9000])
@pytest.mark.fault("disk-failing")
def test_no_room(quiet, children, tmp_path, limit):
    """The kernel refuses bytes beyond a size, also those of libraries (HDF5, PDF)."""
    tasks = []
    for number, name in enumerate(calls(quiet, "")):
        words, before = calls(quiet, str(tmp_path / f"out{number}"))[name]
        if name != "study" or limit < 9000:  # it would be computed first
            tasks.append(Task(words, before, str(tmp_path / f"out{number}"), limit=limit))
    for task, found in zip(tasks, children.attempt(tasks), strict=True):
        if limit == 0 or found.code:
            assert_told(task, found, "File too large")
    begun = [t for t in tasks if t.words[0] == "run" and t.copy == ""]
    for found in children.attempt([Task([*task.words, "--resume", "--no-report"]) for task in begun]):
        assert found.code == 0, found.told


FULL = "standard output: cannot be written: No space left on device\n"


@pytest.mark.parametrize("words", [("export", "done"), ("schema",), ("run", "toy.yaml", "--no-report")])
@pytest.mark.fault("output-full")
def test_output_that_cannot_be_written(quiet, children, tmp_path, words):
    """A log on a full disk; the exit code says it even where nothing can be told."""
    given = [str(quiet / w) if w in ("done", "toy.yaml") else w for w in words]
    out = tmp_path / "out" if words[0] == "run" else None
    given += ["--out", str(out)] if out else []
    told, untold = children.attempt([Task(given, to=str(out or ""), full=which) for which in ("output", "both")])
    assert (told.code, told.told + "\n") == (int(row("output-full").exit_code), FULL)
    assert (untold.code, untold.told) == (2, "")
    if out:  # what was computed is there
        assert children.attempt([Task([*given, "--resume"])])[0].code == 0


@pytest.mark.fault("output-full")
def test_output_that_cannot_be_written_is_told_once():
    """Python would write what is left, and fail, as a process ends that is no fork."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(command("models"), stdout=full, stderr=subprocess.PIPE, text=True, env=environment())
    assert (done.returncode, done.stderr) == (int(row("output-full").exit_code), FULL)


@pytest.mark.parametrize("name", ["report", "report of a twin", "export", "compare"])
@pytest.mark.fault("kill-commands")
def test_killed_commands_are_given_again(quiet, children, tmp_path, name):
    """At every so many of their operations on files; what is left is that of an undisturbed command."""
    words, before = calls(quiet, str(tmp_path / "whole"))[name]
    base = children.attempt([Task(words, before, str(tmp_path / "whole"))])[0]
    assert base.code == 0
    whole = files(tmp_path)
    tasks = []
    for number in range(1, base.operations + 1, max(1, base.operations // 4)):
        out = tmp_path / f"killed{number}" / "whole"
        out.parent.mkdir()
        words, _ = calls(quiet, str(out))[name]
        again = [*words, *(["--force"] if name == "export" else [])]
        tasks += [Task(again, before, str(out), kill_at=number), Task(again)]
    found = children.attempt(tasks)
    assert {killed.code for killed in found[::2]} == {-9}
    assert {repeated.code for repeated in found[1::2]} == {0}, found
    for task in tasks[::2]:
        ours = files(Path(task.to).parent)
        seen = {p for p in ours if not p.name.startswith(".")}
        assert seen == {p for p in whole if not p.name.startswith(".")}
        assert all(ours[p] == whole[p] for p in seen if p.suffix in (".nc", ".csv", ".png", ".pdf"))


@pytest.mark.fault("kill-commands")
def test_a_killed_rerun_leaves_everything(quiet, children, tmp_path):
    """It does nothing to files, whenever it is killed."""
    shutil.copytree(quiet / "done", tmp_path / "run")
    before = files(tmp_path / "run")
    (found,) = children.attempt([Task(["rerun", str(tmp_path / "run")])])
    assert (found.code, found.operations) == (0, 0)
    assert files(tmp_path / "run") == before
