"""Expected information of linear problems against the closed form, of others against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from toys import Linear, Vectorised, Wave, make_observations

from en4dvar.estimation.design.evaluate import SampleSizes, evaluate
from en4dvar.estimation.design.laplace import expected
from en4dvar.estimation.design.nested import nested
from en4dvar.estimation.design.planned import Planned
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.priors.dependence import Dependence
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

MEAN, STD = (0.5, -0.5, 0.2), (0.8, 1.2, 0.9)
CORRELATION = np.array([[1, 0.6, 0], [0.6, 1, -0.3], [0, -0.3, 1]])
CASES = [(5.0, (), False), (0.5, (), False), (0.03, (), True), (0.5, ("b",), False), (0.05, ("c", "a"), True)]


def _problem(std=0.3, correlated=False, kind=Vectorised, names=("a", "b", "c"), count=8, **options):
    model, times = kind(names=names, **options), np.linspace(0.1, 2.5, count)
    terms = tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(model.parameters, MEAN, STD, strict=False))
    dependence = (Dependence(names, CORRELATION),) if correlated else ()
    data = make_observations(times, np.zeros(count), std=std)
    return InverseProblem(model, model.observables[0], data, Prior(terms, dependence))


def _exact(problem, about):
    """½ ln det of prior over posterior covariance of what is asked, and the ratio of their std."""
    times, j = problem.observations.times, np.arange(3)
    H, std = np.cos(times[:, None] * j + j**2 / 3), problem.observations.std[0]
    half = problem.prior.from_white_change(np.eye(3))
    B = half.T @ half
    P = np.linalg.inv(np.linalg.inv(B) + H.T @ H / std**2)
    a = [problem.prior.names.index(name) for name in about or problem.prior.names]
    gain = 0.5 * (np.linalg.slogdet(B[np.ix_(a, a)])[1] - np.linalg.slogdet(P[np.ix_(a, a)])[1])
    return gain, np.sqrt(np.diag(P)[a] / np.diag(B)[a])


def _linearised(planned, u):
    return expected(planned, planned.tangents(u), len(u))


@pytest.mark.parametrize(("std", "about", "correlated"), CASES)
def test_the_closed_form(std, about, correlated):
    problem = _problem(std, correlated)
    planned, (gain, ratio) = Planned(problem, about), _exact(problem, about)
    for u in (np.zeros((1, 3)), planned.draws(30, 1)):
        found = _linearised(planned, u)
        assert found.gain == pytest.approx(gain, abs=1e-8)
        np.testing.assert_allclose(found.std.mean(axis=0), ratio, rtol=1e-8)


@pytest.mark.parametrize(("std", "about", "correlated"), CASES)
def test_nested_sampling_of_the_closed_form(std, about, correlated):
    """0.02 nats from 1 to 12 nats, with an error that is stated: importance sampling is all that is left of it."""
    problem = _problem(std, correlated)
    planned = Planned(problem, about)
    found = nested(planned, planned.draws(60, 1), 200, 1)
    assert found.gain == pytest.approx(_exact(problem, about)[0], abs=0.02)
    assert found.error < 0.01
    assert abs(found.gain - _exact(problem, about)[0]) < 4 * found.error


@pytest.mark.slow
def test_the_stated_error_is_that_of_many_seeds():
    """Over 200 seeds the mean has no bias and deviations of the stated size."""
    problem = _problem(0.5)
    planned, (gain, _) = Planned(problem), _exact(problem, ())
    found = [nested(planned, planned.draws(20, seed), 50, seed) for seed in range(200)]
    z = np.array([(one.gain - gain) / one.error for one in found])
    assert abs(z.mean()) < 3.5 / np.sqrt(200)
    assert 0.8 < z.std() < 1.25


@pytest.mark.slow
def test_what_is_not_linear():
    """Brute force, ln p(y) from 30 000 draws of the prior that no reading came from: readings with several minima."""
    problem = _problem(0.5, kind=Wave, names=("a", "b"), count=6)
    planned = Planned(problem)
    found = nested(planned, planned.draws(150, 1), 400, 1)
    stream = np.random.default_rng(0)
    times, (a, b) = problem.observations.times, planned.control(stream.standard_normal((30_700, 2))).T
    predicted = a[:, None] * np.sin(3 * b[:, None] * times) + 0.2 * b[:, None] ** 2
    gains = []
    for truth in predicted[:700]:
        y = truth + 0.5 * stream.standard_normal(6)
        logs = -0.5 * np.sum(((y - predicted[700:]) / 0.5) ** 2, axis=1)
        own = -0.5 * np.sum(((y - truth) / 0.5) ** 2)
        gains.append(own - (np.log(np.mean(np.exp(logs - logs.max()))) + logs.max()))
    brute, error = np.mean(gains), np.std(gains) / np.sqrt(len(gains))
    assert abs(found.gain - brute) < 3 * np.hypot(error, found.error)
    assert _linearised(planned, planned.draws(300, 1)).gain > brute + 5 * error  # which is why there is another way


def sine(p, t):
    return np.sin(p["w"] * t + p["f"])


@pytest.mark.parametrize("std", [0.5, 0.1])
def test_what_would_be_known_where_readings_allow_several_minima(std):
    """sin(ωt + φ), ω ± 50 %: the posterior std by quadrature over 60 000 cells, for readings of its own."""
    t = np.array([1.0, 2.5, 4.0, 5.0])
    model = FunctionModel(sine, [Parameter("w", "1"), Parameter("f", "1")], {"y": "1"})
    prior = Prior(
        tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(model.parameters, (2.0, 0.0), (1.0, 0.3), strict=True))
    )
    data = make_observations(t, np.zeros(4), std=std)
    problem = InverseProblem(model, model.observables[0], data, prior)
    (found,) = evaluate(problem, ["w"], SampleSizes(draws=200, simulated=100, inner=400), "nested", 1)

    w, f = np.linspace(-3.0, 7.0, 1001), np.linspace(-1.2, 1.2, 61)
    grid = np.sin(w[:, None, None] * t + f[:, None])
    log_prior = -0.5 * ((w - 2.0)[:, None] ** 2 + (f / 0.3) ** 2)
    rng, stds = np.random.default_rng(0), []
    for _ in range(150):
        y = np.sin((2 + rng.standard_normal()) * t + 0.3 * rng.standard_normal()) + std * rng.standard_normal(4)
        log = log_prior - 0.5 * np.sum(((y - grid) / std) ** 2, axis=2)
        of_w = np.exp(log - log.max()).sum(axis=1)
        of_w /= of_w.sum()
        stds.append(np.sqrt(of_w @ (w - of_w @ w) ** 2))
    error = np.std(stds) * np.hypot(1 / np.sqrt(150), 1 / np.sqrt(100))
    assert found.std[0] == pytest.approx(np.mean(stds), abs=2 * error)
    assert found.ratio[0] == pytest.approx(found.std[0], rel=1e-9)  # the prior's is 1
    (tangent,) = evaluate(problem, ["w"], SampleSizes(), "laplace", 1)
    assert tangent.std[0] < 0.7 * found.std[0]


def test_experiments_alike_share_what_is_asked():
    """Two of them with a nuisance each are one problem of four parameters."""
    problem = _problem(0.5)
    planned = Planned(problem, ("a", "b"))
    u = planned.draws(30, 1)
    found = expected(planned, planned.tangents(u), 30, 2)
    times, j = problem.observations.times, np.arange(3)
    H = np.cos(times[:, None] * j + j**2 / 3) / 0.5
    both = np.zeros((2 * len(times), 4))
    both[: len(times), [0, 1, 2]], both[len(times) :, [0, 1, 3]] = H, H
    B = np.diag(np.square([*STD, STD[2]]))
    P = np.linalg.inv(np.linalg.inv(B) + both.T @ both)
    gain = 0.5 * (np.linalg.slogdet(B[:2, :2])[1] - np.linalg.slogdet(P[:2, :2])[1])
    assert found.gain == pytest.approx(gain, abs=1e-8)


def test_designs_are_compared_on_the_same_draws():
    fine, coarse = Planned(_problem(count=20)), Planned(_problem(count=5))
    np.testing.assert_array_equal(fine.draws(10, 3), coarse.draws(10, 3))
    np.testing.assert_array_equal(fine.draws(20, 3)[:10], fine.draws(10, 3))


@pytest.mark.parametrize(("about", "message"), [(("d",), "estimated are a, b, c"), (("a", "a"), "twice")])
def test_bad_questions(about, message):
    with pytest.raises(ConfigError, match=message):
        Planned(_problem(), about)


class Refusing(Linear):
    """Fails where its first parameter is positive, as for most of the prior."""

    def initial_state(self, theta):
        if theta["a"] > 0:
            raise ValueError("a is positive")
        return super().initial_state(theta)


def test_a_model_that_mostly_fails():
    planned = Planned(_problem(kind=Refusing))
    with pytest.raises(TooFewMembersError, match="of 40 draws of the prior"):
        _linearised(planned, planned.draws(40, 1))
