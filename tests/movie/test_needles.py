"""A needle that stands in the picture from the first frame to the last is no bubble, whether or not it reaches one."""

from __future__ import annotations

import numpy as np
import pytest
from movies import movie_of
from scipy import ndimage
from scipy.special import expit

from en4dvar_movie.tracking import track

SHAPE, CENTRE = (120, 144), (71.4, 60.3)
RADII = [*(36 * (1 - np.linspace(0, 0.98, 12) ** 2) ** 0.5), 9.0, 11, 10, 7, 5.5, 6.3, 6.8, *[6.5] * 5]


def filmed(shade, radii=RADII, centre=CENTRE, seed=1, bright=False, scatter=2.5, stretch=1.0):
    """Frames of discs, or ellipses ``stretch`` times as wide as high, behind what stands still and lets through all but
    a ``shade`` (H, W) of the light.
    """
    noise = np.random.default_rng(seed)
    y, x = np.indices(SHAPE)
    frames = []
    for R in radii:
        light = 150 - 120 * expit((R - np.hypot((x - centre[0]) / stretch**0.5, (y - centre[1]) * stretch**0.5)) / 0.6)
        frame = light * (1 - 0.85 * shade) + noise.normal(0, scatter, SHAPE)
        frames.append(np.clip(np.rint(255 - frame if bright else frame), 0, 255).astype(np.uint8))
    return frames


def off(readings, radii):
    """By how much radii (K,) are wrong, NaN where not used: a blurred disc's edge is half dark a little outside it."""
    return np.array([r.radius for r in readings]) - radii - 0.6 / np.asarray(radii)


def needle(towards, gap, width, point=0.0, blur=0.8, centre=CENTRE):
    """From the border to a ``gap`` from a place, ``towards`` which it lies (degrees from x to y); it gets thinner over
    the length of its ``point``."""
    y, x = np.indices(SHAPE)
    way = np.deg2rad(towards)
    along = (x - centre[0]) * np.cos(way) + (y - centre[1]) * np.sin(way) - gap
    across = np.abs((y - centre[1]) * np.cos(way) - (x - centre[0]) * np.sin(way))
    return ndimage.gaussian_filter((across < width / 2 * np.clip(along / (point + 0.1), 0, 1)).astype(float), blur)


@pytest.mark.parametrize(
    ("towards", "gap", "width", "point"),
    [
        (-90, 10, 20, 0),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(-90, 8, 8, 0), (0, 3, 10, 0), (-40, 10, 12, 0), (90, 16, 28, 0), (180, 4, 12, 30)]
        ),
    ],
)
def test_a_needle_that_stands_there_throughout_is_no_bubble(towards, gap, width, point):
    movie = movie_of(filmed(needle(towards, gap, width, point)))
    result = track(movie)
    assert result.background.frames == 0
    wrong = off(result.readings, RADII)
    assert np.sum(np.isfinite(wrong)) >= len(RADII) - 1
    assert np.nanmax(np.abs(wrong)) < 0.15
    (note,) = movie.notes
    assert "what stands still about" in note


@pytest.mark.slow
def test_electrodes_and_a_needle_of_a_dark_field():
    both = needle(0, 8, 9) + needle(180, 9, 9)
    for shown in (filmed(both), filmed(needle(-90, 9, 12), bright=True)):
        wrong = off(track(movie_of(shown)).readings, RADII)
        assert np.sum(np.isfinite(wrong)) >= len(RADII) - 1
        assert np.nanmax(np.abs(wrong)) < 0.15


