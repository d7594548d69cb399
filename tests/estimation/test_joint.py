"""Joint estimates of linear experiments against the Kalman solution of all data stacked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import Decay, Fragile, Linear, Vectorised, Wave, make_observations, make_problem, with_discrepancy

from en4dvar.estimation.joint import estimate, members
from en4dvar.estimation.joint.descent import Arrow, Experiment, JointDescent, JointObjective, Place
from en4dvar.estimation.joint.problem import JointProblem, Single, sharing
from en4dvar.executor import SerialExecutor
from en4dvar.model.forward import Batch
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import Dependence
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.results.together import load_joint, save_joint
from en4dvar.schemes.settings import AssimilationSettings

MEAN, STD = np.array([0.5, -0.5, 0.2]), np.array([0.8, 1.2, 0.9])
SETTINGS = AssimilationSettings(what_if=False, emulator="off", refine="none")


def _terms(model):
    return tuple(PriorTerm.normal(p, float(m), float(s)) for p, m, s in zip(model.parameters, MEAN, STD, strict=True))


def _experiments(count=5, kind=Vectorised, **options):
    """``a`` is the same in all, ``b`` in those of even and of odd number, ``c`` is their own."""
    rng, found = np.random.default_rng(4), []
    model = kind(names=("a", "b", "c"), **options)
    for e in range(count):
        times = np.sort(rng.uniform(0.1, 2.5, 4 + e % 3))
        truth = np.array([0.3, (-1.0, 0.7)[e % 2], rng.standard_normal()])
        values = _design(times) @ truth + 0.3 * rng.standard_normal(len(times))
        data = make_observations(times, values, std=0.3, name=f"set {e}")
        found.append(InverseProblem(model, model.observables[0], data, Prior(_terms(model))))
    return found


def _design(times):
    j = np.arange(3)
    return np.cos(times[:, None] * j + j**2 / 3)


def _joint(problems):
    return JointProblem(tuple(problems), tuple({"a": "", "b": ("even", "odd")[e % 2]} for e in range(len(problems))))


def _exact(problems):
    """Mean and covariance of (a, b even, b odd, c of each), and ln p(y), from all data at once."""
    n = 3 + len(problems)
    rows, values = [], []
    for e, one in enumerate(problems):
        H = _design(one.observations.times)
        row = np.zeros((len(H), n))
        row[:, 0], row[:, 1 + e % 2], row[:, 3 + e] = H.T
        rows.append(row)
        values.append(one.observations.values)
    H, y = np.vstack(rows), np.concatenate(values)
    mean = np.concatenate([MEAN[[0, 1, 1]], np.full(len(problems), MEAN[2])])
    B = np.diag(np.concatenate([STD[[0, 1, 1]], np.full(len(problems), STD[2])]) ** 2)
    innovation = H @ B @ H.T + 0.09 * np.eye(len(y))
    gain = np.linalg.solve(innovation, H @ B).T
    residual = y - H @ mean
    evidence = -0.5 * (
        residual @ np.linalg.solve(innovation, residual) + np.linalg.slogdet(innovation)[1] + len(y) * np.log(2 * np.pi)
    )
    return mean + gain @ residual, B - gain @ H @ B, evidence


def _of_experiment(e):
    return [0, 1 + e % 2, 3 + e]


def test_the_stacked_kalman_solution():
    problems = _experiments()
    found = estimate.estimate_jointly(_joint(problems), SETTINGS, seed=3)
    mean, covariance, evidence = _exact(problems)
    np.testing.assert_allclose(found.shared_mode, mean[:3], rtol=0, atol=1e-10)
    for e in range(len(problems)):
        where, members = _of_experiment(e), found.control(e)
        np.testing.assert_allclose(members[-1], mean[where], rtol=0, atol=1e-10)
        np.testing.assert_allclose(members[:-1].mean(axis=0), mean[where], rtol=0, atol=1e-10)
        np.testing.assert_allclose(np.cov(members[:-1].T), covariance[np.ix_(where, where)], rtol=0, atol=1e-10)
    assert found.log_evidence == pytest.approx(evidence, abs=1e-9)
    assert found.converged
    assert not found.cautions


def test_members_of_two_experiments_correlate_only_through_what_they_share():
    """Of N = 2000 members: the covariance between own quantities is that of the posterior, up to N^-1/2."""
    problems = _experiments()
    found = estimate.estimate_jointly(_joint(problems), replace(SETTINGS, members=2000), seed=3)
    _, covariance, _ = _exact(problems)
    own = np.column_stack([found.control(e)[:-1, 2] for e in range(5)])
    scale = np.sqrt(np.diag(covariance)[3:])
    np.testing.assert_allclose(
        np.cov(own.T) / np.outer(scale, scale), covariance[3:, 3:] / np.outer(scale, scale), atol=0.08
    )


def test_the_order_of_the_experiments_does_not_matter():
    problems = _experiments()
    found = estimate.estimate_jointly(_joint(problems), SETTINGS, seed=3)
    order = [2, 0, 4, 1, 3]
    joint = _joint(problems)
    turned = JointProblem(tuple(problems[e] for e in order), tuple(joint.groups[e] for e in order))
    again = estimate.estimate_jointly(turned, SETTINGS, seed=3)
    assert turned.shared == joint.shared or sorted(turned.shared) == sorted(joint.shared)
    at = [turned.shared.index(key) for key in joint.shared]
    np.testing.assert_allclose(again.shared_mode[at], found.shared_mode, rtol=0, atol=1e-10)
    for place, e in enumerate(order):
        np.testing.assert_allclose(again.control(place)[-1], found.control(e)[-1], rtol=0, atol=1e-10)


def test_importance_gives_the_same_posterior_and_evidence():
    problems = _experiments(kind=Vectorised, compiled=True)
    found = estimate.estimate_jointly(_joint(problems), replace(SETTINGS, refine="auto", members=500), seed=3)
    mean, covariance, evidence = _exact(problems)
    assert found.members.effective > 50
    assert found.log_evidence == pytest.approx(evidence, abs=0.3)
    std = np.sqrt(np.diag(covariance))
    members = np.column_stack([found.shared, *(found.control(e)[:-1, 2] for e in range(5))])
    np.testing.assert_allclose((members.mean(axis=0) - mean) / std, 0, atol=0.35)
    np.testing.assert_allclose(members.std(axis=0) / std, 1, atol=0.3)


def test_more_draws_where_two_rounds_leave_too_few(monkeypatch):
    problems = _experiments(2, kind=Vectorised, compiled=True)
    monkeypatch.setattr(members, "ENOUGH", 2 * members.DRAWS + 1)
    told, settings = list[str](), replace(SETTINGS, refine="auto", members=500)
    found = estimate.estimate_jointly(_joint(problems), settings, seed=3, tell=told.append)
    assert found.members.effective > 2 * members.DRAWS
    assert "effective draws after 4 of at most 12 rounds, 193 are wanted" in told[-1]
    assert found.log_evidence == pytest.approx(_exact(problems)[2], abs=0.15)


@pytest.mark.parametrize("far", [1.0, 1e4])
def test_no_trial_moves_an_experiment_absurdly_far(far):
    """Readings 10^4 times as far off as the prior expects ask for steps to where models overflow."""
    problems = [
        replace(p, observations=replace(p.observations, values=far * p.observations.values)) for p in _experiments()
    ]
    joint, scheme = _joint(problems), SETTINGS.own.minimiser
    objective = JointObjective(joint, [Experiment(joint, e, 1e-3, SerialExecutor()) for e in range(5)], scheme)
    descent = JointDescent(Place(np.zeros(3), tuple(np.zeros(1) for _ in problems)))
    objective.linearise([descent])
    (first,) = next(objective.search(descent))
    longest = max(np.linalg.norm(joint.standard(e, first.border, first.own[e])) for e in range(5))
    assert longest == pytest.approx(40.0) if far > 1 else longest < 5


class Bent(Vectorised):
    """y = c + 0.8 (exp(a) − 1): given a shared a, a reading fixes c sharply, and not in a straight line."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        y = np.broadcast_to((x[:, 3] + 0.8 * np.expm1(x[:, 2]))[:, None], own.shape)
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, 2))
        states = np.concatenate([y[..., None], np.zeros((*own.shape, 1)), theta], axis=-1)
        return Batch(own, states, self.layout)


