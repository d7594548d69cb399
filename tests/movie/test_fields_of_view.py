"""Bubbles behind a round aperture, and frames of floats, whose grey levels are shares of the light."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from movies import movie_of

from en4dvar.plumbing.errors import DataError
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track

RADII = np.array([12.3, 20.0, 31.7, 35.2, 25.5, 9.1])


def frames(seed=1, **scene):
    return list(render(RADII[:, None], Scene(**{"noise": 2.0, "uneven": 0.0, **scene}), np.random.default_rng(seed)))


@cache
def of_grey_levels(before, bright):
    """Frames, and the radii that are read from them."""
    grey = [255 - frame if bright else frame for frame in frames(before=before)]
    return grey, np.array([r.radius for r in track(movie_of(grey)).readings])


def behind(aperture, shown, outside):
    j, i = np.indices(shown[0].shape)
    dark = np.hypot(i - aperture[0], j - aperture[1]) > aperture[2]
    return [np.where(dark, np.random.default_rng(k).poisson(outside, dark.shape), f) for k, f in enumerate(shown)]


@pytest.mark.parametrize("before", [0, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("outside", "aperture"), [(2, (63.5, 63.5, 58)), (30, (63.5, 63.5, 58)), (10, (60.0, 68.0, 45))]
)
def test_a_bubble_is_read_behind_a_round_aperture(outside, before, aperture):
    found = track(movie_of(behind(aperture, frames(before=before), outside)))
    off = np.array([r.radius for r in found.readings[before:]]) - RADII
    assert np.abs(off).max() < 0.1


def test_a_bubble_is_read_where_an_aperture_cuts_it():
    found = track(movie_of(behind((75.0, 75.0, 50), frames(), 10)))
    off = np.array([r.radius for r in found.readings[3:]]) - RADII
    assert np.abs(off).max() < 0.2


def test_a_bright_bubble_in_the_middle_is_no_field_of_view():
    for before in (0, 3):
        found = track(movie_of([255 - frame for frame in frames(before=before, contrast=0.9, level=230.0)]))
        off = np.array([r.radius for r in found.readings[before:]]) - RADII
        assert np.abs(off).max() < 0.2


@pytest.mark.parametrize(
    ("light", "before", "bright"),
    [
        *((1e-6, 0, False), (1e4, 3, False), (1e4, 0, True), (1e-6, 3, True)),
        *(pytest.param(1.0, before, bright, marks=pytest.mark.slow) for before in (0, 3) for bright in (False, True)),
    ],
)
def test_frames_of_floats_are_read_as_those_of_grey_levels(light, before, bright):
    grey, radii = of_grey_levels(before, bright)
    found = track(movie_of([(light * frame / 255).astype(np.float32) for frame in grey])).readings
    np.testing.assert_allclose([r.radius for r in found], radii, atol=0.02)
    assert np.isfinite(radii[before:]).all()


def test_what_leaves_the_surround_out_is_told_where_no_bubble_is_seen():
    with pytest.raises(DataError, match="leave that out with --region or --mask"):
        track(movie_of(frames(contrast=0.01)))


@pytest.mark.parametrize("before", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_an_aperture_is_told_where_the_bubble_covers_the_brightest_of_a_vignetted_field(before):
    j, i = np.indices((128, 128)) - 63.5
    lit = [(1 - 0.4 * (i**2 + j**2) / 64**2) * frame for frame in frames(before=before)]
    found = track(movie_of([f.astype(np.uint8) for f in behind((63.5, 63.5, 58), lit, 5)]))
    off = np.array([r.radius for r in found.readings[before:]]) - RADII
    assert np.abs(off).max() < 0.1


@pytest.mark.parametrize("moves", [0.0, pytest.param(6.0, marks=pytest.mark.slow)])
def test_an_outline_that_stands_still_in_all_frames_is_told(moves):
    radii = 40 + moves * np.sin(np.arange(12.0))[:, None]
    found = track(movie_of(list(render(radii, Scene(noise=2.0, before=0), np.random.default_rng(1)))))
    assert sum(r.used for r in found.readings) == 12
    assert any("the same in all frames" in note for note in found.notes) == (moves == 0)
