"""Errors correlated as exp(−|Δt|/τ): a Markov process, against the dense correlation."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from estimation.test_field_modes import READ, TIMES, VALUES, line
from toys import Vectorised, make_problem

import en4dvar
from en4dvar.data.noise import CorrelatedNoise, Correlation, DecayingErrors, Linearisation, Predicted, SharedErrors
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.estimation.assimilate import assimilate
from en4dvar.report.result import Result, load_result
from en4dvar.schemes.settings import AssimilationSettings

K = 40
RNG = np.random.default_rng(3)


def times_of(step: float) -> np.ndarray:
    return np.cumsum(step * RNG.uniform(0.2, 2.0, K))


@pytest.mark.parametrize("step", [1e-6, 0.01, 1.0, 100.0, 1e4])
def test_every_product_is_that_of_the_matrix(step):
    sparse = DecayingErrors(times_of(step))
    dense = Correlation(sparse.matrix)
    rows, slopes = RNG.standard_normal((5, K)), RNG.standard_normal((K, 3))
    exact = {"rtol": 1e-9 * max(1, 1e-3 / step), "atol": 1e-9}
    np.testing.assert_allclose(sparse.log_root, dense.log_root, **exact)
    np.testing.assert_allclose(sparse.precision_diagonal, dense.precision_diagonal, **exact)
    np.testing.assert_allclose(sparse.correlated(rows), dense.correlated(rows), **exact)
    for product in ("decorrelated", "solved"):
        mine, theirs = getattr(sparse, product)(rows), getattr(dense, product)(rows)
        np.testing.assert_allclose(mine, theirs, rtol=exact["rtol"], atol=1e-9 * np.abs(theirs).max())
    for mine, theirs in zip(sparse.of_scale(rows[0], slopes), dense.of_scale(rows[0], slopes), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=exact["rtol"], atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("time_std", [0.0, 0.02])
def test_an_estimate_is_that_of_the_matrix(time_std):
    problem = make_problem(Vectorised(("a", "b", "c")), [1.0, -0.5, 0.7], std=0.1, k=K)
    times, settings = problem.observations.times, AssimilationSettings(members=20, sampling="exact")
    decaying = DecayingErrors(times / 0.3)

    def ended(correlation):
        noise = CorrelatedNoise(np.full(K, 0.1), np.full(K, time_std), correlation)
        return assimilate(replace(problem, observations=replace(problem.observations, noise=noise)), settings, 5)

    mine, theirs = ended(decaying), ended(Correlation(decaying.matrix))
    np.testing.assert_allclose(mine.posterior, theirs.posterior, rtol=1e-7, atol=1e-9)
    assert mine.log_evidence == pytest.approx(theirs.log_evidence, abs=1e-8)
    np.testing.assert_allclose(mine.log_likelihood, theirs.log_likelihood, rtol=1e-7, atol=1e-9)


def test_no_matrix_of_all_readings_is_formed():
    k = 20_000  # of which a matrix takes 3.2 GB
    noise = CorrelatedNoise(np.ones(k), np.full(k, 0.1), DecayingErrors(np.linspace(0.0, 5.0, k)))
    rates, slopes = np.ones(k), RNG.standard_normal((2, 4, k))
    at = Linearisation(Predicted(np.zeros(k), rates, np.array(1.0)), slopes[0], slopes[1], np.ones(4))
    tracemalloc.start()
    noise.check(np.ones(k))
    noise.whiten(np.ones(k), np.ones(k), at)
    noise.log_likelihood(np.ones(k), at.prediction)
    noise.log_conditional(np.ones(k), at.prediction)
    noise.drawn(at.prediction, np.random.default_rng(1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * 8 * k


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0], [0.0, 1.0, 0.5], [0.0, 1e-17, 1.0], [0.0, np.nan, 1.0]])
def test_times_that_do_not_increase_are_refused(times):
    with pytest.raises(ValueError, match="not positive definite: readings are too close in time"):
        DecayingErrors(np.array(times))


def test_a_file_holds_what_a_rerun_needs(tmp_path):
    t = np.linspace(0.1, 2.0, 300)
    y = 1.2 * t + 0.1 * RNG.standard_normal(300)
    result = en4dvar.estimate(
        lambda p, times: p["a"] * times, (t, y), {"a": {"prior": "normal", "mean": 1, "std": 1}},
        error={"y_std": 0.1, "correlation_time": 0.2}, directory=tmp_path,
    )  # fmt: skip
    R = 0.1**2 * np.exp(-np.abs(np.subtract.outer(t, t)) / 0.2)
    (path,) = tmp_path.rglob("posterior.nc")
    noise = load_result(path).observations().noise
    np.testing.assert_allclose(np.outer(noise.std, noise.std) * noise.correlation.matrix, R, atol=1e-14)
    precision = t @ np.linalg.solve(R, t) + 1
    assert result.rows[0].mean == pytest.approx((t @ np.linalg.solve(R, y) + 1) / precision, abs=0.02 * precision**-0.5)
    assert result.rows[0].std == pytest.approx(precision**-0.5, rel=0.03)


@pytest.mark.parametrize("correlation", [DecayingErrors(np.arange(6) / 3), SharedErrors(np.full((6, 1), 0.5))])
def test_a_file_of_readings_at_places_holds_the_correlation_too(tmp_path, correlation):
    noise = CorrelatedNoise(np.full(6, 0.3), np.zeros(6), correlation)
    problem = line()
    u = Series(problem.observable, TIMES, VALUES, noise, places=Places.at_indices(READ))
    problem = replace(problem, observations=Observations.of_series([u]))
    analysis = assimilate(problem, AssimilationSettings(members=40), 1)
    stored = load_result(Result.from_analysis(analysis, {}).save(tmp_path / "posterior.nc"))
    again = stored.observations().noise
    np.testing.assert_allclose(again.correlation.matrix, correlation.matrix, atol=1e-15)