class Steep(Bent):
    """y = exp(c + 0.8 (exp(a) − 1)), so that steps in c from afar overshoot."""

    def trajectories(self, x, times):
        return [replace(t, states=np.exp(t.states)) for t in super().trajectories(x, times)]


@pytest.mark.parametrize("kind", [Bent, Steep])
def test_own_quantities_that_follow_what_is_shared_on_a_bent_line(kind):
    """Against the integral: p(a) ∝ N(a; 0, 1) Π_e N(y_e − 0.8 (exp(a) − 1); 0, 1), y_e or ln y_e the reading."""
    model, y = kind(names=("a", "c"), compiled=True), np.array([0.3, -0.4, 0.1])
    readings = y if kind is Bent else np.exp(y)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problems = [
        InverseProblem(
            model, model.observables[0], make_observations([1.0, 2.0, 3.0], [value] * 3, std=0.01, name=f"{e}"), prior
        )
        for e, value in enumerate(readings)
    ]
    settings = replace(SETTINGS, refine="auto", members=500)
    found = estimate.estimate_jointly(sharing(problems, ("a",)), settings, seed=3)
    a = np.linspace(-6, 4, 4001)
    density = np.exp(-0.5 * (a**2 + np.sum((y[:, None] - 0.8 * np.expm1(a)) ** 2, axis=0)))
    mean = (weights := density / density.sum()) @ a
    std = np.sqrt(weights @ (a - mean) ** 2)
    assert found.members.effective > 50
    assert abs(found.shared.mean() - mean) < 0.2 * std
    assert 0.85 < found.shared.std() / std < 1.15


