"""Models that give other numbers when a member is run again: told at the start, or accepted by a key."""

from dataclasses import replace

import numpy as np
import pytest
import toy_models
import twin_models
from faulty_models import Counts, Fails, Remembers
from rows import row
from run_files import configuration, run_cli
from toy_config import write_toy

from en4dvar import estimate
from en4dvar.assembly.build import build
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import ForwardModel
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.cycles import run_twin
from en4dvar.runs.rerun import rerun
from en4dvar.runs.runner import run
from en4dvar.schemes.filters import ETKF
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar.series.sequential import SequentialSettings
from en4dvar.series.start import InitialEnsemble
from en4dvar.series.twin import TwinExperiment, conduct

TWIN = """\
name: ring
model: {name: "test_varying_models:NoisyRing"}
twin: {cycles: 3, interval: 0.1, error: {x_std: 0.1}, initial_std: {x: 0.2, v: 0.2}}
assimilation: {scheme: etkf, members: 6}
"""
AGAIN = "the model gives other numbers when a member is run again"


@pytest.fixture(autouse=True)
def _as_at_the_start():
    Counts.runs, Remembers.last, Fails.runs = 0, 0.0, 0


def varying(folder, model, **assimilation):
    keys = "".join(f"{key}: {value}\n  " for key, value in assimilation.items())
    return write_toy(
        folder,
        ("toy_models:Oscillator", f"{'execution' if model == 'Noisy' else 'faulty'}_models:{model}"),
        ("members: 8", f"{keys}members: 8"),
    )


@pytest.mark.parametrize("executor", ["serial", "threads", "processes"])
@pytest.mark.parametrize("model", ["Noisy", "Counts", "Remembers"])
@pytest.mark.fault("model-varies")
def test_it_is_told_before_anything_is_estimated(tmp_path, model, executor):
    with pytest.raises(ConfigError) as told:
        run(configuration(varying(tmp_path, model), tmp_path / "run", executor=executor, workers=2))
    assert row("model-varies").told(str(told.value))
    assert "toy: the model gives" in str(told.value)
    assert "differs by up to" in str(told.value)
    assert "assimilation: {stochastic_model: true}" in str(told.value)
    assert not (tmp_path / "run" / "posterior.nc").exists()


class Mixed(toy_models.Oscillator):
    """All members of a batch have the start of its first one."""

    def trajectories(self, x, times):
        return super().trajectories(np.where(np.arange(x.shape[1]) == 0, x[0], x), times)


def test_a_model_that_mixes_members_is_told_as_such(tmp_path):
    path = write_toy(tmp_path, ("toy_models:Oscillator", "test_varying_models:Mixed"))
    with pytest.raises(ConfigError, match=r"toy: the model mixes the members of a batch: .* member 8 differs by up to"):
        run(configuration(path, tmp_path / "run", executor="serial"))


@pytest.mark.fault("model-varies")
def test_a_member_that_fails_the_second_time(tmp_path):
    with pytest.raises(ConfigError, match=rf"{AGAIN} \(member 8 fails the second time: ArithmeticError: not again\)"):
        run(configuration(varying(tmp_path, "Fails"), tmp_path / "run", executor="serial"))


@pytest.mark.fault("model-varies")
def test_it_can_be_accepted(tmp_path):
    path = varying(tmp_path, "Noisy", stochastic_model="true")
    assert "stochastic_model: true" in configuration(path, tmp_path / "run").resolved
    result = run(configuration(path, tmp_path / "run", executor="serial"))
    assert np.isfinite(result.posterior["k"]).all()
    assert not rerun(tmp_path / "run").same  # which is what was accepted


@pytest.mark.fault("model-varies")
@pytest.mark.parametrize("noise", [0.002, 0.007, 0.02])
def test_one_with_noise_of_its_own_is_estimated(noise):
    """A straight line read to 0.1, against the closed form: differences of runs that are close are all noise."""
    rng, t, prior = np.random.default_rng(0), np.linspace(0, 5, 9), {"prior": "normal", "mean": 1, "std": 1}
    y, slopes = 2 - 0.3 * t + 0.1 * rng.standard_normal(9), np.stack([np.ones(9), t], axis=1)
    covariance = np.linalg.inv(np.eye(2) + slopes.T @ slopes / 0.01)
    mean, std = covariance @ (1 + slopes.T @ y / 0.01), np.sqrt(np.diag(covariance))
    line = estimate(
        lambda p, t: p["a"] + p["b"] * t + noise * rng.standard_normal(9), (t, y), {"a": prior, "b": prior},
        error=0.1, seed=0, progress=False, assimilation={"stochastic_model": True},
    )  # fmt: skip
    assert [row.mean for row in line.rows] == pytest.approx(mean, abs=0.1 * std.min())
    assert [row.std for row in line.rows] == pytest.approx(std, rel=0.1)
    assert not any(row.untrusted for row in line.rows)
    assert not any("bundle" in c.advice for c in line.cautions)


