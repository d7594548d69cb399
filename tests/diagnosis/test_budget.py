"""What an error bar is made of, against a linear problem whose parts are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.diagnosis.response.budget import largest, shares_of_priors


def test_shares_are_those_of_a_linear_problem() -> None:
    """y = a + 2 b + c + e: the variance of a is that of e, of b and of c, but for what its wide prior takes."""
    before = np.array([1e4, 0.25, 1.0])
    rows, noise = np.array([1.0, 2.0, 1.0]), 0.5
    covariance = np.linalg.inv(np.diag(1 / before) + np.outer(rows, rows) / noise)
    shares = shares_of_priors(covariance, before)
    parts = np.array([noise, 4 * 0.25, 1.0])  # of e, b, c in a = y − 2 b − c − e
    assert shares[0, 1:] == pytest.approx(parts[1:] / parts.sum(), rel=1e-3)
    assert shares[0, 0] < 1e-3
    gain = covariance @ rows / noise  # each row: what priors and readings bring sums to the whole
    assert shares.sum(axis=1) + gain**2 * noise / np.diag(covariance) == pytest.approx(1.0)


def test_shares_that_members_do_not_tell_apart_are_named_together() -> None:
    """Of two correlations of 0.6 a sample of 48 names the larger by chance; of 0.8 and 0.3 it does not."""
    rng = np.random.default_rng(5)

    def named(correlations: list[float]) -> list[list[str]]:
        rest = np.sqrt(1 - np.sum(np.square(correlations)))
        found = []
        for _ in range(100):
            parts = rng.standard_normal((3, 48))
            total = correlations @ parts[:2] + rest * parts[2]
            shares = {name: float(np.corrcoef(total, x)[0, 1] ** 2) for name, x in zip("ab", parts, strict=False)}
            found.append(largest(dict(sorted(shares.items(), key=lambda s: -s[1])), 48))
        return found

    assert sum(sorted(names) == ["a", "b"] for names in named([0.6, 0.6])) > 90
    assert sum(names == ["a"] for names in named([0.8, 0.3])) > 90