def test_what_is_shared_on_a_bent_line_by_experiments_without_own_quantities():
    """Against the integral over (a, c): one straight proposal finds two thirds of the width of a."""
    model, y, std = Bent(names=("a", "c"), compiled=True), 0.3, 0.5
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    data = [make_observations([1.0, 2.0, 3.0], [y] * 3, std=std, name=f"{e}") for e in range(3)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], ("a", "c"))
    a, c = np.linspace(-5, 4, 901)[:, None], np.linspace(-5, 5, 1001)
    density = np.exp(-0.5 * (a**2 + c**2 + 9 * ((y - c - 0.8 * np.expm1(a)) / std) ** 2)).sum(axis=1)
    weights = density / density.sum()
    exact = np.sqrt(weights @ (a[:, 0] - weights @ a[:, 0]) ** 2)
    settings = replace(SETTINGS, refine="auto", members=500)
    found = [estimate.estimate_jointly(joint, settings, seed).shared[:, 0].std() for seed in (4, 5)]
    assert 0.8 < np.mean(found) / exact < 1.1


class Phase(Bent):
    """y = sin(t + 6 (c + 0.8 (exp(a) − 1))): a period of c off, the readings are as well explained."""

    def trajectories(self, x, times):
        return [replace(t, states=np.sin(t.times[:, None] + 6 * t.states)) for t in super().trajectories(x, times)]


