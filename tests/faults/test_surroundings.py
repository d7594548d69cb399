"""Clocks that jump, folders and files of unusual size, names in any script."""

import datetime
import itertools
import os
import resource
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cheap_model import write_campaign
from first_starts import start_together
from growth import measured
from many_sets import estimate_many
from rows import row
from run_files import assert_same_results, command, configuration, environment, make_campaign, run_cli
from toy_config import csv_text, write_toy

from en4dvar.config import load_config
from en4dvar.plumbing import files
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.runner import run_campaign
from en4dvar_bubble.starter.config import propose_config

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.mark.fault("clock")
def test_a_clock_that_jumps_backwards(tmp_path, monkeypatch):
    """An hour at every reading: nothing waits for it, nothing is computed from it."""
    path = make_campaign(tmp_path, 2)
    settings = {"executor": "threads", "workers": 2}
    run_campaign(configuration(path, tmp_path / "quiet", **settings))
    jumps = itertools.count(0, -3600)

    class Clock(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return super().now(tz) + datetime.timedelta(seconds=next(jumps))

    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + next(jumps))
    monkeypatch.setattr("en4dvar.runs.progress.datetime", Clock)
    monkeypatch.setattr("en4dvar.results.provenance.datetime", Clock)
    config = configuration(path, tmp_path / "run", **settings)
    campaign = run_campaign(config)
    assert campaign.exit_code == 0
    assert next(jumps) < -5 * 3600
    assert_same_results(tmp_path / "run", tmp_path / "quiet")
    assert run_campaign(config, resume=True).exit_code == 0


@pytest.mark.parametrize("sets", [40, pytest.param(10_000, marks=pytest.mark.long)], ids=["few", "many"])
@pytest.mark.fault("many-sets")
@pytest.mark.slow
def test_many_data_sets_in_flat_memory(tmp_path, sets):
    early, late, first = estimate_many(tmp_path, sets)
    assert late - early < 20 + 0.005 * sets, "MB; the files of all are written at the end, in blocks"
    assert first < 30


