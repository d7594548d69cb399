"""Expected information of linear problems against the closed form, of others against brute force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys import Linear, Vectorised, Wave, make_observations

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.ensemble.forecast import Composite
from en4dvar.estimation.design.evaluate import SampleSizes, evaluate
from en4dvar.estimation.design.nested import nested
from en4dvar.estimation.design.planned import Planned, expected
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.priors.dependence import Dependence
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

CONFIGS = Path(__file__).parents[2] / "configs"
MEAN, STD = (0.5, -0.5, 0.2), (0.8, 1.2, 0.9)
CORRELATION = np.array([[1, 0.6, 0], [0.6, 1, -0.3], [0, -0.3, 1]])
CASES = [(0.03, (), True), (0.5, ("b",), False), (5.0, (), False), (0.5, (), False), (0.05, ("c", "a"), True)]


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


@pytest.mark.parametrize(
    ("std", "about", "correlated"), CASES[:1] + [pytest.param(*case, marks=pytest.mark.slow) for case in CASES[1:]]
)
def test_nested_sampling_of_the_closed_form(std, about, correlated):
    """0.02 nats from 1 to 12 nats, with an error that is stated: importance sampling is all that is left of it."""
    problem = _problem(std, correlated)
    planned = Planned(problem, about)
    found = nested(planned, planned.draws(60, 1), 200, 1)
    assert found.gain == pytest.approx(_exact(problem, about)[0], abs=0.02)
    assert found.error < 0.01
    assert abs(found.gain - _exact(problem, about)[0]) < 4 * found.error


def twisted(p, t):
    """Linear in (a, x), where x is b, …, g with two pairs rotated by angles that a third coordinate sets."""
    x = [p["a"], p["b"], p["c"], p["d"], p["e"], p["f"], p["g"]]
    for i, j, k in ((1, 2, 3), (4, 5, 6)):
        cos, sin = np.cos(0.3 * x[k]), np.sin(0.3 * x[k])
        x[i], x[j] = cos * x[i] - sin * x[j], sin * x[i] + cos * x[j]
    return sum(x[j] * np.cos(j * t + j**2 / 3) for j in range(7))


@pytest.mark.slow
def test_one_of_seven_parameters_of_a_bent_posterior():
    """A rotation by an angle of its own keeps N(0, I): the information about a is that of the linear problem."""
    t, std = np.linspace(0.1, 2.5, 6), 0.3
    model = FunctionModel(twisted, [Parameter(name, "1") for name in "abcdefg"], {"y": "1"})
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problem = InverseProblem(model, model.observables[0], make_observations(t, np.zeros(6), std=std), prior)
    planned, j = Planned(problem, ("a",)), np.arange(7)
    H = np.cos(t[:, None] * j + j**2 / 3)
    exact = -0.5 * np.log(np.linalg.inv(np.eye(7) + H.T @ H / std**2)[0, 0])
    found = nested(planned, planned.draws(60, 1), 200, 1)
    assert found.gain == pytest.approx(exact, abs=3 * found.error)
    assert found.error < 0.06
    assert found.thin == 0


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


def by_quadrature(values, log_prior, grid, truths, predicted, std):
    """Mean and standard deviation of the posterior's std of w and of the gain about it, over readings of ``truths``
    (R,) of w that are ``predicted`` (R, K): ``values`` (A,) of w, log masses (A, B) and predictions (A, B, K).
    """
    rng, numbers, of_prior = np.random.default_rng(0), [], np.logaddexp.reduce(log_prior, axis=1)
    for own, at in zip(truths, predicted, strict=True):
        y = at + std * rng.standard_normal(len(at))
        of_w = np.logaddexp.reduce(log_prior - 0.5 * np.sum(((y - grid) / std) ** 2, axis=2), axis=1)
        log = np.logaddexp.reduce(of_w)
        shares = np.exp(of_w - log)
        gain = np.interp(own, values, of_w - of_prior) - log
        numbers.append((np.sqrt(shares @ (values - shares @ values) ** 2), gain))
    return np.mean(numbers, axis=0), np.std(numbers, axis=0)


def masses(*axes):
    """Log masses (A, B) of N(0, 1) of two coordinates."""
    logs = -0.5 * np.square(axes[0])[:, None] - 0.5 * np.square(axes[1])
    return logs - np.logaddexp.reduce(logs, axis=None)


def sine(p, t):
    return np.sin(p["w"] * t + p["f"])


def decay(p, t):
    return p["f"] * np.exp(-p["w"] * t)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("curve", "mean", "prior_std", "std"),
    [(sine, (2.0, 0.0), (1.0, 0.3), 0.5), (sine, (2.0, 0.0), (1.0, 0.3), 0.1), (decay, (1.0, 1.0), (0.4, 1.0), 0.2)],
)
def test_what_would_be_known_where_readings_allow_several_minima(curve, mean, prior_std, std):
    """sin(ωt + φ), ω ± 50 %, and a decay whose size may be of either sign: by quadrature over 60 000 cells."""
    t = np.array([1.0, 2.5, 4.0, 5.0])
    model = FunctionModel(curve, [Parameter("w", "1"), Parameter("f", "1")], {"y": "1"})
    prior = Prior(tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(model.parameters, mean, prior_std, strict=True)))
    data = make_observations(t, np.zeros(4), std=std)
    problem = InverseProblem(model, model.observables[0], data, prior)
    (found,) = evaluate(problem, ["w"], SampleSizes(draws=200, simulated=100, inner=400), "nested", 1)

    z = np.linspace(-5.0, 5.0, 1001), np.linspace(-4.0, 4.0, 61)
    w, f = (m + s * of for m, s, of in zip(mean, prior_std, z, strict=True))
    grid = curve({"w": w[:, None, None], "f": f[:, None]}, t)
    own = np.array(mean) + np.array(prior_std) * np.random.default_rng(1).standard_normal((150, 2))
    predicted = curve({"w": own[:, :1], "f": own[:, 1:]}, t)
    expected, apart = by_quadrature(w, masses(*z), grid, own[:, 0], predicted, std)
    error = apart * np.hypot(1 / np.sqrt(150), 1 / np.sqrt(100))
    assert found.std[0] == pytest.approx(expected[0], abs=2 * error[0])
    assert found.gain == pytest.approx(expected[1], abs=2 * np.hypot(apart[1] / np.sqrt(150), found.error))
    assert found.ratio[0] == pytest.approx(found.std[0] / prior_std[0], rel=1e-9)
    if curve is sine:
        (tangent,) = evaluate(problem, ["w"], SampleSizes(), "laplace", 1)
        assert tangent.std[0] < 0.7 * found.std[0]


@pytest.mark.slow
def test_what_would_be_known_of_a_bubble():
    """G of a polytropic bubble with μ unknown, by quadrature over 201 × 201 runs and 600 sets of readings."""
    parameters = {
        "G": {"prior": "lognormal", "median": "2 kPa", "log_std": 0.8},
        "mu": {"prior": "lognormal", "median": "0.1 Pa s", "log_std": 0.5}, "R0": "0.5 um",
    }  # fmt: skip
    asked = {"model.law": "neo-hookean-kelvin-voigt", "model.gas": "polytropic", "data.error.radius_std": "6 um"}
    (problem,) = build(load_config(CONFIGS / "quickstart.yaml", {"parameters": parameters, **asked}))
    (found,) = evaluate(problem, ["G"], SampleSizes(draws=200, simulated=100, inner=200), "nested", 1)
    z = np.linspace(-4.0, 4.0, 201)
    cells = np.stack(np.meshgrid(z, z, indexing="ij"), axis=-1).reshape(-1, 2)
    x = problem.prior.from_white(np.vstack([cells, np.random.default_rng(1).standard_normal((600, 2))]))
    values, g = Composite(problem)(x).predictions, problem.prior.to_physical(x)[:, 0]
    grid, own = values[: len(cells)].reshape(201, 201, -1), slice(len(cells), None)
    expected, apart = by_quadrature(
        g[: len(cells) : 201], masses(z, z), grid, g[own], values[own], problem.observations.std
    )
    assert found.std[0] == pytest.approx(expected[0], abs=2 * apart[0] * np.hypot(1 / np.sqrt(600), 1 / np.sqrt(100)))
    assert found.gain == pytest.approx(expected[1], abs=2 * np.hypot(apart[1] / np.sqrt(600), found.error))


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
