"""Intervals between members hold what they say, for ensembles whose moments are exact and for plain draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.priors.prior import whiten_sample

REPEATS = 4000


def held(members: int, exact: bool, quantiles) -> float:
    """The probability of N(0, 1) between the 5 and 95 % quantiles, on average."""
    z = np.random.default_rng(3).standard_normal((members, REPEATS))
    if exact:  # each column by itself
        z = np.column_stack([whiten_sample(z[:, [j]]) for j in range(REPEATS)])
    low, high = quantiles(z, (0.05, 0.95), axis=0)
    return float(np.mean(ndtr(high) - ndtr(low)))


@pytest.mark.parametrize("members", [16, 48, 200])
def test_ninety_per_cent_of_an_exact_ensemble_are_ninety(members):
    assert held(members, True, member_quantiles) == pytest.approx(0.9, abs=0.003)
    assert held(members, True, np.quantile) < 0.9 - 0.9 / members


def test_of_plain_draws_a_little_less():
    """Two moments that are estimated cost 1/N of the probability, whatever the places of the quantiles."""
    assert 0.88 < held(48, False, member_quantiles) < 0.9
    assert held(48, False, np.quantile) < 0.87


def test_lost_members_do_not_count():
    values = np.array([[1.0, 5.0], [2.0, np.nan], [3.0, 6.0], [4.0, 7.0]])
    both = member_quantiles(values, (0.25, 0.5), axis=0)
    np.testing.assert_allclose(both[:, 1], member_quantiles(np.array([5.0, 6.0, 7.0]), (0.25, 0.5)))
    np.testing.assert_allclose(both[:, 0], member_quantiles(values[:, 0], (0.25, 0.5)))
