"""Saturated light: where an edge lies is less well known, or not at all, where light hides it or is cut off."""

from __future__ import annotations

import numpy as np
import pytest
from movies import movie_of
from scipy import ndimage
from scipy.special import expit

from en4dvar_movie.background import _outside
from en4dvar_movie.outline import Optics
from en4dvar_movie.tracking import track
from en4dvar_movie.uncertainty import with_hidden

SHAPE, CENTRE = (96, 112), (55.3, 47.6)
RADII = np.array([14.0, 19, 22, 24, 25, 25, 24, 22, 19, 14, 9, 13, 16, 17, 16, 13])
Y, X = np.indices(SHAPE)
FAR = np.hypot(X - CENTRE[0], Y - CENTRE[1])


def filmed(light=150.0, spot=0.0, empty=0, shade=0.75, radii=RADII):
    """Frames of floats: dark discs in some light, with a bright middle that takes a share of the radius."""
    noise = np.random.default_rng(1)
    images = []
    for R in [-20.0] * empty + list(radii):
        image = light * (1 - shade * expit((R - FAR) / 0.5))
        image += 500 * expit((spot * R - FAR) / 0.4) if spot else 0
        images.append(image + noise.normal(0, 2, SHAPE))
    return images


def of_8_bit(images):
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images]


def off(readings, radii=RADII):
    return np.array([r.radius for r in readings]) - radii - 0.4 / radii


def stepped(image, levels):
    return np.rint(np.rint(image / 255 * (levels - 1)) * 255 / (levels - 1))


def equalised(image, power=1.0):
    counts = np.cumsum(np.bincount(image.ravel(), minlength=256) ** power)
    return (255 * counts / counts[-1]).round().astype(np.uint8)[image]


LEVELS = {
    "4 levels": (lambda image: stepped(image, 4), "few grey levels"),
    "8 levels": (lambda image: stepped(image, 8), "few grey levels"),
    "equalised": (equalised, "equalised the histogram"),
    "by roots": (lambda image: equalised(image, 0.5), "equalised the histogram"),
    "64 levels": (lambda image: stepped(equalised(image).astype(float), 64), "equalised the histogram"),
    "smooth": (lambda image: image, ""),
    "stretched": (lambda image: np.clip(1.4 * image, 0, 255), ""),
    "16 bit": (lambda image: 200.0 * image + np.random.default_rng(1).integers(0, 200, image.shape), ""),
}


@pytest.mark.parametrize("name", LEVELS)
def test_grey_levels_that_tell_little_of_the_light_are_told(name):
    change, words = LEVELS[name]
    shown = [change(image).astype(np.uint16 if name == "16 bit" else np.uint8) for image in of_8_bit(filmed())]
    grey = float(np.ptp(shown[0])) / 0.8
    optics = with_hidden(Optics(-0.75, 0.6, noise=0.01), shown, 0.0, grey)
    assert words in optics.hides
    assert bool(words) == (optics.hidden > 0.3)


def test_a_single_step_of_grey_levels_is_told_in_the_singular():
    dark = np.hypot(*(np.indices(SHAPE) - 48)) < 30
    shown = [np.where(dark, 0, 128).astype(np.uint8)]
    told = with_hidden(Optics(-0.75, 0.6, noise=0.01), shown, 0.0, 160.0).hides
    assert told.endswith("few grey levels, 1 step from the bubble to the light about it")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["4 levels", "8 levels", "equalised", "by roots"])
def test_the_common_error_holds_what_few_grey_levels_do(name):
    """Radii were 0.3 to 0.8 (few levels) and 1.4 pixels (equalised) off, where 0.05 to 0.08 were stated."""
    shown = [LEVELS[name][0](image).astype(np.uint8) for image in of_8_bit(filmed(empty=2))]
    result = track(movie_of(shown))
    readings = result.readings[2:]
    scores = np.abs(off(readings)) / [np.hypot(r.errors.std, r.errors.common) for r in readings]
    assert np.nanmedian(scores) < 2.5
    assert any(LEVELS[name][1] in note for note in result.notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shown",
    [
        [255 * (image > 75).astype(np.uint8) for image in filmed()],
        [255 * (image > 130).astype(np.uint8) for image in filmed()],
        of_8_bit(filmed(light=400.0)),
        of_8_bit([3 * (160 - image) for image in filmed()]),
    ],
    ids=["low", "high", "light", "bubble"],
)
def test_edges_beside_which_frames_are_saturated_may_all_be_off(shown):
    result = track(movie_of(shown))
    errors = [r.errors for r in result.readings]
    assert np.median([np.abs(off(result.readings)) / np.hypot(e.std, e.common) for e in errors]) < 2
    assert all(0.5 <= e.common < 1 for e in errors)
    assert max(e.std for e in errors) < 0.3
    assert any("black and white alone" in note for note in result.notes)


@pytest.mark.parametrize(
    "shown",
    [of_8_bit(filmed(light=225.0)), [np.rint(image + 865).astype(np.uint16) for image in filmed()]],
    ids=["of 8 bit", "of 12 bit, near 1023"],
)
def test_edges_in_light_that_is_not_saturated_are_not_said_to_be_off(shown):
    result = track(movie_of(shown))
    assert np.abs(off(result.readings)).max() < 0.1
    assert max(r.errors.common for r in result.readings) < 0.3
    assert not any("saturated" in note for note in result.notes)


@pytest.mark.parametrize("spot", [0.45, pytest.param(0.6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("empty", [0, pytest.param(4, marks=pytest.mark.slow)])
def test_a_saturated_middle_of_a_bubble_in_an_aperture_is_not_the_bubble(spot, empty):
    outside = np.hypot(X - 55.5, Y - 47.5) > 46
    light = 130 * (1 - 0.4 * ((X - 55.5) ** 2 + (Y - 47.5) ** 2) / 46**2)
    shown = of_8_bit([np.where(outside, 4, image) for image in filmed(light, spot, empty)])
    readings = track(movie_of(shown)).readings[empty:]
    assert sum(r.used for r in readings) > 0.8 * len(RADII)
    assert np.nanmax(np.abs(off(readings))) < 0.2


@pytest.mark.parametrize("aside", [0.0, *(pytest.param(aside, marks=pytest.mark.slow) for aside in (11.0, 13.0))])
def test_a_frame_in_which_the_laser_s_light_covers_a_part_of_the_outline_is_doubtful(aside):
    images = filmed(empty=3)
    images[3] = images[3] + 2000 * np.exp(-0.5 * ((X - CENTRE[0] - aside) ** 2 + (Y - CENTRE[1]) ** 2) / 2.2**2)
    first, *others = track(movie_of(of_8_bit(images))).readings[3:]
    assert all(r.used for r in others)
    assert first.used == (aside == 0)
    assert first.used or first.reason.startswith("light: a part of the outline is saturated")


@pytest.mark.parametrize("empty", [0, pytest.param(4, marks=pytest.mark.slow)])
def test_a_luminous_bubble_beside_a_bright_needle_is_no_field_of_view(empty):
    radii = 20 + 1.7 * np.sin(np.arange(16))
    needle = (X < 45) & (np.abs(Y - 47) < 3)
    images = [np.where(needle, 700, 140 - image) for image in filmed(120.0, empty=empty, radii=radii)]
    shown = of_8_bit([ndimage.gaussian_filter(image, 0.4) for image in images])
    assert not _outside(shown).any()
    readings = track(movie_of(shown)).readings[empty:]
    assert np.abs(off(readings, radii)).max() < 0.2
