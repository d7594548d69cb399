"""Posteriors that lean on the bound of a prior, against quadrature."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

import en4dvar
from en4dvar.diagnosis.diagnostics import SPREAD_OFF
from en4dvar.sampling.emulated_draws import EmulatedProposal
from en4dvar.sampling.refine import SHIFT

TIMES, ERROR = np.linspace(0.2, 4, 12), 0.5
SCORES = np.linspace(-7, 7, 4001)
PRIORS = {
    "half-normal": ({"prior": "half-normal", "std": 2}, stats.halfnorm(0, 2)),
    "uniform": ({"prior": "uniform", "lower": 0, "upper": 4}, stats.uniform(0, 4)),
    "beta": ({"prior": "beta", "lower": 0, "upper": 2, "alpha": 0.5, "beta": 0.5}, stats.beta(0.5, 0.5, 0, 2)),
    "normal cut below": ({"prior": "normal", "mean": 0.5, "std": 1, "lower": 0}, stats.truncnorm(-0.5, np.inf, 0.5, 1)),
}


def quadrature(named, cost):
    """Mean, standard deviation and evidence of k of this prior, of J_o ``cost`` of its values."""
    k = named.ppf(ndtr(SCORES))
    shares = np.exp(-0.5 * SCORES**2 - cost(k))
    evidence = np.sum(shares) * (SCORES[1] - SCORES[0]) / math.sqrt(2 * math.pi)
    mean = np.average(k, weights=shares)
    return mean, np.sqrt(np.average((k - mean) ** 2, weights=shares)), evidence


def estimated(function, y, prior, seed=1, error=ERROR, times=TIMES, **more):
    priors = {"a": {"prior": "normal", "mean": 0, "std": 1}, "k": prior}
    return en4dvar.estimate(function, (times, y), priors, error=error, seed=seed, progress=False, **more)


def line(p, t):
    return p["a"] + p["k"] * t


@pytest.mark.parametrize("truth", [0.05, pytest.param(0.2, marks=pytest.mark.slow), 0.4])
@pytest.mark.parametrize("name", PRIORS)
def test_near_a_bound_mean_spread_and_evidence_are_the_posteriors(name, truth):
    prior, named = PRIORS[name]
    y = line({"a": 0.3, "k": truth}, TIMES) + ERROR * np.random.default_rng(int(100 * truth)).standard_normal(12)
    joint = stats.multivariate_normal(np.zeros(12), np.ones((12, 12)) + ERROR**2 * np.eye(12))
    mean, std, evidence = quadrature(named, lambda k: -joint.logpdf(y - np.outer(k, TIMES)))
    found = estimated(line, y, prior)
    k = found.posterior["k"].values.ravel()
    assert k.mean() == pytest.approx(mean, abs=0.1 * std)
    assert k.std(ddof=1) == pytest.approx(std, rel=0.15)
    assert found.sample_stats.attrs["log_evidence"] == pytest.approx(math.log(evidence), abs=0.05)
    assert "non-gaussian" not in found.sample_stats.attrs["warning_codes"]


DECAYED = np.exp(-0.8 * TIMES) + 0.1 * np.random.default_rng(2).standard_normal(12)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("function", "times", "y", "low", "high"),
    [
        (lambda p, t: np.exp(-p["k"] * t), TIMES, DECAYED, 0.9, 3),
        (lambda p, t: p["k"] + 0 * t, np.array([1.0]), np.array([-0.1]), 0, 1),
    ],
    ids=["a decay", "a reading beyond the bound"],
)
def test_at_the_bound_of_a_uniform_prior_nothing_is_off_by_what_is_warned_of(function, times, y, low, high, seed):
    def cost(k):
        return 0.5 * np.sum((y - function({"k": k[:, None]}, times)) ** 2, axis=1) / 0.1**2

    mean, std, _ = quadrature(stats.uniform(low, high - low), cost)
    found = estimated(function, y, {"prior": "uniform", "lower": low, "upper": high}, seed, 0.1, times)
    k = found.posterior["k"].values.ravel()
    assert abs(k.mean() - mean) < SHIFT * std
    assert abs(k.std(ddof=1) / std - 1) < SPREAD_OFF


def test_far_from_its_bounds_a_prior_takes_no_draws(monkeypatch):
    monkeypatch.setattr(EmulatedProposal, "bridged_from", None)
    y = line({"a": 0.3, "k": 1.0}, TIMES)
    found = estimated(line, y, {"prior": "uniform", "lower": -30, "upper": 30})
    assert found.posterior["k"].values.mean() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_of_a_model_that_bends_there_the_better_ensemble_is_taken(seed):
    """No line in k says what k² does beside zero: the Gaussian in the score is nearer."""
    y = 0.25 * TIMES + 0.05 * np.random.default_rng(seed).standard_normal(12)
    found = estimated(lambda p, t: p["k"] ** 2 * t, y, {"prior": "half-normal", "std": 1}, seed, 0.05)
    assert found.posterior["k"].values.mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("seed", [0, pytest.param(4, marks=pytest.mark.slow)])
def test_ends_of_a_valley_that_is_bent_to_a_bound_are_those_of_quadrature(seed):
    """The valley a phi² = 1.5 was said to reach a = 5 or 19: lowest J was not found beside it."""
    times = np.linspace(0.2, 6, 15)
    y = 1.5 * times + 0.3 * np.random.default_rng(seed).standard_normal(15)
    scores, phi = np.linspace(-4, 4, 801), np.linspace(0, 1, 802)[1:-1]
    a = np.exp(0.3 * scores)
    cost = 0.5 * (y @ y - 2 * (of := a[:, None] * phi**2) * (y @ times) + of**2 * (times @ times)) / 0.09
    shares = np.sum(np.exp(-cost + cost.min() - 0.5 * scores[:, None] ** 2) * phi * (1 - phi), axis=1)
    ends = np.interp([0.05, 0.95], np.cumsum(shares) / shares.sum(), a)
    priors = {
        "a": {"prior": "lognormal", "median": 1, "log_std": 0.3},
        "phi": {"prior": "beta", "lower": 0, "upper": 1, "alpha": 2, "beta": 2},
    }
    found = en4dvar.estimate(
        lambda p, t: p["a"] * p["phi"] ** 2 * t, (times, y), priors, error=0.3, seed=1, progress=False
    )
    (row,) = (row for row in found.rows if row.name == "a")
    said = found.sample_stats.attrs
    told = [said.get("tail_q05_a", row.q05), said.get("tail_q95_a", row.q95)]
    assert told == pytest.approx(ends, abs=0.4 * row.std)


@pytest.mark.slow
@pytest.mark.parametrize("std", [1e-8, 1e-9])
def test_a_sum_known_to_more_digits_than_a_covariance_has_is_told(std):
    """As by the weight 1e9 of a control file: it ended in an error of linear algebra."""
    prior, settings = {"prior": "uniform", "lower": 0, "upper": 3}, {"members": 16, "refine": "none"}
    result = en4dvar.estimate(
        lambda p, t: p["a"] + p["b"] * t + 0 * p["c"], ([1.0], [2.5]), dict.fromkeys("abc", prior),
        error=std, assimilation=settings,
    )  # fmt: skip
    assert {"non-gaussian", "not-converged"} & set(result.sample_stats.attrs["warning_codes"].split())