@pytest.mark.parametrize("swing", [1.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_bubble_at_rest_at_a_needle_is_told_from_it(swing):
    radii = 20 + swing * np.sin(np.arange(24) / 3)
    wrong = off(track(movie_of(filmed(needle(-90, 14, 10), radii))).readings, radii)
    assert np.abs(wrong).max() < 0.15


@pytest.mark.parametrize("swing", [0.0, *(pytest.param(swing, marks=pytest.mark.slow) for swing in (0.2, 1.0))])
def test_a_bubble_at_rest_that_the_frame_cuts_is_no_needle(swing):
    radii = 20 + swing * np.sin(np.arange(24) / 3)
    wrong = off(track(movie_of(filmed(0.0, radii, (7.3, 60.2)))).readings, radii)
    assert np.abs(wrong).max() < 0.15


@pytest.mark.slow
def test_a_small_bubble_of_which_a_mask_leaves_most_is_read_as_sharp_as_the_movie_is():
    shade = needle(-90, 9, 18)
    watched = ndimage.gaussian_filter(shade, 2) < 0.01
    wrong = off(track(movie_of(filmed(shade)), watched=watched).readings, RADII)
    assert np.sum(np.isfinite(wrong)) >= len(RADII) - 1
    assert np.nanmax(np.abs(wrong)) < 0.15


@pytest.mark.slow
def test_a_frame_that_is_there_twice_is_no_second_reading_and_is_told():
    frames = filmed(0.0)
    twice = [k for k in range(len(frames)) for _ in range(2 if k in (4, 20, 21) else 1)]
    result = track(movie_of([frames[k] for k in twice]))
    copies = [r.frame for r in result.readings if r.reason.startswith("copy: ")]
    assert copies == [5, 22, 24]
    assert not any(result.readings[k].used for k in copies)
    (note,) = result.notes
    assert "as the frame before, and so not used: 5, 22, 24; if a conversion" in note
    wrong = off(result.readings, np.array(RADII)[twice])
    assert np.sum(np.isfinite(wrong)) >= len(RADII) - 1
    assert np.nanmax(np.abs(wrong)) < 0.15


def test_frames_of_a_movie_without_noise_may_be_the_same():
    texture = np.random.default_rng(3).uniform(0, 0.1, SHAPE)
    movie = movie_of(filmed(texture, scatter=0.0))
    wrong = off(track(movie).readings, RADII)
    assert not movie.copies
    assert np.sum(np.isfinite(wrong)) >= len(RADII) - 1
    assert np.nanmax(np.abs(wrong)) < 0.15


@pytest.mark.slow
def test_an_ellipse_at_rest_at_a_needle_is_told_from_it():
    radii = np.array([*np.linspace(34, 15, 6), *(11 + 0.5 * np.sin(np.arange(22)))])
    result = track(movie_of(filmed(needle(-90, 10, 6), radii, stretch=1.27)))
    wrong = off(result.readings, radii)
    assert np.sum(np.isfinite(wrong)) >= len(radii) - 2
    assert np.nanmax(np.abs(wrong)) < 0.5
    assert np.nanmax(np.abs(wrong) / [max(r.errors.std, 0.1) if r.used else 1 for r in result.readings]) < 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "radii",
    [
        [22.0, 21.1, 20.3, 19.4, 18.6, *[17.7] * 25],
        17 + np.sin(np.arange(30) / 2),
    ],
)
def test_half_a_disc_at_a_wall_is_told_from_a_needle_that_reaches_into_it(radii):
    centre = (70.0, SHAPE[0] - 0.5)
    result = track(movie_of(filmed(needle(180, 10, 6, centre=(70.0, 111.0)), radii, centre)))
    assert np.abs(off(result.readings, radii)).max() < 0.2
    assert np.median([r.errors.std for r in result.readings]) < 0.1


@pytest.mark.parametrize("unread", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_several_frames_that_cannot_be_read_make_what_stands_still_doubtful(unread):
    radii = [30.0, 26, 22, 18, 15, *[12.0] * 10]
    frames = filmed(0.0, radii)
    for frame in frames[6 : 6 + unread]:
        frame[58:63, 10:130] = 30
    result = track(movie_of(frames))
    assert sum(not r.used for r in result.readings) == unread
    assert len(result.notes) == (unread > 1)
