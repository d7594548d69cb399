"""The aquifer against closed forms, and a field that localisation finds where the whole ensemble does not."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.descent.field import FieldData, field_en4dvar
from en4dvar.schemes.local_gain import ByDistance
from en4dvar_diffusion import Aquifer, gaussian_fields


def test_steady_heads_are_those_of_poissons_equation():
    """h at the centre of a square of side L with h = 0 around it is 0.0736713 recharge L²/T: Timoshenko's series."""
    side = 41
    aquifer = Aquifer((side, side), np.array([side**2 // 2]), reads=(60,), dt=50.0)
    head = aquifer(np.full((1, side**2), np.log(2.0)))[0, 0]
    assert head == pytest.approx(0.0736713 * 0.01 * side**2 / 2, rel=2e-3)


def test_heads_between_strips_are_those_in_series():
    """Steady flow through strips of T across x obeys d/dx(T dh/dx) = −recharge far from the ends of a long strip."""
    rows, columns = 400, 20
    T = np.where(np.arange(columns) < 10, 1.0, 4.0)
    middle = rows // 2 * columns + np.arange(columns)
    aquifer = Aquifer((rows, columns), middle, reads=(80,), dt=200.0)
    head = aquifer(np.log(np.tile(T, rows))[None])[0]
    # by hand: T h' = c − recharge x, h continuous, h(0) = h(20) = 0
    c = (0.01 * 10**2 / 2 + 0.01 * (20**2 - 10**2) / 8) / (10 + 10 / 4)
    assert np.diff(head[:10]) == pytest.approx(c - 0.01 * np.arange(1, 10), rel=5e-3)
    assert np.diff(head[10:]) == pytest.approx((c - 0.01 * np.arange(11, 20)) / 4, rel=5e-3)
    assert head[10] - head[9] == pytest.approx((c - 0.1) * (0.5 + 0.5 / 4), rel=5e-3)


def test_fields_have_the_covariance_asked_for():
    fields = gaussian_fields((12, 12), 3.0, 4000, np.random.default_rng(0))
    covariance = np.cov(fields.T)
    places = np.indices((12, 12)).reshape(2, -1).T
    squares = np.sum((places[:, None] - places[None]) ** 2, axis=-1)
    assert np.max(np.abs(covariance - np.exp(-0.5 * squares / 9))) < 0.12
    assert np.mean(covariance - np.exp(-0.5 * squares / 9)) == pytest.approx(0, abs=0.02)


def test_a_field_is_found_by_localised_en4dvar():
    rng, shape = np.random.default_rng(2), (20, 20)
    aquifer = Aquifer(shape, np.sort(rng.choice(400, 40, replace=False)), reads=(2, 6))
    truth, *prior = gaussian_fields(shape, 4.0, 31, rng)
    ensemble, heads = np.array(prior), aquifer(truth[None])[0]
    std = np.full(len(heads), 0.01 * heads.max())
    data = FieldData(heads + std * rng.standard_normal(len(heads)), std, aquifer)
    before = np.sqrt(np.mean((ensemble.mean(axis=0) - truth) ** 2))
    end = field_en4dvar(ensemble, data, ByDistance(aquifer.places, aquifer.observed, 8.0), max_iterations=5)
    error = np.sqrt(np.mean((ensemble.mean(axis=0) - truth) ** 2))
    spread = np.sqrt(np.mean(ensemble.var(axis=0, ddof=1)))
    assert end.costs[-1] < 0.2 * end.costs[0]
    assert error < 0.6 * before
    assert 0.7 < spread / error < 2.5
