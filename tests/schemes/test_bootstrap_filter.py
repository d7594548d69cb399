"""The bootstrap particle filter: its resampling, its kernel, and a posterior that is known."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.ensemble.linalg import centre, systematic
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout
from en4dvar.schemes.base import Evaluation, Weights
from en4dvar.schemes.bootstrap_filter import BootstrapFilter, likelihood_shares
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.sequential import CycleSeries, SequentialSettings, run_sequential
from en4dvar_lorenz import Linear
from en4dvar_lorenz.linear import LinearSettings


def draws(purpose, columns=None):
    return np.random.default_rng(sum(map(ord, purpose))).standard_normal((200, columns))


@pytest.mark.parametrize("start", [1e-12, 0.3, 1 - 1e-12])
def test_every_member_survives_as_often_as_its_share_says(start):
    shares = np.random.default_rng(0).dirichlet(np.full(50, 0.3))
    count = np.bincount(systematic(shares, 50, start), minlength=50)
    assert count.sum() == 50
    assert np.all(np.abs(count - 50 * shares) < 1 + 1e-9)


def test_shares_are_the_likelihoods():
    rng = np.random.default_rng(1)
    members, std, y = rng.standard_normal((200, 2)), np.array([0.5, 2.0]), np.array([0.7, -1.0])
    mean, x = centre(members)
    shares = likelihood_shares(Evaluation((y - mean) / std, (x / std).T))
    exact = np.exp(-0.5 * (((y - members) / std) ** 2).sum(axis=1))
    assert shares == pytest.approx(exact / exact.sum(), rel=1e-12)
    far = likelihood_shares(Evaluation((y + 1e4 - mean) / std, (x / std).T))
    assert np.isfinite(far).all()
    assert far.sum() == pytest.approx(1.0)


def test_without_jitter_members_are_those_that_survive():
    x = centre(np.random.default_rng(2).standard_normal((200, 1)))[1]
    step = BootstrapFilter(jitter=0).advance(Weights.prior(200), Evaluation(np.array([0.5]), x.T), 0, draws)
    moved = step.weights.rows @ x
    assert all(np.isclose(value, x[:, 0], atol=1e-13).any() for value in moved[:, 0])
    shares = likelihood_shares(Evaluation(np.array([0.5]), x.T))
    assert step.effective == pytest.approx(1 / np.sum(shares**2))


def test_jitter_keeps_mean_and_covariance():
    """On average they are those of the weighted members."""
    x = centre(np.random.default_rng(2).standard_normal((200, 3)))[1]
    e = Evaluation(np.array([0.4, 0.1]), x[:, :2].T)
    shares = likelihood_shares(e)
    spread = x - shares @ x
    exact = spread.T @ (shares[:, None] * spread)
    found, means = [], []
    for trial in range(40):
        rng = np.random.default_rng(trial)

        def draw(purpose, columns=None, rng=rng):
            return rng.standard_normal((200, columns))

        step = BootstrapFilter(jitter=0.7).advance(Weights.prior(200), e, 0, draw)
        found.append(np.cov((step.weights.T @ x).T))
        means.append(step.weights.w @ x)
    assert np.mean(means, axis=0) == pytest.approx(shares @ x, abs=0.02)
    assert np.mean(found, axis=0) == pytest.approx(exact, abs=0.04)


def linear_case(cycles, n, jitter):
    """A run of a linear model, and the Kalman filter's mean and standard deviation (K, 2)."""
    model, rng = Linear.from_settings(LinearSettings(oscillators=1)), np.random.default_rng(4)
    members = np.hstack([rng.standard_normal((n, 2)), np.full((n, 1), 0.1)])
    values = np.resize([[0.5, 0.2], [0.1, 0.6], [0.3, 0.4]], (cycles, 2))
    series = CycleSeries(0.3 * np.arange(1, cycles + 1), values, np.array([0.8, 0.9]))
    particles = run_sequential(model, model.observables, members, series, SequentialSettings(BootstrapFilter(jitter)))
    unit = np.hstack([np.eye(2), np.full((2, 1), 0.1)])
    m = np.array([model.step(row, 0.0, 0.3)[:2] for row in unit]).T
    mean, cov, exact = np.zeros(2), np.eye(2), []
    for value in values:
        mean, cov = m @ mean, m @ cov @ m.T
        gain = cov @ np.linalg.inv(cov + np.diag(series.std**2))
        mean, cov = mean + gain @ (value - mean), cov - gain @ cov
        exact.append((mean, np.sqrt(np.diag(cov))))
    return particles, *np.swapaxes(exact, 0, 1)


def test_the_posterior_of_a_linear_model_within_sampling_error():
    """Three cycles against the Kalman filter: means within 5 standard errors, spreads within 15 %."""
    particles, mean, std = linear_case(3, 1500, jitter=0.0)
    assert np.all(np.abs(particles.analysis.mean[:, :2] - mean) < 5 * std / np.sqrt(200))
    assert particles.analysis.std[:, :2] == pytest.approx(std, rel=0.15)
    assert np.all((particles.effective > 200) & (particles.effective < 1500))


@pytest.mark.parametrize("jitter", [0.2, 0.5])
def test_jitter_adds_no_spread_however_many_the_readings(jitter):
    """What does not forget its start, as a constant parameter, would keep what each of a hundred readings adds.

    Draws leave an error of some h √(100/3) / √N in the spread, 7 % at most.
    """
    particles, mean, std = linear_case(100, 1500, jitter)
    assert np.mean(particles.analysis.std[50:, :2] / std[50:]) == pytest.approx(1, abs=0.15)
    assert np.sqrt(np.mean(((particles.analysis.mean[50:, :2] - mean[50:]) / std[50:]) ** 2)) < 0.5


class Square(ForwardModel):
    """A constant c, and its square, which is read."""

    layout = StateLayout((Field("c"), Field("y")))
    observables = (Observable("y", "1", StateField("y")),)
    parameters, autonomous = (), True

    def initial_state(self, theta):
        return np.zeros(2)

    def step(self, x, t0, t1):
        return np.array([x[0], x[0] ** 2])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_two_modes_of_a_constant_stay_two_however_many_weak_readings(seed):
    """Members that are no copies need no kernel, which draws modes together as it keeps the spread of all."""
    rng = np.random.default_rng(seed)
    members = np.stack([rng.standard_normal(400), np.zeros(400)], axis=1)
    series = CycleSeries(np.arange(1.0, 151), 1.7 + 3 * rng.standard_normal((150, 1)), np.array([3.0]))
    run = run_sequential(Square(), Square.observables, members, series, SequentialSettings(BootstrapFilter()), seed)
    c = run.members[:, 0]
    assert 0.1 < np.mean(c > 0) < 0.9
    assert np.mean(np.abs(c) < 0.5) < 0.05


def test_no_localisation():
    local = BlockLocalisation([np.arange(2)], np.ones((1, 2)))
    with pytest.raises(ValueError, match="takes no localisation"):
        SequentialSettings(BootstrapFilter(), localisation=local)
