"""A camera that drifts over a background with structure: the background is moved with it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from movies import movie_of
from scipy import ndimage

from en4dvar_movie.drifting import drift_of
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track

RADII = 10 + 22 * np.abs(np.cos(np.arange(30) * np.pi / 16))
BEFORE = 3


def drifting(across, down, structure=8.0, seed=3, drift=True):
    """Frames of a bubble that is still in the scene, where ``structure`` is the std of the background's grey levels."""
    rng = np.random.default_rng(seed)
    gel = ndimage.gaussian_filter(rng.normal(size=(220, 220)), 2.0)
    shown = []
    for k in range(-BEFORE, len(RADII)):
        at = (52.0 + across * k, 60.0 + down * k)
        scene = Scene((112, 112), noise=0.0, uneven=0.0, before=0, bubble=at)
        shade = next(render(RADII[[max(k, 0)], None], scene, rng)) / 150.0 if k >= 0 else np.ones((112, 112))
        moved = ndimage.shift(gel / gel.std(), (down * k, across * k) if drift else 0.0, order=3)[60:172, 60:172]
        shown.append(
            np.rint((150 + structure * moved) * shade + rng.normal(scale=3.0, size=shade.shape)).astype(np.uint8)
        )
    return shown


@pytest.mark.slow
@pytest.mark.parametrize(("across", "down"), [(0.3, 0.15), (-0.4, 0.3), (0.0, -0.8)])
def test_radii_are_read_before_a_background_that_drifts(across, down):
    found = track(movie_of(drifting(across, down)))
    off = np.array([r.radius for r in found.readings[BEFORE:]]) - RADII
    assert np.isfinite(off).all()
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert 0.6 < np.std([o / r.errors.std for o, r in zip(off, found.readings[BEFORE:], strict=True)]) < 1.4
    (note,) = found.notes
    told = [int(number) for number in re.findall(r"-?\d+", note)]
    np.testing.assert_allclose(told, np.multiply([across, down], len(RADII) + BEFORE - 1), atol=1)
    x = [r.outline.circle.x for r in found.readings[BEFORE:]]
    np.testing.assert_allclose(x, 52.0 + across * np.arange(len(RADII)), atol=0.2)  # of the frame, not of the scene


@pytest.mark.parametrize(("structure", "noisy"), [(0.0, False), (8.0, False), (8.0, True)])
def test_a_bubble_that_moves_before_a_background_at_rest_is_no_drift(structure, noisy):
    shown = drifting(0.4, 0.2, structure, drift=False)
    if noisy:
        shown = list(np.random.default_rng(1).normal(shown, 20.0))
    assert drift_of(shown, range(len(shown))) is None
    assert drift_of(shown[BEFORE:], range(len(RADII))) is None
    assert drift_of(shown[:1], range(1)) is None
