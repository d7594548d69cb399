"""Several series in one problem against closed forms: cross-correlations, places, weights, balance, order."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from problem.series_models import AT, CELLS, MODEL, TIMES, Q, all_series, closed_form, problem_of, rows

from en4dvar.data.noise import BlockNoise, CorrelatedNoise, Noise, Predicted, joint_noise, noise_of, noise_of_readings
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series, balanced
from en4dvar.ensemble.forecast import cost, forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import DataError
from en4dvar.schemes.settings import AssimilationSettings

NAMES = ("p", "q", "f")
G = np.vstack([rows(name) for name in NAMES])
SETTINGS = AssimilationSettings(members=12, what_if=False)


def estimated(problem):
    found = assimilate(problem, SETTINGS, 1)
    return found.posterior.mean(axis=0), np.cov(found.posterior.T), found


def cross_covariance(rho, std=(0.3, 0.2, 0.5)):
    """R written out, reading by reading: ρ s_i s_j where p and q were read at the same time."""
    of = [(name, t, s) for name, s in zip(NAMES, std, strict=True) for t in TIMES[name]]
    R = np.zeros((len(of), len(of)))
    for i, (a, t, s) in enumerate(of):
        for j, (b, u, r) in enumerate(of):
            if i == j:
                R[i, j] = s * r
            elif {a, b} == {"p", "q"} and abs(t - u) < 1e-12:
                R[i, j] = rho * s * r
    return R


def test_two_observables_with_a_cross_correlation_against_the_closed_form():
    series = all_series()
    mean, covariance, found = estimated(problem_of(series, {("p", "q"): 0.6}))
    y = np.concatenate([one.values for one in series])
    exact, spread = closed_form(G, y, np.linalg.inv(cross_covariance(0.6)))
    assert mean == pytest.approx(exact, abs=1e-10)
    assert covariance == pytest.approx(spread, abs=1e-10)
    without, _ = closed_form(G, y, np.linalg.inv(cross_covariance(0.0)))
    assert np.max(np.abs(without - exact)) > 1e-3
    design = 4 * G @ G.T + cross_covariance(0.6)  # y is N(0.3 G·1, this)
    residual = y - G @ np.full(2, 0.3)
    exact_evidence = -0.5 * (residual @ np.linalg.solve(design, residual) + np.linalg.slogdet(2 * np.pi * design)[1])
    assert found.log_evidence == pytest.approx(exact_evidence, abs=1e-9)


def test_correlation_in_time_and_across_is_a_kronecker_product():
    t = TIMES["p"]
    in_time = np.exp(-np.abs(np.subtract.outer(t, t)) / 0.4)
    noise = noise_of(np.full(7, 0.2), correlation=in_time)
    joined = joint_noise([t, t], [noise, replace(noise, std=np.full(7, 0.5))], np.array([[1.0, -0.4], [-0.4, 1.0]]))
    assert isinstance(joined, CorrelatedNoise)
    assert joined.correlation.matrix == pytest.approx(np.kron([[1.0, -0.4], [-0.4, 1.0]], in_time), abs=1e-15)
    with pytest.raises(ValueError, match="the same times and the same correlation"):
        joint_noise([t, t], [noise, noise_of(np.full(7, 0.2))], np.array([[1.0, -0.4], [-0.4, 1.0]]))
    with pytest.raises(ValueError, match="not positive definite"):
        joint_noise([t] * 3, [noise_of(np.ones(7))] * 3, np.array([[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1.0]]))


@pytest.mark.parametrize("correlation", [None, {("p", "q"): 0.6}])
def test_the_order_of_the_series_does_not_matter(correlation):
    series = all_series()
    mean, covariance, found = estimated(problem_of(series, correlation))
    for order in ([2, 0, 1], [1, 2, 0], [2, 1, 0]):
        other, spread, again = estimated(problem_of([series[i] for i in order], correlation))
        assert other == pytest.approx(mean, abs=1e-10)
        assert spread == pytest.approx(covariance, abs=1e-10)
        assert again.log_evidence == pytest.approx(found.log_evidence, abs=1e-9)


def test_weights_and_balance_against_the_closed_form():
    weights = {name: np.linspace(0.0, 2.0, len(TIMES[name])) for name in NAMES}
    series = all_series(weights=weights)
    y, std = (
        np.concatenate([getattr(o, key) for o in x])
        for x, key in ((series, "values"), ([o.noise for o in series], "std"))
    )
    beta = np.concatenate(list(weights.values()))
    mean, covariance, found = estimated(problem_of(series))
    exact, spread = closed_form(G, y, np.diag(beta / std**2))
    assert mean == pytest.approx(exact, abs=1e-10)
    assert covariance == pytest.approx(spread, abs=1e-10)
    assert "not-bayesian" in {c.code for c in found.cautions}

    labels = np.repeat(NAMES, [len(TIMES[name]) for name in NAMES])
    shared = balanced(beta, labels)
    for name in NAMES:  # each group has a third of the total
        assert shared[labels == name].sum() == pytest.approx(beta.sum() / 3, rel=1e-14)
        assert shared[labels == name] / shared[labels == name].max() == pytest.approx(weights[name] / 2.0, abs=1e-15)
    observations = replace(problem_of(series).observations, weights=shared)
    mean, covariance, _ = estimated(problem_of(series, observations=observations))
    exact, spread = closed_form(G, y, np.diag(shared / std**2))
    assert mean == pytest.approx(exact, abs=1e-10)
    assert covariance == pytest.approx(spread, abs=1e-10)


def test_a_group_without_weight_keeps_none():
    assert balanced(np.array([0.0, 0.0, 1.0, 1.0, 2.0]), ["a", "a", "b", "b", "c"]) == pytest.approx([0, 0, 1, 1, 2])


def test_a_field_is_read_at_its_places():
    places = Places.at_coordinates([3.0, 0.5, 6.0], CELLS, "m")
    values = np.random.default_rng(1).standard_normal((2, 3, 5))
    for k, x in enumerate((3.0, 0.5, 6.0)):
        exact = [np.interp(x, CELLS, values[i, k]) for i in range(2)]
        assert places.read(values)[:, k] == pytest.approx(exact, abs=1e-14)
    shuffled = np.array([3, 0, 4, 2, 1])
    again = Places.at_coordinates([3.0, 0.5, 6.0], CELLS[shuffled], "m").read(values[..., shuffled])
    assert again == pytest.approx(places.read(values), abs=1e-14)
    with pytest.raises(DataError, match=r"place 7 m lies outside 0 to 6 m"):
        Places.at_coordinates([7.0], CELLS, "m")
    run = forecast(problem_of(all_series()), np.array([[1.2, -0.4]]))
    assert run.predictions[0] == pytest.approx(G @ [1.2, -0.4], abs=1e-13)
    assert G[-4:, 0] == pytest.approx(AT)


def test_many_readings_of_a_large_field_take_no_field_each():
    places = Places.at_indices(np.arange(0, 100_000, 200))
    values = np.arange(200_000.0).reshape(1, 2, 100_000)
    rows_ = np.repeat([0, 1], 250)
    tracemalloc.start()
    found = places.read(values, rows_)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.array_equal(found[0], np.arange(0, 100_000, 200) + 100_000.0 * rows_)
    assert most < 1e6


def test_curves_of_the_series_that_have_one():
    grid = np.linspace(0.1, 1.0, 5)
    run = forecast(problem_of(all_series()), np.array([[1.2, -0.4]]), extra_times=grid)
    exact = np.concatenate([rows("p", grid) @ [1.2, -0.4], rows("q", grid) @ [1.2, -0.4]])
    assert run.path[0] == pytest.approx(exact, abs=1e-13)


def test_many_readings_at_one_instant():
    """200 readings of one field at one time need no time axis of their own."""
    rng = np.random.default_rng(3)
    at = rng.uniform(0, 6, 200)
    values = np.interp(at, CELLS, CELLS) + 0.25 + 0.1 * rng.standard_normal(200)
    series = Series(MODEL.observables[2], np.full(200, 0.5), values, noise_of(np.full(200, 0.1)),
                    places=Places.at_coordinates(at, CELLS, "m"))  # fmt: skip
    mean, covariance, _ = estimated(problem_of([series]))
    exact, spread = closed_form(np.column_stack([at, np.full(200, 0.5)]), values, np.eye(200) * 100)
    assert mean == pytest.approx(exact, abs=1e-9)
    assert covariance == pytest.approx(spread, abs=1e-10)


def mixed():
    """Correlated, robust and plain errors side by side, a timing error among them."""
    t = TIMES["p"]
    in_time = {"correlation": np.exp(-np.abs(np.subtract.outer(t, t)) / 0.3)}
    series = all_series(p=in_time, q={"huber": 1.0})
    return [replace(series[0], noise=replace(series[0].noise, time_std=np.full(7, 0.05))), *series[1:2]]


def test_blocks_are_the_sum_of_their_series():
    series = mixed()
    joint = problem_of(series)
    assert isinstance(joint.observations.noise, BlockNoise)
    x = np.random.default_rng(2).standard_normal((4, 2))
    prior = 0.5 * np.sum(((x - 0.3) / 2.0) ** 2, axis=1)
    alone = sum(cost(problem_of([one]), x) - prior for one in series)
    assert cost(joint, x) - prior == pytest.approx(alone, rel=1e-13)
    run = forecast(joint, x)
    likelihood = joint.observations.log_likelihood(run.predicted)
    each = [problem_of([one]).observations.log_likelihood(forecast(problem_of([one]), x).predicted) for one in series]
    assert likelihood == pytest.approx(np.hstack(each), rel=1e-12)
    conditional = joint.observations.log_conditional(run.predicted)
    each = [problem_of([one]).observations.log_conditional(forecast(problem_of([one]), x).predicted) for one in series]
    assert conditional == pytest.approx(np.hstack(each), rel=1e-12)


def test_the_score_of_blocks_is_the_gradient_of_their_cost():
    """∇J_o = −Sᵀd for every kind at once, by central differences of J_o."""
    from en4dvar.data.noise import Linearisation

    problem = problem_of(mixed())
    observations, x, h = problem.observations, np.array([0.8, 0.7]), 1e-6

    def predicted(at):
        return forecast(problem, at[None]).predicted[0]

    def J(at):
        return float(observations.cost(predicted(at)))

    at = predicted(x)
    slopes = [(predicted(x + h * e), predicted(x - h * e)) for e in np.eye(2)]
    linear = Linearisation(
        at,
        np.array([(up.values - down.values) / (2 * h) for up, down in slopes]),
        np.array([(up.rates - down.rates) / (2 * h) for up, down in slopes]),
    )
    d, S = observations.whiten(linear)
    gradient = [(J(x + h * e) - J(x - h * e)) / (2 * h) for e in np.eye(2)]
    assert -S.T @ d == pytest.approx(gradient, rel=1e-6)
    vectors = np.random.default_rng(0).standard_normal((3, len(observations)))
    each = [b.noise.precision_times(observations.values[b.where], np.ones(len(b.where)),
                                    Predicted(at.values[b.where], at.rates[b.where]), vectors[:, b.where])
            for b in observations.noise.blocks]  # fmt: skip
    assert observations.precision_times(at, vectors) == pytest.approx(np.hstack(each), rel=1e-13)


def test_series_of_one_kind_are_that_kind():
    assert type(problem_of(all_series()).observations.noise) is Noise
    assert type(noise_of_readings(np.ones(3), np.zeros(3), thresholds=np.full(3, 2.0))).__name__ == "HuberNoise"


def test_readings_that_are_not_correlated_take_no_matrix():
    """10 000 readings of three series; of 40 the errors are correlated in time, a matrix of all would have 800 MB."""
    times = [np.linspace(0.0, 1.0, 40), np.linspace(0.0, 1.0, 5000), np.linspace(0.0, 1.0, 4960)]
    in_time = np.exp(-np.abs(np.subtract.outer(times[0], times[0])))
    noises = [noise_of(np.full(40, 0.1), correlation=in_time), *(noise_of(np.full(len(t), 0.2)) for t in times[1:])]
    tracemalloc.start()
    noise = joint_noise(times, noises, np.eye(3))
    cost = noise.cost(np.ones(10_000), np.ones(10_000), Predicted(np.zeros((2, 10_000))))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert isinstance(noise, BlockNoise)
    assert [len(block.where) for block in noise.blocks] == [40, 9960]
    exact = 0.5 * np.ones(40) @ np.linalg.solve(0.01 * in_time, np.ones(40)) + 0.5 * 9960 / 0.04
    assert cost == pytest.approx([exact, exact], rel=1e-12)
    assert most < 20e6
    assert max(matrix.size for matrix, _ in noise.matrices().values()) < 12_000


def test_times_that_differ_by_rounding_are_one_instant():
    series = all_series()[:2]
    moved = replace(series[1], times=series[1].times * (1 + 1e-15) + 1e-17)
    observations = Observations.of_series([series[0], moved], {("p", "q"): 0.6})
    assert len(observations.instants[0]) == 7
    exact = Observations.of_series(series, {("p", "q"): 0.6})
    assert np.array_equal(observations.noise.matrices()["correlation"][0], exact.noise.matrices()["correlation"][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: Observations.of_series([s[0], s[0]]), "two series have the same name"),
        (lambda s: Observations.of_series(s, {("p", "z"): 0.1}), "a correlation of 'p' and 'z'"),
        (lambda s: Observations.of_series([replace(s[0], times=s[0].times[::-1]), s[1]]), "times must increase"),
        (
            lambda s: Observations.of_series(
                [replace(s[0], noise=noise_of(np.ones(7), huber=1.0)), s[1]], {("p", "q"): 0.5}
            ),
            "a robust cost needs independent",
        ),
        (
            lambda s: Observations.of_series([replace(s[0], weights=np.arange(7.0)), s[1]], {("p", "q"): 0.5}),
            "need one weight",
        ),
    ],
)
def test_series_that_do_not_go_together(change, message):
    with pytest.raises(DataError, match=message):
        change(all_series())


def test_a_reading_at_a_place_is_asked_of_the_operator_of_its_series():
    assert problem_of(all_series()[1:]).observable is Q