def test_descents_that_start_where_single_estimates_disagree_end_in_one_minimum():
    """Each single estimate has its own a, and the c that explains its readings with it, beside the minimum over a."""
    model, y, std = Phase(names=("a", "c"), compiled=True), np.array([0.3, -0.4, 0.1, -0.2]), 0.01
    prior, t = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters)), np.array([1.0, 2.0, 3.0])
    problems, singles = [], []
    for value, a in zip(y, (-1.5, 0.5, 1.0, -0.7), strict=True):
        data = make_observations(t, np.sin(t + 6 * value), std=std, name=f"{value}")
        problems.append(InverseProblem(model, model.observables[0], data, prior))
        slope = 6 * np.cos(t + 6 * value)[:, None] * [0.8 * np.exp(a), 1.0] / std
        singles.append(Single(np.array([a, value - 0.8 * np.expm1(a)]), np.eye(2) + slope.T @ slope))
    found = estimate.estimate_jointly(sharing(problems, ("a",)), SETTINGS, seed=3, singles=singles)
    a = np.linspace(-2, 2, 4001)
    lowest = (0.5 * (a**2 + np.sum((y[:, None] - 0.8 * np.expm1(a)) ** 2, axis=0))).min()
    assert found.costs[-1] == pytest.approx(lowest, abs=1e-3)
    assert "starts-disagree" not in {c.code for c in found.cautions}


class Rounded(Vectorised):
    """y = a t + c²."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        y = x[:, 2, None] * own + x[:, 3, None] ** 2
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, 2))
        states = np.concatenate([y[..., None], np.zeros((*own.shape, 1)), theta], axis=-1)
        return Batch(own, states, self.layout)


@pytest.mark.slow
def test_own_quantities_of_two_minima_that_both_count():
    """Against the integral: the curvature where J is lowest tells of one of ±c, and the draws find the other."""
    model, t, std = Rounded(names=("a", "c"), compiled=True), np.array([1.0, 2.0, 3.0]), 0.3
    prior, y = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters)), 0.5 * t + 0.7
    data = [make_observations(t, y, std=std, name=f"{e}") for e in range(8)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], ("a",))
    a, c = np.linspace(-2, 2, 801)[:, None], np.linspace(-4, 4, 2001)
    misfit = sum((value - a * at - c**2) ** 2 for at, value in zip(t, y, strict=True)) / std**2
    own = np.exp(-0.5 * (c**2 + misfit)).sum(axis=1) * (c[1] - c[0]) / np.sqrt(2 * np.pi)
    density = np.exp(-0.5 * a[:, 0] ** 2 + 8 * np.log(own)) * 0.005 / np.sqrt(2 * np.pi)
    exact = np.log(density.sum()) - 8 * 3 * np.log(std * np.sqrt(2 * np.pi))
    settings = replace(SETTINGS, refine="auto", members=96)
    found = estimate.estimate_jointly(joint, settings, seed=2)
    assert found.members.effective >= members.ENOUGH
    assert found.log_evidence == pytest.approx(exact, abs=0.7)
    np.testing.assert_allclose([np.mean(found.control(e)[:-1, 1] < 0) for e in range(8)], 0.5, atol=0.25)


class Decaying(Vectorised):
    """y = a exp(−G c t) of the logarithms of G, a and c in units of 1.5, 0.3 and 0.25."""

    @staticmethod
    def of(G, a, c, t):
        return np.exp(0.3 * a - np.exp(1.5 * G + 0.25 * c) * t)

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        y = self.of(*x[:, 2:].T[..., None], own)
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, 3))
        states = np.concatenate([y[..., None], np.zeros((*own.shape, 1)), theta], axis=-1)
        return Batch(own, states, self.layout)


@pytest.mark.slow
def test_a_tail_that_the_first_draws_do_not_reach():
    """Quantiles of a shared G of 24 seeds against the integral over a grid; the curvature of J tells too narrow a G."""
    model, rng = Decaying(names=("G", "a", "c"), compiled=True), np.random.default_rng(14)
    times, std = np.linspace(0.1, 2, 6), 0.5
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    truth, readings = 0.7 * rng.standard_normal(), []
    for _ in range(2):
        a, c = rng.standard_normal(2)
        readings.append(model.of(truth, a, c, times) + std * rng.standard_normal(6))
    G, own = np.linspace(-5, 5, 201), np.linspace(-5, 5, 61)
    a, c = own[:, None, None], own[:, None]
    log_p = -0.5 * G**2
    for y in readings:
        misfit = sum((reading - model.of(G, a, c, t)) ** 2 for reading, t in zip(y, times, strict=True)) / std**2
        log_p += np.log(np.exp(-0.5 * (a**2 + c**2 + misfit)).sum(axis=(0, 1)))
    shares = np.exp(log_p - log_p.max()) / np.exp(log_p - log_p.max()).sum()
    exact = np.interp((0.05, 0.5, 0.95), np.cumsum(shares) - 0.5 * shares, G)
    spread = np.sqrt(shares @ (G - shares @ G) ** 2)
    data = [make_observations(times, y, std=std, name=f"{e}") for e, y in enumerate(readings)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], ("G",))
    settings = replace(SETTINGS, refine="auto", members=500)
    drawn = [estimate.estimate_jointly(joint, settings, seed).shared[:, 0] for seed in range(24)]
    off = (np.quantile(drawn, (0.05, 0.5, 0.95), axis=1).T - exact) / spread
    np.testing.assert_allclose(off.mean(axis=0), 0, atol=0.12)
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.3


class Folded(Vectorised):
    """y = a t + c² + 0.1 c t: both signs of c are minima, one of them the lower."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        a, c = x[:, 2, None], x[:, 3, None]
        y = a * own + c**2 + 0.1 * c * own
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, 2))
        states = np.concatenate([y[..., None], np.zeros((*own.shape, 1)), theta], axis=-1)
        return Batch(own, states, self.layout)


