"""The economical tangent, the bent line search, and several starts."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from toys import Closed, Decay, Toy, Wave, assert_cost_by_definition, make_problem, visit

from en4dvar.descent.step_control import LONGEST, Point, Tangent, Trials, acceleration, line_search, run_searches
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis.analysis import IterationRecord
from en4dvar.ensemble.linalg import Hessian
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import PriorTerm
from en4dvar.schemes.base import GaussNewtonStep
from en4dvar.schemes.settings import AssimilationSettings


def where_one_of_the_few_fails(space, at):
    """The same place, had the model said that the first of the few runs failed."""
    run = space.composite
    few = len(at.at.members) + 1

    def first_lost(x, times):
        found = run(x, times)
        return replace(found, failures=("lost", *found.failures[1:])) if len(x) == few else found

    space.composite = first_lost
    again = visit(space, at.weights.w)
    space.composite = run
    return again


@pytest.mark.parametrize("time_std", [0.0, 0.05])
def test_tangent_of_few_runs_is_the_bundle_of_all_members(time_std):
    problem = make_problem(Decay(), [1.5, 1.2], time_std=time_std)
    steps = []
    for members in (12, 4):  # at N = n + 2 the whole bundle is as cheap, and is run
        for epsilon in (1e-3, 1e-4):
            space = WeightSpace(problem, AssimilationSettings(members=members, epsilon=epsilon), 1, SerialExecutor())
            scheme = space.scheme
            assert scheme.economical(space.basis)
            w = space.basis @ np.array([0.1, -0.2])
            at, whole = (visit(space, w) for _ in range(2))
            rows = scheme.members(at.weights)
            full = where_one_of_the_few_fails(space, at)
            assert len(full.at.members.failures) == len(rows) == members
            steps.append(np.linalg.norm(at.step.direction - full.step.direction) / np.linalg.norm(full.step.direction))
            assert np.array_equal(at.step.direction, whole.step.direction)
    assert max(steps[::2]) < 5e-3
    assert np.allclose(np.array(steps[::2]) / steps[1::2], 10, rtol=0.05)  # first order in ε


def test_no_economy_where_the_members_span_no_more_than_their_number():
    problem = make_problem(Decay(), [1.5, 1.2])
    for settings in (AssimilationSettings(members=3), AssimilationSettings(members=12, linearisation="transform")):
        basis = WeightSpace(problem, settings, 1, SerialExecutor()).basis
        assert not settings.own.economical(basis)


def test_the_sampled_prior_of_many_members_takes_no_square_of_them():
    """Weights of 3000 control vectors would have 72 MB; J_b by the members' own mean and covariance."""
    problem, count = make_problem(Decay(), [1.5, 1.2]), 3000
    space = WeightSpace(problem, AssimilationSettings(members=count), 1, SerialExecutor())
    x = 0.9 * space.members
    of_prior = problem.prior.cost(x)
    tracemalloc.start()
    costs = space.with_sampled_prior(x, of_prior)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    off = x - space.mean
    exact = 0.5 * np.sum(off @ np.linalg.inv(np.cov(space.members.T)) * off, axis=1)
    np.testing.assert_allclose(costs, exact, rtol=1e-8, atol=1e-8)
    assert peak < count**2  # bytes


class Bend(Closed):
    """y_k = a + (k-th power) curvature: a valley b = c a² that only a bent step follows; ``width`` is its width."""

    width, of_arrays = 0.01, True

    def curve(self, theta, t):
        a, b = theta
        return np.where(t < 1.0, a, (b - a * a) / self.width)

    def rate(self, theta, t):
        return 0.0 * theta[0] * t


def test_bent_steps_follow_a_curved_valley():
    problem = make_problem(Bend(), [1.0, 1.0], std=0.1, k=8)
    settings = AssimilationSettings(members=12, starts=1, start="prior-mean")
    line = assimilate(problem, settings, 1)
    assert line.converged
    assert_cost_by_definition(line)
    straight = assimilate(problem, replace(settings, step_control="levenberg-marquardt"), 1)
    assert line.iterations[-1].cost <= straight.iterations[-1].cost + 1e-3
    assert len(line.iterations) < len(straight.iterations)
    assert line.forward_runs < straight.forward_runs


