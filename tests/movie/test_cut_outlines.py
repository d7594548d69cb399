"""Bubbles that the frame's edge cuts in every frame: circles and ellipses, drawn apart from the program's own renderer.

A disc is sampled on a grid three times as fine, blurred and averaged over pixels.
"""

from __future__ import annotations

import numpy as np
import pytest
from movies import movie_of
from scipy.ndimage import gaussian_filter

from en4dvar_movie.tracking import track

FINE, PAD, BEFORE, SHAPE = 3, 8, 4, (84, 96)
RADII = 24 + 3 * np.sin(np.arange(6.0))


def filmed(ratio, angle, centre, noise, seed=0):
    """Frames, empty ones first, and the mean radii (K,) of an ellipse of this ratio of its axes; ``angle`` in degrees,
    ``centre`` x and y, ``noise`` as a share of the contrast."""
    rng = np.random.default_rng(seed)
    height, width = (FINE * (side + 2 * PAD) for side in SHAPE)
    y, x = (np.indices((height, width)) + 0.5) / FINE - 0.5 - PAD
    turn = np.exp(-1j * np.deg2rad(angle))
    place = (x - centre[0] + 1j * (y - centre[1])) * turn
    size = np.hypot(place.real / ratio**0.5, place.imag * ratio**0.5)
    frames = []
    for R in (*np.zeros(BEFORE), *RADII):
        fine = gaussian_filter((size < R).astype(float), 1.2 * FINE)
        shade = fine.reshape(SHAPE[0] + 2 * PAD, FINE, -1, FINE).mean(axis=(1, 3))[PAD:-PAD, PAD:-PAD]
        frames.append(np.rint(12_000 * (1 - 0.55 * (shade + noise * rng.normal(size=SHAPE)))).astype(np.uint16))
    around = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    return frames, RADII * np.mean(1 / np.hypot(np.cos(around) / ratio**0.5, np.sin(around) * ratio**0.5))


def readings(*drawn):
    frames, radii = filmed(*drawn)
    read = track(movie_of(frames)).readings[BEFORE:]
    assert all(r.used for r in read)
    return np.array([r.radius for r in read]) - radii, np.array([r.errors.std for r in read])


CORNER, TOP = (15.0, 15.0), (47.0, 9.0)


@pytest.mark.parametrize("centre", [CORNER, TOP])
def test_a_circle_that_the_frame_cuts_is_as_exact_as_before(centre):
    off, std = readings(1.0, 0.0, centre, 0.05)
    assert np.abs(off).max() < 0.12
    assert np.abs(off / std).max() < 4
    assert np.median(std) < 0.06


@pytest.mark.parametrize("noise", [pytest.param(0.03, marks=pytest.mark.slow), 0.12])
@pytest.mark.parametrize(("ratio", "angle", "centre"), [(1.1, 10, TOP), (1.2, 130, CORNER), (1.3, 45, CORNER)])
def test_of_an_ellipse_that_the_frame_always_cuts_the_error_holds_the_radius(ratio, angle, centre, noise):
    off, std = readings(ratio, angle, centre, noise)
    assert np.abs(off / std).max() < 2.5
    assert std.max() < 3 * np.abs(off).max()  # no wider than needed