def test_an_experiment_in_the_wrong_minimum_of_its_own_is_found():
    """All singles say c = −1; of the first experiment it is +1, which the shared a of the others decides."""
    model = Folded(names=("a", "c"), compiled=True)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    t, truths = np.array([1.0, 2.0, 3.0]), (1.0, *[-1.0] * 7)
    problems = [
        InverseProblem(
            model, model.observables[0], make_observations(t, 0.5 * t + 1 + 0.1 * c * t, std=0.02, name=f"{e}"), prior
        )
        for e, c in enumerate(truths)
    ]
    singles = [Single(np.array([0.5, -1.0]), np.diag([100.0, 100.0])) for _ in problems]
    found = estimate.estimate_jointly(sharing(problems, ("a",)), SETTINGS, seed=3, singles=singles)
    np.testing.assert_allclose([found.control(e)[-1, 1] for e in range(8)], truths, atol=0.1)
    assert found.chi2.max() < 1


def test_descents_that_end_in_different_minima_are_told():
    """All share c, of both signs; one single estimate says +1, where J is lower, and all others −1."""
    model, t = Folded(names=("a", "c"), compiled=True), np.array([1.0, 2.0, 3.0])
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    data = [make_observations(t, 0.5 * t + 1 + 0.1 * t, std=0.02, name=f"{e}") for e in range(8)]
    singles = [Single(np.array([0.6 - 0.1 * c, c]), np.diag([100.0, 100.0])) for c in (1.0, *[-1.0] * 7)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], ("c",))
    found = estimate.estimate_jointly(joint, SETTINGS, seed=3, singles=singles)
    np.testing.assert_allclose(found.shared_mode, 1.0, atol=0.1)
    assert "starts-disagree" in {c.code for c in found.cautions}


def test_advice_names_nothing_that_a_joint_estimate_does_not_read(monkeypatch):
    """It has no chain, and chooses its starts itself."""
    monkeypatch.setattr(members, "FEWEST", np.inf)
    monkeypatch.setattr(estimate, "_agreeing", lambda descents: 1)
    problems = _experiments(2, kind=Vectorised, compiled=True)
    settings = replace(SETTINGS, refine="auto", members=24)
    found = estimate.estimate_jointly(_joint(problems), settings, seed=3)
    assert {c.code for c in found.cautions} >= {"non-gaussian", "starts-disagree"}
    assert not [c.advice for c in found.cautions if "refine" in c.advice or "starts" in c.advice]


