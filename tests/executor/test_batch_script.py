"""The batch script of docs/cluster.md, on this machine: ``srun`` starts as many copies of a program as it says."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from run_files import assert_same_results, configuration, environment, make_campaign

from en4dvar.cli import main
from en4dvar.runs.runner import run_campaign

PAGE = Path(__file__).resolve().parents[2] / "docs" / "cluster.md"
SRUN = '#!/bin/sh\nn=${1#--ntasks=}\nshift\nfor i in $(seq $n); do "$@" & done\nwait\n'


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups of POSIX")
def test_the_batch_script_computes_on_its_own_workers(tmp_path: Path) -> None:
    """The file of the scheduler of an earlier job lies there."""
    (script,) = re.findall(r"A batch script for SLURM:.*?```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    run_campaign(configuration(path := make_campaign(tmp_path, 2), tmp_path / "quiet", executor="serial"))
    path.rename(tmp_path / "campaign.yaml")
    (tmp_path / "scheduler.json").write_text('{"address": "tcp://127.0.0.1:9"}')
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "srun").write_text(SRUN)
    (programs / "en4dvar").write_text(f'#!/bin/sh\nexec {sys.executable} -m en4dvar.cli "$@"\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    script = script.replace("--ntasks=64", "--ntasks=1").replace("dask scheduler", "dask scheduler --port 0")
    found = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
    with (tmp_path / "job.log").open("w") as log:
        job = subprocess.Popen(
            ["bash", "-c", script.replace("--resume", "--resume --no-report")], cwd=tmp_path,
            env={**environment(), "PATH": found}, start_new_session=True, stdout=log, stderr=log,
        )  # fmt: skip
        try:
            code = job.wait(120)
        finally:
            os.killpg(job.pid, signal.SIGKILL)  # as SLURM ends the steps of a job
    assert code == 0, (tmp_path / "job.log").read_text()
    (run,) = (tmp_path / "runs").iterdir()
    assert "--scheduler tcp://" in (run / "run.log").read_text()
    assert_same_results(run, tmp_path / "quiet")


@pytest.mark.parametrize("option", ["--scheduler", "--data", "--out", "--out=", "--set"])
def test_what_a_script_leaves_empty_is_not_as_if_it_had_not_been_given(tmp_path: Path, option: str) -> None:
    done = CliRunner().invoke(main, ["run", str(make_campaign(tmp_path, 2)), option, *[""] * ("=" not in option)])
    assert done.exit_code == 2
    assert "nothing is given; is a variable of the shell not set" in done.stderr
