"""Bubbles with a bright rim, as diffraction makes one, and bubbles whose contrast changes within the movie.

The frames are rendered apart from the program's own model: a profile over r − R, sampled on a grid three times as fine,
is blurred in two dimensions.
"""

from __future__ import annotations

import numpy as np
import pytest
from movies import film as film_plain
from movies import movie_of
from scipy.ndimage import gaussian_filter

from en4dvar_movie import background
from en4dvar_movie.background import find_background
from en4dvar_movie.kernels import residuals
from en4dvar_movie.tracking import track

FINE, SIDE, PAD, BEFORE = 3, 104, 12, 4
RADII = np.array([*np.linspace(34.0, 8.6, 9), *np.linspace(11.0, 19.0, 4), *np.linspace(17.0, 9.3, 7)])
SAME = np.ones(len(RADII))
LEVEL, DEPTH = 15_000.0, 0.6


def gaussian(height, beside, wide):
    return lambda u: height * np.exp(-0.5 * ((u - beside) / wide) ** 2)


def one_sided(height, length):
    return lambda u: height * np.exp(-np.maximum(u, 0) / length) * (u > 0)


def filmed(rim=lambda u: 0.0 * u, blur=1.2, ratio=40.0, changes=SAME, seed=0):
    """Frames, empty ones first, of a bubble that takes a share DEPTH · ``changes`` (K,) of the light; ``rim`` adds
    shares of that light, ``ratio`` is the contrast over the noise."""
    rng = np.random.default_rng(seed)
    centre = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
    side = SIDE + 2 * PAD
    y, x = (np.indices((side * FINE, side * FINE)) + 0.5) / FINE - 0.5 - PAD
    r = np.hypot(y - centre[0], x - centre[1])
    light = LEVEL * (1 + 0.04 * np.linspace(-1, 1, SIDE))
    frames = []
    for k in range(-BEFORE, len(RADII)):
        shade = np.zeros((SIDE, SIDE))
        if k >= 0:
            u = r - RADII[k]
            fine = gaussian_filter(np.clip(0.5 - FINE * u, 0, 1) - rim(u), blur * FINE)
            shade = DEPTH * changes[k] * fine.reshape(side, FINE, side, FINE).mean(axis=(1, 3))[PAD:-PAD, PAD:-PAD]
        noise = DEPTH * LEVEL / ratio * np.sqrt(0.5 + 0.5 * np.maximum(1 - shade, 0)) * rng.normal(size=(SIDE, SIDE))
        frames.append(np.rint(light * (1 - shade) + noise).astype(np.uint16))
    return frames


def errors(frames):
    """Errors of the radii in pixels, their stated std, and what all radii share; every frame must be used."""
    read = track(movie_of(frames)).readings[BEFORE:]
    assert all(r.used for r in read)
    off = np.array([r.radius for r in read]) - RADII
    std, common = np.array([(r.errors.std, r.errors.common) for r in read]).T
    return off, std, common


@pytest.mark.parametrize(
    ("rim", "blur"),
    [
        ((0.15, 3.0, 1.5), 0.7),
        ((0.4, 5.0, 2.5), 2.0),
        *(
            pytest.param(rim, blur, marks=pytest.mark.slow)
            for rim, blur in [
                ((0.15, 3.0, 1.5), 2.0),
                ((0.25, 2.0, 0.8), 0.7),
                ((0.25, 2.0, 0.8), 2.0),
                ((0.4, 5.0, 2.5), 0.7),
            ]
        ),
    ],
)
def test_a_bright_rim_moves_no_radius(rim, blur):
    off, std, common = errors(filmed(gaussian(*rim), blur))
    assert abs(np.median(off)) < 0.06
    assert np.std((off - np.median(off)) / std) < 1.5
    assert abs(np.median(off)) < np.median(common)