def test_a_member_of_any_experiment_may_fail():
    problems = _experiments()
    limit = estimate.estimate_jointly(_joint(problems), SETTINGS, seed=3).shared[:, 0]
    limit = float(np.quantile(limit, 0.9))
    problems[2] = replace(problems[2], model=Fragile(limit, names=("a", "b", "c")))
    found = estimate.estimate_jointly(_joint(problems), SETTINGS, seed=3)
    assert 24 < len(found.shared) < 48
    assert all(run.active.tolist() == [True] * (len(found.shared) + 1) for run in found.forecasts)
    words = "of 48 members failed in the forecast of the joint posterior: too stiff"
    assert any(words in c.words for c in found.cautions)
    np.testing.assert_allclose(found.shared_mode, _exact(problems)[0][:3], atol=1e-10)


def test_own_models_and_windows():
    """A nonlinear experiment beside a linear one, against the minimum that scipy finds of all of J."""
    from scipy.optimize import minimize

    linear, decay = Linear(names=("a", "b")), Decay(names=("a", "b"))
    rng, problems = np.random.default_rng(1), []
    for name, model in (("linear", linear), ("decay", decay)):
        times = np.linspace(0.1, 1.5, 7 if name == "linear" else 12)
        curve = np.array([model.curve(np.array([1.0, 0.8]), t) for t in times])
        data = make_observations(times, curve + 0.05 * rng.standard_normal(len(times)), std=0.05, name=name)
        terms = tuple(PriorTerm.normal(p, 0.7, 0.5) for p in model.parameters)
        problems.append(InverseProblem(model, model.observables[0], data, Prior(terms)))
    found = estimate.estimate_jointly(sharing(problems, ["b"]), SETTINGS, seed=1)

    def J(x):
        total = 0.5 * np.sum(((x - 0.7) / 0.5) ** 2)
        for one, a in zip(problems, x[1:], strict=True):
            curve = [one.model.curve(np.array([a, x[0]]), t) for t in one.observations.times]
            total += 0.5 * np.sum(((one.observations.values - curve) / 0.05) ** 2)
        return total

    best = minimize(J, [0.7, 0.7, 0.7], method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(found.shared_mode[0], best.x[0], atol=2e-5)
    assert found.costs[-1] == pytest.approx(best.fun, abs=1e-6)


def test_the_arrow_is_the_dense_matrix():
    rng = np.random.default_rng(2)
    sizes = (2, 0, 3)
    n = 2 + sum(sizes)
    root = rng.standard_normal((n, n))
    dense = root @ root.T + n * np.eye(n)
    starts = 2 + np.concatenate([[0], np.cumsum(sizes)])
    for a, b in ((0, 2), (0, 1)):  # no entry between different experiments
        dense[starts[a] : starts[a + 1], starts[b] : starts[b + 1]] = 0
        dense[starts[b] : starts[b + 1], starts[a] : starts[a + 1]] = 0
    own = [slice(starts[e], starts[e + 1]) for e in range(3)]
    arrow = Arrow(dense[:2, :2], [dense[:2, s] for s in own], [dense[s, s] for s in own])
    right = rng.standard_normal(n)
    x, y = arrow.solve(right[:2], [right[s] for s in own])
    np.testing.assert_allclose(np.concatenate([x, *y]), np.linalg.solve(dense, right), rtol=1e-11)
    assert arrow.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)


