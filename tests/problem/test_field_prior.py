"""Priors of whole fields: the covariance that is drawn, on grids and elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import irfftn
from scipy.spatial.distance import cdist

from en4dvar.model.state import Field
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import KERNELS
from en4dvar.priors.field_prior import FieldPrior, regular_grid

GRID = np.indices((12, 9)).reshape(2, -1).T * np.array([1.0, 2.0]) + [5.0, -3.0]


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_torus_has_the_covariance_of_the_kernel_within_the_grid(kernel):
    prior = FieldPrior(Field("u", 108, coordinates=GRID), 1.0, kernel, 3.0)
    wide, amplitudes = prior._torus
    torus = irfftn(amplitudes**2, wide)
    steps = np.abs(GRID[:, None] - GRID) / [1.0, 2.0]
    found = torus[steps[..., 0].astype(int), steps[..., 1].astype(int)]
    assert found == pytest.approx(KERNELS[kernel](cdist(GRID, GRID) / 3.0), abs=1e-12)


@pytest.mark.parametrize("places", [GRID, GRID[np.random.default_rng(0).permutation(108)[:40]], GRID[:, 0] ** 1.5])
def test_draws_have_the_covariance_asked_for(places):
    prior = FieldPrior(Field("u", len(places), coordinates=places), 2.0, "matern-3/2", 3.0)
    draws = np.array([prior.draw(1, i) for i in range(3000)])
    exact = 4 * KERNELS["matern-3/2"](cdist(prior.places, prior.places) / 3.0)
    assert np.max(np.abs(np.cov(draws.T) - exact)) < 0.5  # largest of thousands of entries with std 0.1
    assert np.mean(np.cov(draws.T) - exact) == pytest.approx(0, abs=0.1)
    assert np.max(np.abs(draws.mean(axis=0))) < 0.2


def test_members_do_not_depend_on_how_many_there_are():
    prior = FieldPrior(Field("u", 108, coordinates=GRID), 1.0, "gaussian", 2.0)
    assert np.array_equal(prior.draw(3, 5), prior.draw(3, 5))
    assert not np.array_equal(prior.draw(3, 5), prior.draw(3, 6))
    assert not np.array_equal(prior.draw(3, 5), prior.draw(4, 5))


def test_grids_are_seen_and_others_are_not():
    assert regular_grid(GRID) == ((12, 9), (1.0, 2.0))
    assert regular_grid(np.arange(5.0)[:, None]) == ((5,), (1.0,))
    assert regular_grid(GRID[::-1]) is None
    assert regular_grid(GRID[:-1]) is None
    assert regular_grid(np.array([[0.0], [1.0], [3.0]])) is None


def test_a_factor_multiplies_the_values_of_the_model():
    prior = FieldPrior(Field("u", 3, coordinates=np.arange(3.0)), 0.5, "gaussian", 2.0, relative=True)
    base, drawn = np.array([1.0, 2.0, 3.0]), np.array([0.0, np.log(2), -np.log(3)])
    assert prior.applied(base, drawn) == pytest.approx([1, 4, 1])


def test_fields_that_cannot_be_drawn():
    with pytest.raises(ConfigError, match="no coordinates for u"):
        FieldPrior(Field("u", 3), 1.0, "gaussian", 1.0)
    scattered = np.random.default_rng(0).random((5001, 2))
    with pytest.raises(ConfigError, match="5001 cells on no regular grid; at most 5000"):
        FieldPrior(Field("u", 5001, coordinates=scattered), 1.0, "gaussian", 1.0)
