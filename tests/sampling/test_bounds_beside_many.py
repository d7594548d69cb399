"""Posteriors that lean on the bound of a prior, beside many readings."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

import en4dvar
from en4dvar.data.noise import DecayingErrors, Predicted, joint_noise, noise_of
from en4dvar.data.observations import Observations
from en4dvar.sampling import near_bounds

COUNT = 2000
TIMES, STD = np.linspace(0.2, 4, COUNT), 0.5 * math.sqrt(COUNT / 12)
SCORES = np.linspace(-7, 7, 2001)


@pytest.mark.parametrize("correlated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_beside_many_readings_a_posterior_at_a_bound_is_told_as_beside_few(correlated):
    """Half-normal k of a line a + k t, a ~ N(0, 1): the Gaussian about the mode is 0.6 standard deviations off, and two
    fifths too wide.
    """
    apart = np.abs(np.subtract.outer(TIMES, TIMES))
    matrix = STD**2 * (np.exp(-apart / 0.002) if correlated else np.eye(COUNT))
    root = np.linalg.cholesky(matrix)
    y = 0.3 + 0.2 * TIMES + root @ np.random.default_rng(3).standard_normal(COUNT)
    named = stats.halfnorm(0, 2)
    k = named.ppf(ndtr(SCORES))
    white = np.linalg.solve(np.linalg.cholesky(matrix + 1), np.stack([y, TIMES], axis=1)).T
    squares = np.sum(white**2, axis=1), white[0] @ white[1]
    logs = -0.5 * (SCORES**2 + squares[0][1] * k**2) + squares[1] * k
    shares = np.exp(logs - logs.max())
    mean = np.average(k, weights=shares)
    std = np.sqrt(np.average((k - mean) ** 2, weights=shares))
    estimated = en4dvar.estimate(
        lambda p, t: p["a"] + p["k"] * t,
        (TIMES, y),
        {"a": {"prior": "normal", "mean": 0, "std": 1}, "k": {"prior": "half-normal", "std": 2}},
        error={"y_std": STD, "correlation_time": 0.002} if correlated else STD,
        seed=1,
        progress=False,
    )
    drawn = estimated.posterior["k"].values.ravel()
    assert drawn.mean() == pytest.approx(mean, abs=0.1 * std)
    assert drawn.std(ddof=1) == pytest.approx(std, rel=0.15)


NOISES = {
    "independent": noise_of(np.linspace(0.1, 0.3, 40)),
    "decaying": noise_of(np.full(40, 0.2), correlation=DecayingErrors(np.arange(40.0))),
    "two series": joint_noise([np.arange(20.0)] * 2, [noise_of(np.full(20, s)) for s in (0.1, 0.3)], np.eye(2)),
    "correlated series": joint_noise(
        [np.arange(20.0)] * 2, [noise_of(np.full(20, s)) for s in (0.1, 0.3)], np.array([[1.0, 0.6], [0.6, 1.0]])
    ),
}


@pytest.mark.parametrize("weight", [1.0, 1 / 40, 0.0])
@pytest.mark.parametrize("kind", NOISES)
def test_a_triangle_says_what_all_readings_do(kind, weight):
    random = np.random.default_rng(5)
    at, slopes, change = random.standard_normal(40), random.standard_normal((3, 40)), random.standard_normal((20, 3))
    sigma, y = np.append(random.uniform(0.3, 3, 19), 0.0), at + 0.2 * random.standard_normal(40)
    observations = Observations(np.arange(40.0), y, NOISES[kind], np.full(40, weight))
    of_readings = near_bounds._cost_of_readings(observations, Predicted(at), slopes)
    exact = observations.cost(Predicted(at + change @ slopes, noise_scale=sigma))
    assert exact[-1] == math.inf
    np.testing.assert_allclose(of_readings(change, sigma), exact, rtol=1e-9)