def test_the_gradient_is_right_where_readings_are_exact():
    """Steps that are many posterior standard deviations long feel a bent model; the Hessian tells shorter ones."""
    model, times = Wave(), np.linspace(0.1, 2.0, 9)
    curve = np.array([model.curve([1.5, 1.2], t) for t in times])
    data = make_observations(times, curve + 0.3 * np.cos(7 * times), std=1e-4)
    terms = tuple(PriorTerm.normal(p, 1.3, 0.5) for p in model.parameters)
    joint = JointProblem(
        (InverseProblem(model, model.observables[0], data, Prior(terms)),), ({terms[0].parameter.name: ""},)
    )
    experiment, z = Experiment(joint, 0, 1e-3, SerialExecutor()), np.array([0.4, -0.2])
    first = experiment.linearise(z)
    again = experiment.linearise(z, hessian=first.hessian)
    h = 1e-6 * np.eye(2)
    exact = (experiment.costs(z + h) - experiment.costs(z - h)) / 2e-6

    def off(form):  # in posterior standard deviations
        wrong = form.gradient - exact
        return np.sqrt(wrong @ np.linalg.solve(first.hessian, wrong))

    assert off(again) < 0.05 * off(first)


def correlated(problem):
    """Its first two parameters are."""
    block = Dependence(problem.prior.names[:2], np.array([[1.0, 0.5], [0.5, 1.0]]))
    return replace(problem, prior=replace(problem.prior, blocks=(block,)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: sharing(p[:1], ["a"]), "at least two"),
        (lambda p: sharing(p, []), "at least one"),
        (
            lambda p: sharing([correlated(p[0]), *p[1:]], ["a"]),
            "set 0: a joint estimate needs priors",
        ),
        (lambda p: sharing(p, ["d"]), "d: cannot be shared, for no two data sets"),
        (lambda p: JointProblem(tuple(p), ({"d": ""}, {})), "set 0: d: shared, but not estimated there"),
        (lambda p: sharing([p[0], p[0]], ["a"]), "set 0 twice"),
        (
            lambda p: sharing([p[0], replace(p[1], prior=_wider(p[1].prior))], ["a"]),
            r"a: its prior must be the same .*one configuration",
        ),
    ],
)
def test_what_cannot_be_shared(change, message):
    with pytest.raises(ConfigError, match=message):
        change(_experiments(2))


def _wider(prior):
    first, *rest = prior.terms
    return Prior((PriorTerm.normal(first.parameter, first.mean, 2 * first.std), *rest))


def test_a_model_is_asked_for_the_observations_alone_unless_more_is_free(tmp_path):
    problems = _experiments(count=2)
    dense = Vectorised(names=("a", "b", "c"), compiled=True)
    problems[1] = replace(problems[1], model=dense, observable=dense.observables[0])
    found = estimate.estimate_jointly(_joint(problems), SETTINGS, seed=3)
    np.testing.assert_array_equal(found.grids[0], problems[0].observations.times)
    np.testing.assert_allclose(found.forecasts[0].path, found.forecasts[0].predictions, rtol=0, atol=0)
    assert found.grids[1].shape == (200,)
    save_joint(tmp_path / "joint.nc", found, [np.zeros((3, 3))] * 2, {})
    band = load_joint(tmp_path / "joint.nc").group("fit")["band"].values
    assert np.isfinite(band[0]).all(axis=1).sum() == len(problems[0].observations)
    assert np.isfinite(band[1]).all()


def test_a_step_to_where_the_size_of_a_discrepancy_overflows_is_halved():
    """Far from the readings Gauss and Newton ask for a discrepancy of exp(10^4): J is infinite there, and so told."""
    problem = with_discrepancy(make_problem(Vectorised(names=("a", "b")), (1.0, 0.5), std=1e-3), length=(0.3, 0.7))
    joint = JointProblem((problem,), ({"a": ""},))
    experiment, border = Experiment(joint, 0, 1e-3, SerialExecutor()), np.array([[4.0], [-3.0]])
    start = np.zeros((2, 3))
    start[:, 1] = -8.0  # the discrepancy
    mean, precision, lowest = experiment.settled(border, start, np.tile(np.eye(3), (2, 1, 1)), 12)
    assert np.isfinite(lowest).all()
    assert np.isfinite(mean).all()
    assert np.linalg.eigvalsh(precision).min() >= 1 - 1e-9
    assert (experiment.linearise_own(np.full((1, 4), 600.0), [1, 2, 3])[0] == np.inf).all()
