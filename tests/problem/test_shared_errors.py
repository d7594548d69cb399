"""Errors that readings share, R as a diagonal plus low rank: against the dense covariance in closed form."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import multivariate_normal
from toys import Linear, make_problem

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.data.noise import CorrelatedNoise, Linearisation, Predicted, SharedErrors
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.report.result import load_result
from en4dvar.schemes.settings import AssimilationSettings

RNG = np.random.default_rng(7)
K, NAMES = 30, ("a", "b", "c")
STD = RNG.uniform(0.05, 0.2, K)


def noise_with(columns, std=STD, time_std=0.0):
    total, shared = SharedErrors.beside(std, columns)
    return CorrelatedNoise(total, np.full(len(std), time_std), shared)


@pytest.mark.parametrize("size", [0.1, 10.0])  # beside 0.1 of each reading alone
@pytest.mark.parametrize("k", [1, 4])
def test_densities_and_products_are_those_of_the_dense_covariance(size, k):
    columns = size * RNG.standard_normal((K, k))
    R = np.diag(STD**2) + columns @ columns.T
    noise, y = noise_with(columns), RNG.standard_normal(K)
    at = Predicted(RNG.standard_normal((5, K)))
    residual = y - at.values
    dense = multivariate_normal(np.zeros(K), R)
    np.testing.assert_allclose(noise.log_likelihood(y, at).sum(axis=1), dense.logpdf(residual), rtol=1e-9)
    first = multivariate_normal(np.zeros(3), R[:3, :3])  # each given those before it
    np.testing.assert_allclose(noise.log_likelihood(y, at)[:, :3].sum(axis=1), first.logpdf(residual[:, :3]), rtol=1e-9)
    others = np.arange(K) != 11
    gain = np.linalg.solve(R[np.ix_(others, others)], R[others, 11])
    variance = R[11, 11] - R[11, others] @ gain
    expected = -0.5 * (residual[:, 11] - residual[:, others] @ gain) ** 2 / variance - 0.5 * np.log(
        2 * np.pi * variance
    )
    np.testing.assert_allclose(noise.log_conditional(y, at)[:, 11], expected, rtol=1e-7)
    vectors = RNG.standard_normal((3, K))
    product = noise.precision_times(y, np.ones(K), at[0], vectors)
    np.testing.assert_allclose(product @ R, vectors, atol=1e-7 * np.abs(vectors).max())
    draws = noise.drawn(Predicted(np.zeros((40_000, K))), np.random.default_rng(1))
    of_draws = np.cov(draws.T) / np.sqrt(np.outer(np.diag(R), np.diag(R)))
    np.testing.assert_allclose(of_draws, R / np.sqrt(np.outer(np.diag(R), np.diag(R))), atol=0.03)


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_posterior_and_evidence_of_a_linear_problem(weight):
    columns = np.stack([np.full(K, 0.3), np.linspace(-0.5, 1.0, K), RNG.standard_normal(K)], axis=1)
    problem = make_problem(Linear(NAMES), [1.0, -0.5, 0.7], std=STD, k=K, weights=weight)
    problem = replace(problem, observations=replace(problem.observations, noise=noise_with(columns)))
    analysis = assimilate(problem, AssimilationSettings(members=20, sampling="exact"), 5)
    R = (np.diag(STD**2) + columns @ columns.T) / weight
    times, y, prior = problem.observations.times, problem.observations.values, problem.prior
    H = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in times])
    gain = np.diag(prior.std**2) @ H.T @ np.linalg.inv(H * prior.std**2 @ H.T + R)
    expected = prior.mean + gain @ (y - H @ prior.mean)
    np.testing.assert_allclose(analysis.centre, expected, atol=1e-10)
    covariance = (np.eye(3) - gain @ H) @ np.diag(prior.std**2)
    np.testing.assert_allclose(np.cov(analysis.posterior.T), covariance, atol=1e-10)
    if weight == 1.0:
        marginal = multivariate_normal(H @ prior.mean, H * prior.std**2 @ H.T + R)
        assert analysis.log_evidence == pytest.approx(marginal.logpdf(y), abs=1e-9)
    alone = replace(problem, observations=replace(problem.observations, noise=noise_with(0.0 * columns)))
    narrower = assimilate(alone, AssimilationSettings(members=20, sampling="exact"), 5)
    wider = analysis.posterior.std(axis=0) / narrower.posterior.std(axis=0)
    assert wider.min() > 1
    assert wider.max() > 3


@pytest.mark.parametrize("time_std", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_score_and_information_where_the_size_of_the_errors_is_estimated(time_std):
    """SᵀS against the covariance of the score over readings drawn from the model."""
    columns = np.array([[0.3, 0.1], [-0.2, 0.4], [0.5, 0.0]])
    noise = noise_with(columns, np.full(3, 0.3), time_std)
    at = Linearisation(
        Predicted(np.zeros(3), np.array([1.0, 2.0, -1.5]) if time_std else None, np.exp(0.3)),
        np.array([[0.7, -0.4, 1.0], [0.1, 0.0, 0.0]]),
        np.array([[1.5, 0.8, -1.2], [0.0, 1.0, 0.5]]) if time_std else None, np.array([0.2, 1.0]),
    )  # fmt: skip
    s = noise.error_std(at.prediction)
    root = np.linalg.cholesky(np.outer(s, s) * noise.correlation.matrix)
    scores = []
    for y in np.random.default_rng(0).standard_normal((20_000, 3)) @ root.T:
        d, sensitivity = noise.whiten(y, np.ones(3), at)
        scores.append(sensitivity.T @ d)
    np.testing.assert_allclose(np.mean(scores, axis=0), 0, atol=0.05)
    np.testing.assert_allclose(np.cov(np.array(scores).T), sensitivity.T @ sensitivity, rtol=0.05, atol=0.05)


def test_no_matrix_of_all_readings_is_formed():
    k = 20_000  # of which a matrix takes 3.2 GB
    noise = noise_with(RNG.standard_normal((k, 3)), np.ones(k))
    at = Linearisation(Predicted(np.zeros(k), None, np.array(1.0)), RNG.standard_normal((4, k)), None, np.ones(4))
    tracemalloc.start()
    noise.whiten(np.ones(k), np.ones(k), at)
    noise.log_likelihood(np.ones(k), at.prediction)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * 8 * k


def write(folder: Path) -> tuple[np.ndarray, ...]:
    t = np.linspace(0.1, 2.0, 25)
    drift = np.linspace(-0.4, 0.6, 25)
    y = 1.2 * t + 0.5 * drift + 0.1 * RNG.standard_normal(25)
    rows = "".join(f"{a!r},{b!r},{100 * c!r}\n" for a, b, c in zip(t.tolist(), y.tolist(), drift.tolist(), strict=True))
    (folder / "data.csv").write_text(f"t,x,drift\n{rows}", encoding="utf-8")
    (folder / "run.yaml").write_text(CONFIG, encoding="utf-8")
    return t, y, drift


CONFIG = """\
name: line
model: {name: trend}
data:
  path: data.csv
  columns: {time: {name: t, unit: "1"}, x: {name: x, unit: "1"}}
  error: {x_std: 0.1, shared: [{column: drift, unit: "%"}, 0.2]}
