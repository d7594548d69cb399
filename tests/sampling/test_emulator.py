"""The emulator: all monomials, polynomials returned as they are, coordinates in which points are standard."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.data.noise import Predicted
from en4dvar.sampling.emulated_cost import Coordinates, Emulator, basis, monomials


def test_monomials_are_all_of_them():
    parents = monomials(3, 4)
    assert len(parents) == 35  # (3 + 4)! / (3! 4!)
    z = np.random.default_rng(0).standard_normal((60, 3))
    values = basis(z, parents)
    assert np.linalg.matrix_rank(values) == 35
    np.testing.assert_array_equal(values[1:4], z.T)
    for (parent, coordinate), value in zip(parents[1:], values[1:], strict=True):
        np.testing.assert_array_equal(value, values[parent] * z[:, coordinate])


@pytest.mark.parametrize("n", [1, 3])
def test_coordinates_are_standard_and_lead_back(n):
    rng = np.random.default_rng(1)
    x = 5 + rng.standard_normal((200, n)) @ rng.standard_normal((n, n))
    coordinates = Coordinates.about(x)
    z = coordinates.of(x)
    np.testing.assert_allclose(np.atleast_2d(np.cov(z.T)), np.eye(n), atol=1e-12)
    np.testing.assert_allclose(coordinates.back(z), x, rtol=1e-12)


def test_a_cubic_is_returned_however_runs_count():
    rng = np.random.default_rng(2)
    x, counts = rng.standard_normal((80, 2)), rng.uniform(0.1, 2, 80)

    def cubic(x):
        a, b = x.T
        return np.stack([1 + a * b**2 - 0.3 * b**3, a - b], axis=1)

    emulator = Emulator.fitted(Coordinates.about(x), 3, x, cubic(x), counts, 1e-14)
    other = 2 * rng.standard_normal((20, 2))
    np.testing.assert_allclose(emulator.predictions(other), cubic(other), atol=1e-9)


def test_what_a_polynomial_says_of_errors_far_beyond_its_runs_stays_a_number():
    """Of logarithms of 800 and more, which no run had: σ, and amplitude and length of a discrepancy."""
    like = Predicted(np.zeros(3), noise_scale=np.array(1.0), discrepancy=np.ones(2))
    far = like.unstacked(np.array([[0.0, 1.0, 2.0, 900.0, -900.0, 800.0]]))
    assert np.all(np.isfinite(far.discrepancy**2) & (far.discrepancy**2 > 0))
    assert np.isfinite(far.noise_scale**2)
