"""The diagnostic of shape: 1 for a Gaussian posterior, low where it bends or has heavy tails."""

import numpy as np
import pytest
from toys import Linear, make_problem

from en4dvar.diagnosis.diagnostics import gaussianity, is_non_gaussian
from en4dvar.diagnosis.honesty.checks import gaussian
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior
from en4dvar.schemes.settings import AssimilationSettings


def ensemble(n_members=48, n=3, seed=0):
    z = np.random.default_rng(seed).standard_normal((n_members, n))
    z -= z.mean(axis=0)
    return z @ np.linalg.inv(np.linalg.cholesky(np.cov(z.T)).T)


@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_linear_problems_are_gaussian(linearisation):
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    analysis = assimilate(problem, AssimilationSettings(linearisation=linearisation), 1)
    assert analysis.shape["gaussian_fit"] == pytest.approx(1, abs=1e-9)


def test_a_constant_in_j_and_units_do_not_matter():
    x = ensemble()
    costs = 0.5 * np.sum(x**2, axis=1) + 0.3 * x[:, 0] ** 3 / (1 + x[:, 0] ** 2)
    plain = gaussianity(x, np.zeros(3), costs)
    scale = np.array([1e-6, 1.0, 1e4])
    assert gaussianity(x * scale, np.zeros(3), costs + 1e3) == pytest.approx(plain, rel=1e-9)
    assert 0.3 < plain < 0.999


def test_a_curved_or_narrow_posterior_is_flagged():
    x = ensemble()
    banana = 0.5 * (x[:, 0] ** 2 + x[:, 2] ** 2) + 5 * (x[:, 1] - x[:, 0] ** 2) ** 2
    third = 4.5 * np.sum(x**2, axis=1)  # a third of the ensemble's spread in three directions
    for costs in (banana, third):
        shape = {"gaussian_fit": gaussianity(x, np.zeros(3), costs)}
        assert is_non_gaussian(shape)
        (finding,) = gaussian(Prior(()), x, shape)
        assert "far from Gaussian" in finding.words
    assert not [*gaussian(Prior(()), x, {"gaussian_fit": gaussianity(x, np.zeros(3), 0.5 * np.sum(x**2, axis=1))})]


def test_lost_members_have_no_weight_and_too_few_say_nothing():
    x = ensemble()
    costs = 0.5 * np.sum(x**2, axis=1)
    costs[:10] = np.inf
    assert gaussianity(x, np.zeros(3), costs) == pytest.approx(38 / 48)
    costs[4:] = np.inf
    fit = gaussianity(x, np.zeros(3), costs)
    assert np.isnan(fit)
    assert not is_non_gaussian({"gaussian_fit": fit})