@pytest.mark.fault("model-varies")
@pytest.mark.parametrize("linearisation", ["bundle", "tangent"])
def test_runs_that_are_close_are_refused_beside_it(tmp_path, linearisation):
    settings = AssimilationSettings(stochastic_model=True)
    assert settings.linearisation == "transform"
    with pytest.raises(ConfigError, match=r"linearisation: .* its noise instead of its slope; leave"):
        replace(settings, linearisation=linearisation)
    path = varying(tmp_path, "Noisy", stochastic_model="true", linearisation=linearisation)
    with pytest.raises(ConfigError, match=r"assimilation\.linearisation: .* its noise instead of its slope; leave"):
        run(configuration(path, tmp_path / "run", executor="serial"))


@pytest.mark.fault("model-varies")
@pytest.mark.slow
def test_the_command_line_ends_with_one_line(tmp_path):
    path = write_toy(tmp_path, ("toy_models:Oscillator", "execution_models:Noisy"))
    done = run_cli("run", path, "--out", tmp_path / "run", "--no-report")
    assert (done.returncode, done.stdout) == (2, "")
    assert AGAIN in done.stderr
    assert "Traceback" not in done.stderr


class Counted(Counts):
    """Counts its runs and is the same each time."""

    def initial_state(self, theta):
        type(self).runs += 1
        return super(Counts, self).initial_state(theta)


@pytest.mark.fault("model-varies")
def test_two_runs_more_and_the_same_numbers(tmp_path):
    """From Python; beside the 2 n by which ends are looked for, of a model that repeats itself alone."""
    config = configuration(write_toy(tmp_path), tmp_path / "run")
    (problem,) = build(config)
    problem = replace(problem, model=Counted.from_settings(config.model.Settings(mass="2 g")))
    runs = []
    for accepted in (False, True):
        Counted.runs = 0
        settings = replace(config.assimilation, linearisation="transform", stochastic_model=accepted)
        runs.append((assimilate(problem, settings, 3), Counted.runs))
    (checked, n_checked), (accepted, n_accepted) = runs
    assert n_checked == n_accepted + 2 + 4
    assert (checked.forward_runs, accepted.forward_runs) == (n_checked, n_accepted)
    assert np.array_equal(checked.posterior, accepted.posterior)


class NoisyRing(twin_models.Ring):
    def trajectories(self, x, times):
        return super().trajectories(x + 1e-6 * np.random.default_rng().standard_normal(x.shape), times)


class SteppingRing(twin_models.Ring):
    """Member by member, each a little off by the number of steps made."""

    steps = 0
    trajectories = ForwardModel.trajectories

    def step(self, x, t0, t1):
        type(self).steps += 1
        there = super().trajectories(x[None], np.array([t1 - t0])).states[0, 0]
        return there * (1 + 1e-12 * type(self).steps)


def twin(model, **more):
    return TwinExperiment(
        start=InitialEnsemble(model, {"x": 0.2, "v": 0.2}), sequential=SequentialSettings(ETKF(), **more), members=6,
        cycles=3, interval=0.1, error_std={"x": 0.1},
    )  # fmt: skip


@pytest.mark.parametrize("kind", [NoisyRing, SteppingRing], ids=["noise", "state"])
@pytest.mark.fault("model-varies")
def test_a_series(kind):
    with pytest.raises(ConfigError, match=AGAIN):
        conduct(twin(kind()), 1)
    result = conduct(twin(kind(), stochastic_model=True), 1)
    assert np.isfinite(result.run.members).all()


@pytest.mark.fault("model-varies")
def test_a_series_resumed_is_asked_again():
    states = []
    quiet = conduct(twin(twin_models.Ring()), 1, keep=lambda state: states.append(state()))
    again = conduct(twin(twin_models.Ring()), 1, resume=states[0])
    assert np.array_equal(again.run.members, quiet.run.members)
    assert again.run.forward_runs == quiet.run.forward_runs
    with pytest.raises(ConfigError, match=AGAIN):
        conduct(twin(NoisyRing()), 1, resume=states[0])


@pytest.mark.fault("model-varies")
def test_the_key_in_a_twin_file(tmp_path):
    path = tmp_path / "twin.yaml"
    path.write_text(TWIN)
    with pytest.raises(ConfigError, match=AGAIN):
        run_twin(path, overrides={"output.directory": str(tmp_path / "a"), "output.report": False})
    accepted = {
        "assimilation.stochastic_model": "true",
        "output.directory": str(tmp_path / "b"),
        "output.report": False,
    }
    assert run_twin(path, overrides=accepted).run.failures == ()