@pytest.mark.parametrize("rows", [20_000, pytest.param(10**6, marks=pytest.mark.long)])
@pytest.mark.fault("many-rows")
@pytest.mark.slow
def test_a_long_data_file(tmp_path, rows):
    """Every row is an observation; memory stays at a few arrays of members by observations."""
    path = write_campaign(tmp_path, 1)
    t = np.linspace(0.0, 3.0, rows)
    np.savetxt(tmp_path / "data" / "set00000.csv", np.c_[t, 1 + t], "%.9g", ",", header="t,y", comments="")

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30,) * 2)

    words = ("run", path, "--out", tmp_path / "run", "--set", "execution.executor=serial")
    done = subprocess.run(
        command(*words), capture_output=True, text=True, timeout=400,
        env=environment(PYTHONPATH=BENCHMARKS), preexec_fn=limited,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "set00000" in done.stdout


@pytest.mark.slow
@pytest.mark.fault("many-members")
def test_memory_grows_with_the_members_not_with_their_square(tmp_path):
    """A matrix of 5000 members by 5000 has 200 MB; a run took several. The posterior is that of 500 members."""
    path = write_campaign(tmp_path, 1)
    peaks, spreads = [], []
    for members in (500, 5000):
        words = ("run", path, "--out", tmp_path / f"{members}", "--set", "execution.executor=serial")
        done = command(*words, "--set", f"assimilation.members={members}")
        peaks.append(measured(done)[1])
        with xr.open_dataset(tmp_path / f"{members}" / "posterior.nc", group="posterior") as posterior:
            spreads.append(posterior.std())
    assert peaks[1] - peaks[0] < 100, "MB"
    for name in "ab":  # exact sampling and a linear model: the same moments
        assert float(spreads[1][name]) == pytest.approx(float(spreads[0][name]), rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(  # one model is compiled in a second, the other in a quarter of a minute
    ("count", "config"), [(2, "predator_prey"), pytest.param(20, "quickstart", marks=pytest.mark.long)]
)
@pytest.mark.fault("first-starts")
def test_first_starts_at_once(tmp_path, count, config):
    assert start_together(tmp_path, count, config) == count


@pytest.mark.slow
@pytest.mark.fault("paths")
def test_names_in_any_script(tmp_path):
    folder = tmp_path / "Messung 50 % – ゲル"
    folder.mkdir()
    path = write_toy(folder, ("path: toy.csv", "path: Daten überall/*.csv")).rename(folder / "Näherung 1.yaml")
    (folder / "Daten überall").mkdir()
    for name in ("a b", "ゲル", "x'y"):
        (folder / "Daten überall" / f"{name}.csv").write_text(csv_text())
    done = run_cli("run", path, "--out", folder / "Läufe und mehr", "--no-report")
    assert done.returncode == 0, done.stderr
    assert {line.split("  ")[0] for line in done.stdout.splitlines()[1:]} >= {"ゲル", "a b"}
    done = run_cli("run", path, "--out", folder / "Läufe und mehr", "--no-report", "--resume")
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux")
@pytest.mark.fault("paths")
def test_names_that_are_not_text(tmp_path):
    path = make_campaign(tmp_path, 1)
    for name, text in ((b"g\xfcl.csv", csv_text()), (b"\xff.csv", "t_ms,x_um\n")):
        with open(os.fsencode(tmp_path / "data") + b"/" + name, "w") as file:
            file.write(text)
    campaign = run_campaign(configuration(path, tmp_path / "run", executor="serial"))
    assert {o.name for o in campaign.outcomes} == {"set0", "g\\udcfcl", "\\udcff"}
    (failed,) = campaign.failures
    assert "\\udcff.csv: " in failed.failure
    assert (tmp_path / "run" / "summary.csv").read_text(encoding="utf-8").count("\\udcff") == 2


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux")
def test_names_that_are_not_text_cannot_be_said_in_a_configuration(tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/g\xfcl.csv")
    with pytest.raises(ConfigError, match=r"^a byte that is not UTF-8, in the name of a file or folder perhaps"):
        load_config(write_toy(tmp_path), {"data.path": [path]})
    Path(path).write_text("t_us,R_um\n" + "".join(f"{t},{100 - t * t}\n" for t in range(9)))
    with pytest.raises(ConfigError, match=r"^a byte that is not UTF-8, in the name of a file or folder perhaps"):
        propose_config(path, time=("t_us", "us"), radius=("R_um", "um"))


@pytest.mark.parametrize(("name", "value"), [("NUMBA_DISABLE_JIT", "1"), ("SOURCE_DATE_EPOCH", "junk")])
@pytest.mark.fault("environment")
def test_an_environment_that_cannot_be_worked_in(tmp_path, name, value):
    done = run_cli("run", write_toy(tmp_path), "--out", tmp_path / "run", **{name: value})
    assert str(done.returncode) == row("environment").exit_code
    assert row("environment").told(done.stderr)
    assert name in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_output_that_is_closed(tmp_path, closed):
    words = shlex.join(command("run", write_toy(tmp_path), "--out", tmp_path / "run", "--no-report"))
    done = subprocess.run(["sh", "-c", f"{words} {closed}"], capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert (tmp_path / "run" / "posterior.nc").is_file()


@pytest.mark.fault("left-behind")
def test_what_a_killed_process_has_left_is_removed_by_the_next(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    theirs, ours = files.owner()[:-7] + f"{gone.pid:07d}", files.owner()
    left = [tmp_path / f".joint.csv.{theirs}.tmp", tmp_path / f"en4dvar-{theirs}-ab_1"]
    kept = [tmp_path / f".joint.csv.{ours}.tmp", tmp_path / "en4dvar-mine", tmp_path / ".mine.tmp"]
    for path in (*left, *kept):
        path.mkdir() if path.name.startswith("en4dvar") else path.touch()
    with files.temporary_folder(tmp_path):
        files.write_text(tmp_path / "a.csv", "")
    assert [path.name for path in left if path.exists()] == []
    assert [path.name for path in kept if not path.exists()] == []
