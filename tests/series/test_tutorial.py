"""The pages on a model of your own do what they say: its files are written and its commands run, in order."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.config import load_twin
from en4dvar.report.result import load_result

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / f"{name}.md").read_text("utf-8") for name in ("tutorial_own_forward_model", "own_model_further"))
FILES = dict(re.findall(r"```(?:python|yaml)\n# ([\w.]+)\n(.*?)```", PAGE, re.S))
COMMANDS = re.findall(r"^\$ en4dvar (.*)$", PAGE, re.M)
TRUTH = {"c": 0.1, "k": 4.0, "b": 3.0}


def test_the_tangent_is_that_of_the_runs():
    from tangent_duffing import TangentDuffing

    model, times = TangentDuffing(rtol=1e-11), np.arange(0.2, 4.0, 0.2)
    x = model.initial_state({"A": 1.0, "c": 0.1, "k": 4.0, "b": 3.0})
    directions = np.random.default_rng(0).standard_normal((3, 5))
    path, changes = model.tangent(x, directions, times)
    ahead, behind = ([p.states for p in model.trajectories(x + sign * 1e-5 * directions, times)] for sign in (1, -1))
    assert np.max(np.abs(changes - (np.array(ahead) - behind) / 2e-5)) < 1e-4 * np.max(np.abs(changes))
    assert np.max(np.abs(path.states - model.trajectories(x[None], times)[0].states)) < 1e-8


def test_the_function_in_jax(capsys):
    pytest.importorskip("jax")
    runpy.run_path("jax_cooling.py")
    assert "T_hot" in capsys.readouterr().out


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in FILES:
        sys.modules.pop(name.removesuffix(".py"), None)


def call(command):
    outcome = CliRunner().invoke(main, shlex.split(command))
    assert outcome.exit_code == 0, outcome.output
    return outcome.stdout


def test_every_block_is_used():
    assert set(FILES) == {
        "duffing.py",
        "duffing.yaml",
        "fast_duffing.py",
        "from_python.py",
        "twin.yaml",
        "sequence.py",
        "tangent_duffing.py",
        "jax_cooling.py",
    }
    assert [command.split()[0] for command in COMMANDS] == ["simulate", "validate", "run", "run", "sweep-twin"]


@pytest.mark.slow
def test_estimation_from_yaml(folder):
    for command in COMMANDS[:3]:
        call(command)
    rows = {row.name: row for row in load_result(folder / "runs" / "duffing").rows}
    for name, value in TRUTH.items():
        assert abs(rows[name].mean - value) < 3 * rows[name].std, name
        assert rows[name].std < 0.3 * rows[name].prior_std, name


def test_fast_path_gives_the_numbers_of_the_steps():
    fast, slow = (runpy.run_path(f"{name}.py") for name in ("fast_duffing", "duffing"))
    models = fast["FastDuffing"](), slow["Duffing"]()
    x = models[0].initial_states({"A": np.array([1.0, 0.5]), **{k: np.full(2, v) for k, v in TRUTH.items()}})
    times = np.array([0.2, 1.0, 4.0])
    a, b = (model.trajectories(x, times) for model in models)
    for one, other in zip(a, b, strict=True):
        assert one.states == pytest.approx(other.states, abs=1e-6)


def test_from_python(capsys):
    names = runpy.run_path("from_python.py")
    analysis = names["analysis"]
    assert analysis.converged
    std = analysis.posterior.std(axis=0, ddof=1)
    assert np.all(np.abs(analysis.posterior.mean(axis=0) - list(TRUTH.values())) < 3 * std)
    assert analysis.stop_reason in capsys.readouterr().out


def test_sequences(capsys):
    shown = call(COMMANDS[3])
    analysis = re.search(r"^analysis +(\S+)", shown, re.M)
    assert analysis
    assert float(analysis[1]) < 0.45
    assert load_twin("twin.yaml").experiment.members == 10
    names = runpy.run_path("sequence.py")
    assert names["ranks"].sum() == 300
    assert names["ranks"].max() < 120  # neither a heap at the ends nor in the middle
    assert np.std(names["innovations"]) > 1  # they hold the errors of the observations
    assert float(capsys.readouterr().out) < 0.6  # the observations err by 1