@pytest.mark.slow
def test_a_rim_with_which_no_outline_can_be_fitted_again_is_left_out(monkeypatch):
    again, calls = background._again, []

    def seldom(*asked):
        calls.append(asked)
        return again(*asked) if len(calls) == 1 else []

    monkeypatch.setattr(background, "_again", seldom)
    assert track(movie_of(filmed(gaussian(0.25, 2.0, 0.8))), 1).optics.rim == ()
    assert len(calls) == 2


@pytest.mark.parametrize("ratio", [8.0, pytest.param(15.0, marks=pytest.mark.slow)])
def test_a_rim_beside_noise_moves_radii_less_than_what_they_are_said_to_share(ratio):
    off, std, common = errors(filmed(gaussian(0.25, 3.0, 1.5), ratio=ratio, seed=3))
    assert abs(np.median(off)) < 0.5 * np.median(common)
    assert np.std((off - np.median(off)) / std) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("height", "length"),
    [(0.2, 3.0), (0.4, 1.5), (0.4, 3.0)],
)
def test_a_rim_of_another_shape_is_within_what_radii_are_said_to_share(height, length):
    off, _, common = errors(filmed(one_sided(height, length)))
    assert np.all(np.abs(off) < 1.2 * common)


@pytest.mark.slow
def test_a_rim_that_blur_hides_is_within_what_radii_are_said_to_share():
    off, std, common = errors(filmed(gaussian(0.25, 3.0, 1.5), blur=3.0))
    assert np.sqrt(np.mean(off**2 / (std**2 + common**2))) < 1


@pytest.mark.parametrize(
    "kind", ["bright centre", "dirt", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("in focus", "blurred"))]
)
def test_no_rim_is_seen_where_there_is_none(kind):
    assert find_background(movie_of(film_plain(kind, 1)[1]))[1].rim == ()


@pytest.mark.parametrize(
    ("last", "ratio"),
    [
        *(pytest.param(*change, marks=pytest.mark.slow) for change in ((0.9, 40.0), (0.7, 40.0))),
        (0.7, 12.0),
        (1.3, 40.0),
    ],
)
def test_a_contrast_that_changes_within_the_movie_moves_no_radius(last, ratio):
    off, std, _ = errors(filmed(ratio=ratio, changes=np.linspace(1, last, len(RADII))))
    assert np.sqrt(np.mean((off / std) ** 2)) < 2
    assert abs(np.median(off[-7:])) < 0.04


def test_a_bubble_that_glows_at_first_tells_its_contrast_itself():
    changes = SAME.copy()
    changes[:2] = 0.8, 0.9
    off, std, _ = errors(filmed(changes=changes))
    assert np.abs(off[:2]).max() < 0.05
    assert np.sqrt(np.mean((off / std) ** 2)) < 2


def test_a_rim_and_a_contrast_that_change_together_move_no_radius():
    off, _, _ = errors(filmed(gaussian(0.25, 3.0, 1.5), changes=np.linspace(1, 0.7, len(RADII))))
    assert np.sqrt(np.mean(off**2)) < 0.06


@pytest.mark.parametrize("rim", [(0.9, 2.6, 1.4), (0.0, 2.6, 1.4), ()])
def test_derivatives_of_the_model_with_and_without_a_rim_and_nested_circles(rim):
    p, parts = np.array([15.2, 14.7, 8.0, 1.3, 0.01, -0.5, 0.1, 3.0, 0.2, -0.1, 2.3, *rim]), (10, 11)
    ring, image = np.array([15.2, 14.7, 0.0, 14.0]), np.zeros((32, 32))
    _, rows, _ = residuals(image, p, parts, ring)
    assert rows.shape[1] == len(p)
    for n, step in enumerate(1e-5 * np.eye(len(p))):
        change = (residuals(image, p - step, parts, ring)[0] - residuals(image, p + step, parts, ring)[0]) / 2e-5
        np.testing.assert_allclose(rows[:, n], change, atol=1e-6)
