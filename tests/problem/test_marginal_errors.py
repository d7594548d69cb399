"""What the mixture over the parameters of errors is made of."""

import numpy as np
import pytest

from en4dvar.data.noise import Kernel, Linearisation, Predicted, noise_of, noise_of_readings
from en4dvar.data.noise.discrepancy import NUGGET

K = 9
TIMES = np.linspace(0.2, 2.0, K)
CORRELATION = np.exp(-np.abs(np.subtract.outer(TIMES, TIMES)) / 0.3)


@pytest.mark.parametrize("correlated", [False, True])
def test_columns_are_whitened_by_the_factor_of_the_covariance(correlated):
    """Against R + A of each run in closed form, whose lengths, amplitudes, rates and scales differ."""
    stream, runs = np.random.default_rng(4), 5
    columns, rates = stream.standard_normal((K, 3)), stream.standard_normal((runs, K))
    process = stream.uniform(0.2, 1.0, (runs, 2))
    std, scale = stream.uniform(0.1, 0.3, K), stream.uniform(0.5, 2.0, runs)
    noise = noise_of(
        std, np.zeros(K), correlation=CORRELATION if correlated else None, discrepancy=Kernel(TIMES, 1.5, 1.5)
    )
    predicted = Predicted(stream.standard_normal((runs, K)), rates, scale, process)
    values = predicted.values[0]
    white = noise.whitened_rows(values, columns.T, predicted)
    lag = np.abs(np.subtract.outer(TIMES, TIMES))
    for b, (amplitude, length) in enumerate(process):
        a, s = amplitude * np.sqrt(1 + (rates[b] / 1.5) ** 2), scale[b] * std
        R = np.outer(s, s) * (CORRELATION if correlated else np.eye(K))
        x = np.sqrt(3) * lag / length
        L = np.linalg.cholesky(R + np.outer(a, a) * ((1 + x) * np.exp(-x) + NUGGET * np.eye(K)))
        np.testing.assert_allclose(white[b].T, np.linalg.solve(L, columns), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kind", ["independent", "timed", "correlated", "robust", "blocks"])
def test_rows_are_whitened_as_a_linearisation_at_each_run_is(kind):
    stream, runs = np.random.default_rng(7), 4
    std, rows = stream.uniform(0.1, 0.3, K), stream.standard_normal((3, K))
    timed = np.full(K, 0.1) if kind == "timed" else np.zeros(K)
    matrix = CORRELATION if kind == "correlated" else None
    noise = noise_of(std, timed, matrix, huber=1.5 if kind == "robust" else None)
    if kind == "blocks":
        noise = noise_of_readings(std, timed, thresholds=np.where(np.arange(K) < 4, 1.5, np.inf))
    rates = stream.standard_normal((runs, K)) if kind == "timed" else None
    predicted = Predicted(stream.standard_normal((runs, K)), rates, stream.uniform(0.5, 2.0, runs))
    values = stream.standard_normal(K)
    white = noise.whitened_rows(values, rows, predicted)
    for b in range(runs):
        residual, slopes = noise.whiten(values, np.ones(K), Linearisation(predicted[b], rows))
        np.testing.assert_allclose(white[b].T, slopes, rtol=1e-12, atol=1e-12)
        off = noise.whitened_rows(values, (values - predicted.values[b])[None], predicted)[b, 0]
        np.testing.assert_allclose(off * noise.pulls(values, predicted)[b], residual[:K], rtol=1e-12, atol=1e-12)
