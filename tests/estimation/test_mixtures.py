"""Likelihoods as mixtures: a prior divided out, and marginals of linear problems in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from en4dvar.estimation.population.own import Mixture, log_marginal

STD = 0.3
RNG = np.random.default_rng(0)
H, Y, PRIOR_STD = RNG.standard_normal((4, 3)), RNG.standard_normal(4), np.array([0.5, 1.5, 0.7])
PRIOR_MEAN = np.array([0.4, -1.0, 0.2])


@pytest.fixture(scope="module")
def mixture():
    """Of the posterior of y = Hx + noise under N(PRIOR_MEAN, diag PRIOR_STD²), in units that make it the likelihood."""
    covariance = np.linalg.inv(np.diag(PRIOR_STD**-2.0) + H.T @ H / STD**2)
    mean = covariance @ (H.T @ Y / STD**2 + PRIOR_MEAN / PRIOR_STD**2)
    evidence = multivariate_normal(H @ PRIOR_MEAN, H @ np.diag(PRIOR_STD**2) @ H.T + STD**2 * np.eye(4)).logpdf(Y)
    shares = np.log([0.3, 0.7]) + evidence  # two components that are alike are one
    return Mixture.divided(np.tile(mean, (2, 1)), np.tile(covariance, (2, 1, 1)), shares, PRIOR_STD, PRIOR_MEAN)


def test_prior_divided_out_is_the_likelihood(mixture):
    x = np.array([0.4, -0.2, 0.9])
    logs = mixture.constant + mixture.linear @ x - 0.5 * np.einsum("i,sij,j->s", x, mixture.precision, x)
    assert np.logaddexp(*logs) == pytest.approx(multivariate_normal(H @ x, STD**2 * np.eye(4)).logpdf(Y), abs=1e-9)


def test_marginals_are_those_of_a_linear_problem(mixture):
    mean, variance = RNG.standard_normal((5, 3)), RNG.uniform(0.01, 3.0, (5, 3))
    exact = [
        multivariate_normal(H @ m, H @ np.diag(v) @ H.T + STD**2 * np.eye(4)).logpdf(Y)
        for m, v in zip(mean, variance, strict=True)
    ]
    inverse = np.einsum("bi,ij->bij", 1 / variance, np.eye(3))
    assert log_marginal(mixture, mean, inverse) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize(
    "far",
    [np.ones((3, 3)), np.zeros((3, 3)), np.full((3, 3), np.nan), -np.eye(3)],
    ids=["singular", "zero", "nan", "negative"],
)
def test_a_population_that_rounding_makes_no_density_of_explains_nothing(mixture, far):
    """Forty bubbles with wild readings ended in a division by zero, at a walker far out among what is common."""
    inverse = np.stack([np.eye(3), far])
    usual, none = log_marginal(mixture, np.zeros((2, 3)), inverse)
    assert np.isfinite(usual)
    assert none == -np.inf