parameters: {level: 0, slope: {prior: normal, mean: 1, std: 1}}
"""


def test_from_yaml_and_from_python(tmp_path: Path) -> None:
    t, y, drift = write(tmp_path)
    done = CliRunner().invoke(main, ["run", str(tmp_path / "run.yaml"), "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    stored = load_result(tmp_path / "run" / "posterior.nc")
    R = 0.1**2 * np.eye(25) + np.outer(drift, drift) + 0.2**2
    precision = t @ np.linalg.solve(R, t) + 1
    mean = (t @ np.linalg.solve(R, y) + 1) / precision
    (row,) = stored.rows
    again = stored.observations().noise  # from the file
    np.testing.assert_allclose(np.outer(again.std, again.std) * again.correlation.matrix, R, atol=1e-14)
    given = en4dvar.estimate(
        lambda p, times: p["a"] * times, (t, y), {"a": {"prior": "normal", "mean": 1, "std": 1}},
        error={"y_std": 0.1, "shared": [drift, 0.2]}, directory=tmp_path / "given",
    )  # fmt: skip
    table = en4dvar.estimate(
        lambda p, times: p["a"] * times, (t, y), {"a": {"prior": "normal", "mean": 1, "std": 1}},
        error={"y_std": 0.1, "shared": np.stack([drift, np.full(25, 0.2)], axis=1)}, directory=tmp_path / "table",
    )  # fmt: skip
    for found in (row, given.rows[0], table.rows[0]):
        assert found.mean == pytest.approx(mean, abs=0.02 * precision**-0.5)
        assert found.std == pytest.approx(precision**-0.5, rel=0.03)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("x_std: 0.1", "x_std: 0.1, robust: huber", "robust: not together with shared"),
        ("x_std: 0.1", "x_std: 0.1, correlation_time: 1 s", "shared: not together with correlation_time"),
        ("x_std: 0.1", "x_std: 0.1, at_most: true", "at_most: not together with shared"),
        ("0.2]", "0.2 kg]", "data.error.shared"),
        ("0.2]", "{column: level}]", "level"),
        ("x_std: 0.1", "x_std: 1e-6", "10⁴ times"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    write(tmp_path)
    (tmp_path / "run.yaml").write_text(CONFIG.replace(old, new), encoding="utf-8")
    with pytest.raises((ConfigError, DataError), match=message):
        build(load_config(tmp_path / "run.yaml"))
