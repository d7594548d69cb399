"""Two bubbles whose images overlap are two: of each its own arc is fitted, and the frame waits for a correction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from movies import movie_of

from en4dvar_movie.choice import Correction
from en4dvar_movie.merged import two_circles
from en4dvar_movie.outline import Circle
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import doubted, track

RADII = np.array([12, 16, 19, 21, 23, 24, 24, 23, 21, 19, 16, 12, 7, 12, 14, 12])


def pair(ratio, overlap, angle, seed):
    """Frames of two bubbles that grow and shrink together, and centres (2, 2) of them; the second is ``ratio`` as
    large, and the two overlap by a share of the sum of their largest radii."""
    apart = (1 - overlap) * 24 * (1 + ratio) * np.array([np.cos(angle), np.sin(angle)])
    centres = np.array([63.7, 62.2]) + np.array([[-0.5], [0.5]]) * apart
    quiet = Scene(shape=(126, 128), noise=0.0, uneven=0.0, level=5e4, bits=16)
    films = [
        np.array(list(render(r * RADII[:, None], replace(quiet, bubble=tuple(c)), np.random.default_rng(seed))), float)
        for r, c in zip((1, ratio), centres, strict=True)
    ]
    light = 3e-3 * films[0] * films[1] / 5e4
    noise = np.random.default_rng(seed).normal(0, 5, light.shape)
    return list(np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)), centres


@pytest.mark.parametrize(
    ("ratio", "overlap", "angle", "seed"),
    [
        (0.93, 0.3, 0.0, 1),
        (0.6, 0.0, 0.7, 4),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(0.93, 0.05, 2.2, 2), (0.6, 0.3, 4.0, 3), (0.4, 0.1, 1.6, 5)]
        ),
    ],
)
def test_of_bubbles_that_overlap_no_reading_is_wrong(ratio, overlap, angle, seed):
    frames, centres = pair(ratio, overlap, angle, seed)
    movie, truth = replace(movie_of(frames), rate=1.0), np.append([np.nan] * 3, RADII)
    result = track(movie, point=tuple(centres[0]))
    gap = np.hypot(*(centres[1] - centres[0])) - (1 + ratio) * truth
    for r in result.readings[3:]:
        assert not r.used or abs(r.radius - truth[r.frame]) < max(4 * r.errors.std, 0.2)
        assert not r.used or r.errors.std < 0.1 * r.radius
        assert not r.used or gap[r.frame] > 2
        assert r.used or gap[r.frame] > 2 or r.doubt.startswith("two bubbles")
        if r.doubt and r.outline is not None:  # it is the own arc that waits for a correction
            assert abs(r.outline.circle.R - truth[r.frame]) < 1
    assert sum(r.used for r in result.readings) >= 4
    assert "two bubbles: " in doubted(result.readings)


@pytest.mark.slow
def test_a_frame_of_two_bubbles_that_is_confirmed_has_the_radius_of_its_own_arc():
    frames, centres = pair(0.93, 0.2, 0.3, 1)
    largest = 3 + int(np.argmax(RADII))
    movie, correction = replace(movie_of(frames), rate=1.0), {largest: Correction(False, None, "")}
    reading = track(movie, point=tuple(centres[0]), corrections=correction).readings[largest]
    assert reading.used
    assert abs(reading.radius - RADII.max()) < 4 * reading.errors.std
    assert reading.errors.std < 0.3
    assert 0.4 < reading.outline.seen < 0.8


def discs(*circles, shape=(90, 110), squeeze=1.0):
    """A dark image (H, W) of discs, the second axis of each ``squeeze`` as long, with noise."""
    y, x = np.indices(shape)
    r = np.min([np.hypot(x - u, (y - v) / squeeze) - R for u, v, R in circles], axis=0)
    return -0.5 * np.clip(0.5 - r / 2, 0, 1) + np.random.default_rng(1).normal(0, 0.05, shape)


@pytest.mark.parametrize(
    "image",
    [
        discs((50, 45, 30)),
        discs((50, 45, 40), squeeze=0.5),
        discs((0, 45, 40)),  # cut by the frame
        discs((50, 45, 30)) - discs((50, 45, 15)),  # a bright centre
        discs((50, 45, 30)) - discs((62, 45, 13.5)),  # one beside the middle
        discs((50, 45, 30)) - discs((28, 45, 8)),  # a glint at the rim
        discs((50, 45, 25), (72, 62, 3)),  # a speck
        np.where(np.indices((90, 110))[0] < 40, np.nan, discs((50, 45, 30))),  # a part is not looked at
    ],
)
def test_one_bubble_is_one(image):
    assert two_circles(image, Circle(50, 45, 30), -0.5, 0.05) is None


@pytest.mark.parametrize("ways", [1, -1])
def test_discs_of_two_bubbles_are_found_about_either(ways):
    image = discs((40, 45, 24), (75, 40, 17))[::ways]
    for x, y, R in ((40, 45, 24), (75, 40, 17), (55, 43, 30)):
        found = two_circles(image, Circle(x, y if ways == 1 else 89 - y, R), -0.5, 0.05)
        for circle, (u, v, r) in zip(found, ((40, 45, 24), (75, 40, 17)), strict=True):
            assert np.hypot(circle.x - u, circle.y - (v if ways == 1 else 89 - v)) < 3
            assert abs(circle.R - r) < 2.5