def test_acceleration_is_exact_for_a_parabola():
    """m(w) = S w + ½ q (v·w)²: the correction solves the normal equations of the curvature."""
    rng = np.random.default_rng(1)
    y, q = rng.standard_normal((4, 6)), rng.standard_normal(6)  # N = 4 weights, K = 6
    scale = rng.uniform(0.5, 2, 6)
    hessian = Hessian.of((y * scale).T)
    gradient = rng.standard_normal(4)
    step = GaussNewtonStep(np.zeros(4), gradient, hessian, -hessian.solve(gradient))
    lengths = np.array([1.0, 0.5, 0.25, 0.125])
    predictions = lengths[:, None] * (step.direction @ y) + 0.5 * lengths[:, None] ** 2 * q
    predictions[-1] = np.nan  # the shortest cannot be run: the next one serves
    tangent = Tangent(np.zeros(6), y, lambda vector: scale**2 * vector, np.eye(4))
    a = 3 * np.eye(4) + (y * scale) @ (y * scale).T
    expected = -np.linalg.solve(a, y @ (scale**2 * q))
    limit = 2 * np.linalg.norm(step.direction)
    expected *= min(1.0, limit / np.linalg.norm(expected))
    assert np.allclose(acceleration(step, tangent, lengths, predictions), expected, rtol=1e-12)
    nothing = acceleration(step, tangent, lengths, np.full((4, 6), np.nan))
    assert np.array_equal(nothing, np.zeros(4))


def test_searches_side_by_side_find_what_each_finds_alone():
    def try_out(w):
        return Trials(np.sum((w - 1) ** 4, axis=1) + np.sum(w[:, :1] * w[:, 1:], axis=1), np.sin(w))

    rng = np.random.default_rng(0)
    points = []
    for _ in range(5):
        w, s = rng.standard_normal(3), rng.standard_normal((3, 3))
        hessian, gradient = Hessian.of(s), 4 * (w - 1) ** 3
        step = GaussNewtonStep(w, gradient, hessian, -20 * hessian.solve(gradient))
        tangent = Tangent(np.sin(w), np.eye(3), lambda vector: vector, np.eye(3))
        points.append(Point(w, float(try_out(w[None]).costs[0]), step, tangent))
    together = run_searches([line_search(p) for p in points], try_out)
    alone = [run_searches([line_search(p)], try_out)[0] for p in points]
    for a, b, point in zip(together, alone, points, strict=True):
        assert a is not None
        assert b is not None
        assert np.array_equal(a.w, b.w)
        assert a.cost == b.cost < point.cost
    assert len({m.step_length for m in together if m}) > 1


@pytest.mark.parametrize("far", [3.0, 500.0])
def test_no_trial_is_farther_than_an_ensemble_knows(far):
    """Of J = ½ |w|² the whole step ends in the minimum, at ``far``; of a longer one the longest allowed is taken."""
    w, tried = np.array([far, 0.0]), []

    def try_out(candidates):
        tried.extend(candidates)
        return Trials(0.5 * np.sum(candidates**2, axis=1), candidates)

    step = GaussNewtonStep(w, w, Hessian.of(np.zeros((2, 2))), -w)
    tangent = Tangent(w, np.eye(2), lambda vector: vector, np.eye(2))
    (move,) = run_searches([line_search(Point(w, 0.5 * far**2, step, tangent))], try_out)
    assert move is not None
    assert np.linalg.norm(move.w - w) == pytest.approx(min(far, LONGEST))
    assert move.step_length == pytest.approx(min(1.0, LONGEST / far))
    assert max(np.linalg.norm(np.array(tried) - w, axis=1)) < 1.001 * LONGEST


@pytest.mark.parametrize("seed", range(6))
def test_three_starts_find_the_lowest_of_many_minima(seed):
    """Prior so wide that b sin(3 b t) has many minima; twenty starts from another ensemble are the reference."""
    problem = make_problem(Wave(), [1.5, 3.0], scale=2.5, seed=seed)
    reference = assimilate(problem, AssimilationSettings(members=60, starts=20), 99).iterations[-1].cost
    ends = {}
    for starts in (1, 3):
        found = assimilate(problem, AssimilationSettings(members=24, starts=starts), seed)
        assert_cost_by_definition(found)
        ends[starts] = found.iterations[-1].cost
    assert ends[3] < reference + 0.01
    if seed == 1:
        assert ends[1] > reference + 1  # the member of lowest J lies in the wrong basin


