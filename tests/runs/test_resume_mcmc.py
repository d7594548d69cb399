"""``refine: mcmc``: a run killed while its Markov chain is under way goes on to the same bits."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
from run_files import assert_same_results, configuration, kill_after_writes, make_campaign, resumed_until_done, run_cli

from en4dvar.runs.interrupt import Interrupted
from en4dvar.runs.runner import run_campaign
from en4dvar.sampling import mcmc

REFINED = ("members: 8", "members: 8\n  refine: mcmc")


def make(folder: Path, sets: int) -> Path:
    path = make_campaign(folder, sets, "execution_models:Swift")
    text = path.read_text()
    assert REFINED[0] in text
    path.write_text(text.replace(*REFINED))
    return path


def test_interrupted_in_the_chain(tmp_path, monkeypatch):
    """At the second look: the runs of the chain are taken up, and it is told from the last of them on."""
    monkeypatch.setattr(mcmc, "BLOCK", 10)
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 40})
    path, out = make(tmp_path, 1), tmp_path / "run"
    run_campaign(configuration(path, tmp_path / "quiet"))

    sample, looks = mcmc.sample, []

    def stopped(*arguments, look, **options):
        def heard(record):
            look(record)
            looks.append(record.steps)
            if len(looks) == 2:
                raise KeyboardInterrupt

        return sample(*arguments, look=heard, **options)

    monkeypatch.setattr(mcmc, "sample", stopped)
    with pytest.raises(Interrupted):
        run_campaign(configuration(path, out))
    assert looks == [10, 20]
    run_campaign(configuration(path, out), resume=True)
    assert looks == [10, 20, 10, 20, 30, 40]
    log = (out / "run.log").read_text()
    assert re.findall(r"set0: chain, +(\d+) steps  R-hat", log) == ["10", "20", "20", "30", "40"]
    assert re.search(r"set0: continued after \d{3,4} forward runs", log)
    assert_same_results(out, tmp_path / "quiet")


def kill_and_resume(folder: Path, kills: int, seed: int) -> None:
    path = make(folder, 1)
    words = ("run", path, "--no-report", "--set", "execution.executor=serial", "--set", "execution.checkpoint_every=0")
    pause = {"EN4DVAR_TEST_PAUSE": 0.002}
    quiet = run_cli(*words, "--out", folder / "quiet", **pause)
    assert quiet.returncode == 0, quiet.stderr
    draw, done, finished = random.Random(seed), 0, 0
    while done < kills or finished == 0:
        out = folder / f"run{finished}"

        def attempt(resume: tuple[str, ...], out: Path = out) -> tuple[int, str]:
            writes, wait = draw.randint(1, 9), draw.uniform(0, 0.3)
            file = out / "checkpoints" / "set0.iteration"
            return kill_after_writes(file, writes, wait, *words, *resume, "--out", out, **pause)

        done += resumed_until_done(attempt)
        assert_same_results(out, folder / "quiet")
        finished += 1


@pytest.mark.slow  # test_resume_loop.py cuts a chain, too
def test_killed_and_resumed(tmp_path):
    """SIGKILL at a random moment."""
    kill_and_resume(tmp_path, 1, 1)


@pytest.mark.slow
@pytest.mark.long
def test_killed_at_20_random_moments(tmp_path):
    kill_and_resume(tmp_path, 20, 2)
