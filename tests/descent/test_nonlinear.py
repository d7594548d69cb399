"""Nonlinear toys: descent, the minimum, and the shape of the posterior against quadrature."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize
from toys import Counted, Decay, Vectorised, Wave, make_problem

from en4dvar.descent.step_control import NEAR
from en4dvar.diagnosis.analysis import StartRecord
from en4dvar.estimation.assimilate import assimilate, cost, log_posterior
from en4dvar.priors.prior import PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

CONTROLS = ("line-search", "levenberg-marquardt", "full")


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
@pytest.mark.parametrize("start", ["best-member", "prior-mean"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_j_never_rises(control, linearisation, start, seed):
    problem = make_problem(Wave(), [1.5, 1.2], scale=0.4, seed=seed)
    settings = AssimilationSettings(members=16, step_control=control, linearisation=linearisation, start=start)
    analysis = assimilate(problem, settings, seed)
    records = analysis.iterations
    settled = [r.step_norm <= NEAR and linearisation == "transform" for r in records]  # from there on J is no judge
    first = settled.index(True) if any(settled) else len(records)
    assert all(b.cost <= a.cost for a, b in itertools.pairwise(records[: first + 1]))
    assert all(r.cost - records[first].cost < 0.5 * NEAR**2 for r in records[first:])
    assert records[-1].step_length == 0
    for record in records:
        # J of the record is J of its centre, in the prior's own moments (exact sampling): nothing is remembered wrongly
        x = problem.prior.from_physical(record.centre)
        assert record.cost == pytest.approx(float(cost(problem, x[None])[0]), rel=1e-9)
        assert record.cost == record.background + record.observation
    assert np.array_equal(records[-1].members, analysis.posterior)
    assert np.array_equal(records[-1].centre, analysis.centre)


@pytest.mark.parametrize("control", ["line-search", "levenberg-marquardt"])
@pytest.mark.parametrize("time_std", [0.0, 0.1])
def test_centre_is_the_minimum(control, time_std):
    model = Decay()
    a, b = model.parameters
    terms = (PriorTerm.lognormal(a, 1.2, 0.5), PriorTerm.logit(b, (0.2, 4.0), 1.0, 0.8))
    problem = make_problem(model, [1.5, 1.2], time_std=time_std, prior=terms)
    settings = AssimilationSettings(members=16, step_control=control, step_tolerance=1e-5, cost_tolerance=1e-12)
    analysis = assimilate(problem, settings, 1)
    best = minimize(lambda x: float(cost(problem, x[None])[0]), problem.prior.mean, tol=1e-12, method="Nelder-Mead")
    x = problem.prior.from_physical(analysis.centre)
    z = (problem.prior.from_physical(analysis.posterior) - x).std(axis=0)
    assert np.all(np.abs(x - best.x) < 2e-3 * z)
    assert analysis.converged


def quadrature(problem, centre, std, points=61, width=7.0):
    """Mean and std (n = 2) of the posterior in transformed space on a grid."""
    axes = [c + s * np.linspace(-width, width, points) for c, s in zip(centre, std, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    log_density = log_posterior(problem, x)
    p = np.exp(log_density - log_density.max())
    p /= p.sum()
    mean = p @ x
    return mean, np.sqrt(p @ (x - mean) ** 2), float(np.log(np.sum(np.exp(log_density))))


@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
@pytest.mark.parametrize("time_std", [0.0, 0.01])
def test_posterior_agrees_with_quadrature(linearisation, time_std):
    """Noise small enough that skewness, which no Gaussian ensemble carries, moves the mean by less than 0.1 std."""
    model = Decay()
    a, b = model.parameters
    terms = (PriorTerm.lognormal(a, 1.2, 0.5), PriorTerm.lognormal(b, 1.0, 0.5))
    problem = make_problem(model, [1.5, 1.2], std=0.015, time_std=time_std, prior=terms, k=15)
    analysis = assimilate(problem, AssimilationSettings(linearisation=linearisation), 2)
    posterior = problem.prior.from_physical(analysis.posterior)
    mean, std, log_mass = quadrature(problem, posterior.mean(axis=0), posterior.std(axis=0))
    assert np.all(std < 0.5 * problem.prior.std)  # the data inform both
    assert np.all(np.abs(posterior.mean(axis=0) - mean) < 0.1 * std)
    assert np.all(np.abs(posterior.std(axis=0, ddof=1) / std - 1) < 0.1)

    # the evidence from the same grid: ∫ exp(log posterior + the constants it drops) dx
    area = np.prod(14 * posterior.std(axis=0) / 60)
    constants = problem.prior.log_density(problem.prior.mean) - 15 * np.log(0.015 * np.sqrt(2 * np.pi))
    assert analysis.log_evidence == pytest.approx(log_mass + np.log(area) + constants, abs=0.1)


def test_iteration_limit_is_not_convergence():
    problem = make_problem(Wave(), [1.5, 1.2], scale=0.4)
    analysis = assimilate(problem, AssimilationSettings(members=16, max_iterations=1, start="prior-mean"), 1)
    assert not analysis.converged
    assert analysis.stop_reason == "iteration limit (1) reached"
    assert analysis.warnings[0].startswith("not converged: iteration limit (1) reached; the next step would be 0.")
    assert np.isnan(analysis.log_evidence)  # which is that of a minimum
    assert len(analysis.iterations) == 2


def test_stop_on_the_cost_and_on_the_step():
    problem = make_problem(Wave(), [1.5, 1.2], scale=0.4)
    on_step = assimilate(problem, AssimilationSettings(members=16, cost_tolerance=0.0), 1)
    on_cost = assimilate(problem, AssimilationSettings(members=16, step_tolerance=0.0), 1)
    assert "posterior standard deviations" in on_step.stop_reason
    assert "relative decrease of J below 0.0001" in on_cost.stop_reason
    assert on_step.converged
    assert on_cost.converged
    assert on_step.iterations[-1].step_norm <= 1e-3


def test_progress_and_forward_runs_are_reported():
    class Counting(Counted, Decay):
        pass

    problem = make_problem(Counting(), [1.5, 1.2])
    seen = []
    analysis = assimilate(problem, AssimilationSettings(members=16), 1, progress=lambda *args: seen.append(args))
    rounds = [record for _, record in seen if isinstance(record, StartRecord)]
    first = [record for record in rounds if not record.further]
    assert [name for name, _ in seen] == ["toy"] * (len(rounds) + len(analysis.iterations) + 1)
    assert [r for _, r in seen[len(first) : len(first) + len(analysis.iterations)]] == list(analysis.iterations)
    assert seen[-1][1] == analysis.descents
    rounds = first
    assert [record.rounds for record in rounds] == list(range(1, len(rounds) + 1))
    assert all(len(record.costs) == 2 and record.active <= 2 for record in rounds)
    assert np.isclose(min(rounds[-1].costs), [record.cost for record in analysis.iterations], rtol=1e-12).any()
    counted = analysis.forward_runs
    assert problem.model.runs == counted
    single = assimilate(problem, AssimilationSettings(members=16, starts=1), 1)
    assert single.forward_runs == problem.model.runs - counted
    # prior and posterior forecast with the centre; two members again;
    # 2 + 1 runs a record; 4 trials a move, 4 bent ones after a short move; 2 n along which J rises too little once, so
    # that one point is farther, and each member is run twice as far out, and two are nearer
    short = sum(1 for record in single.iterations if 0 < record.step_length < 1)
    moves = sum(1 for record in single.iterations if record.step_length > 0)
    assert single.forward_runs == 2 * 17 + 2 + 3 * len(single.iterations) + 4 * (moves + short) + (4 + 3) + 16


def test_warnings_speak_of_what_they_see():
    good = make_problem(Vectorised(("a", "b")), [1.0, 0.5])
    assert assimilate(good, AssimilationSettings(), 1).warnings == ()
    optimistic = make_problem(Vectorised(("a", "b")), [1.0, 0.5], scale=100.0)
    optimistic.observations.std[:] = 0.01
    assert "does not explain the data" in assimilate(optimistic, AssimilationSettings(), 1).warnings[0]
    optimistic.observations.std[:] = 10.0
    assert "larger than the scatter" in " ".join(assimilate(optimistic, AssimilationSettings(), 1).warnings)
    conflict = make_problem(Vectorised(("a", "b")), [1.0, 0.5], scale=0.02, std=0.001)
    (warning,) = assimilate(conflict, AssimilationSettings(), 1).warnings
    assert warning.startswith("prior and data conflict: the minimum lies far from the prior mean (a at 1 m")
    vague = make_problem(Vectorised(("a", "b")), [1.0, 0.5], scale=0.01, std=0.5)
    assert [w.split(" (")[0] for w in assimilate(vague, AssimilationSettings(), 1).warnings] == [
        "a is hardly informed by the data",
        "b is hardly informed by the data",
    ]
    vague.model.path_parameters = ("a",)  # b is then known from elsewhere, as a density is
    assert [w.split(" (")[0] for w in assimilate(vague, AssimilationSettings(), 1).warnings] == [
        "a is hardly informed by the data"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("linearisation", ["bundle", pytest.param("transform", marks=pytest.mark.long)])
def test_posterior_is_calibrated(linearisation):
    """200 truths from the prior: ranks are uniform, 50 and 90 % intervals cover as they say."""
    from scipy.stats import chisquare, norm

    experiments, members = 200, 24
    model = Decay()
    a, b = model.parameters
    terms = (PriorTerm.lognormal(a, 1.2, 0.3), PriorTerm.lognormal(b, 1.0, 0.3))
    prior = make_problem(model, [1.0, 1.0], prior=terms).prior
    truths = prior.to_physical(prior.sample(experiments, 99, "random"))
    levels = []
    for seed, truth in enumerate(truths):
        problem = make_problem(model, truth, prior=terms, seed=1000 + seed, std=0.05, k=7)
        settings = AssimilationSettings(members=members, linearisation=linearisation)
        analysis = assimilate(problem, settings, seed)
        x = prior.from_physical(analysis.posterior)
        levels.append(norm.cdf((prior.from_physical(truth) - x.mean(axis=0)) / x.std(axis=0, ddof=1)))
    for u in np.array(levels).T:
        counts = np.histogram(u, bins=10, range=(0, 1))[0]
        assert chisquare(counts).pvalue > 0.01
        for level in (0.5, 0.9):
            inside = np.mean(np.abs(u - 0.5) < level / 2)
            assert abs(inside - level) < 3 * np.sqrt(level * (1 - level) / experiments)