class Ridge(Toy):
    """y = (a + 2 sin 3a) t: where the factor falls short of the data's it has a maximum, a false minimum of J."""

    def curve(self, theta, t):
        return float(self.rate(theta, t) * t)

    def rate(self, theta, t):
        return float(theta[0] + 2 * np.sin(3 * theta[0]))


@pytest.mark.slow
def test_where_no_start_explains_the_data_others_are_tried(monkeypatch):
    """Of thirty seeds a third find the truth from two starts, two thirds from others beside them; the rest ends at the
    maximum of the factor, 4.77, or beyond the next one.
    """
    prior = (PriorTerm.normal(Parameter("a", "m"), 4.8, 0.6),)
    found, runs = {}, {}
    for starts in ("more", "two"):
        ends = []
        for seed in range(1, 31):
            problem = make_problem(Ridge(("a",)), [6.42], std=0.02, seed=seed, prior=prior)
            ends.append(assimilate(problem, AssimilationSettings(members=16), seed))
        found[starts] = sum(abs(end.iterations[-1].centre[0] - 6.42) < 0.01 for end in ends)
        runs[starts] = sum(end.forward_runs for end in ends)
        if starts == "more":
            assert sum(end.converged for end in ends) > 25
        monkeypatch.setattr("en4dvar.descent.start.highest_plausible", lambda space: np.inf)
    assert found["more"] >= 15
    assert found["more"] >= found["two"] + 5
    assert runs["two"] < runs["more"]


class Remembering(Decay):
    """Keeps the parameters of every run."""

    def trajectories(self, x, times):
        self.runs = [*getattr(self, "runs", []), *(tuple(row[2:]) for row in x)]
        return super().trajectories(x, times)


@pytest.mark.parametrize("seed", range(4))
def test_the_lowest_descent_is_gone_once(seed):
    """Its moves are the first iterations; a run from the same member alone records the same, to rounding."""
    problem = make_problem(Remembering(), [1.5, 1.2], seed=seed)
    seen = []
    two = assimilate(problem, AssimilationSettings(members=12), seed, progress=lambda _, record: seen.append(record))
    runs = np.array(problem.model.runs)
    iterations = [record.iteration for record in seen if isinstance(record, IterationRecord)]
    assert iterations == list(range(len(two.iterations)))
    for record in two.iterations[1:-1]:  # once as a trial, once with the members about it
        assert np.sum(np.all(np.isclose(runs, record.centre, rtol=1e-12), axis=1)) == 2
    one = assimilate(problem, AssimilationSettings(members=12, starts=1), seed)
    if two.iterations[0].cost > one.iterations[0].cost:
        return  # another member than that of lowest J had the lower minimum
    for a, b in zip(two.iterations, one.iterations, strict=True):
        np.testing.assert_allclose(a.members, b.members, rtol=1e-10)
    assert two.forward_runs > one.forward_runs


@pytest.mark.parametrize("change", [{}, {"step_control": "levenberg-marquardt"}, {"linearisation": "transform"},
                                    {"start": "prior-mean"}])  # fmt: skip
def test_many_members_are_treated_as_few_but_for_rounding(monkeypatch, change):
    """Beyond a number of members nothing of N × N is made; here beyond 4."""
    problem, settings = make_problem(Decay(), [1.5, 1.2]), AssimilationSettings(members=24, **change)
    few = assimilate(problem, settings, 1)
    for module in ("ensemble.linalg", "descent.weight_space"):
        monkeypatch.setattr(f"en4dvar.{module}.FEW", 4)
    if not change:
        eye = np.eye
        monkeypatch.setattr(np, "eye", lambda n, *rest, **named: eye(n, *rest, **named) if n < 24 else 1 / 0)
        monkeypatch.setattr("en4dvar.ensemble.linalg.LowRank.dense", property(lambda thin: 1 / 0))
    many = assimilate(problem, settings, 1)
    assert len(many.iterations) == len(few.iterations) > 2
    assert many.posterior == pytest.approx(few.posterior, rel=1e-9)
    assert many.centre == pytest.approx(few.centre, rel=1e-9)
    assert many.iterations[1].members == pytest.approx(few.iterations[1].members, rel=1e-9)
