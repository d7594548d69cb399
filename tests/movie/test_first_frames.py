"""Movies whose first frames show the bubble are read without them as background, whatever shape the frame leaves."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from movies import movie_of
from scipy import ndimage
from scipy.special import expit

from en4dvar.plumbing.errors import DataError
from en4dvar_movie.tracking import track

COLLAPSE = [*(62 * (1 - np.linspace(0, 0.97, 14) ** 2) ** 0.5), 24.0, 32, 36, 37, 36, 32, 25, 20, 24, 26, *[22.0] * 26]
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]


def filmed(shape, ratio=1.0, upright=False, off=(0.0, 0.0), radii=COLLAPSE, empty=0, seed=1):
    """Frames of ellipses of these mean radii, whose axes have a ratio and whose centre is ``off`` the frame's middle,
    along and across the long axis; ``empty`` frames come first."""
    noise = np.random.default_rng(seed)
    y, x = (np.arange(side) - (side - 1) / 2 for side in shape)
    long, short = (y[:, None], x) if upright else (x, y[:, None])
    long, short = long - off[0], short - off[1]
    frames = []
    for R in [0.01] * empty + list(radii):
        rho = np.hypot(long / ratio**0.5, short * ratio**0.5)
        shade = expit((R - rho) / 0.7)
        light = 150 * (1 + 0.0005 * (x + y[:, None])) * (1 - 0.6 * shade)
        frames.append(np.clip(np.rint(light + noise.normal(0, 3, shape)), 0, 255).astype(np.uint8))
    return frames


def wrong(readings, radii):
    """Used frames whose radius is not the true one."""
    return [
        r.frame
        for r, R in zip(readings, radii, strict=True)
        if r.used and abs(r.radius - R) > max(2, 5 * np.hypot(r.errors.std, r.errors.factor * R))
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "ratio", "upright", "off"),
    [
        ((96, 128), 1.0, False, (0, 0)),
        ((96, 128), 1.2, False, (0, 0)),
        ((96, 128), 1.2, True, (0, 0)),
        ((128, 128), 1.4, False, (0, 0)),
        ((128, 96), 1.3, False, (0, 0)),
        ((64, 192), 1.15, True, (0, 0)),
        ((112, 160), 1.3, False, (0, 30)),
        ((112, 160), 1.2, False, (45, 10)),
        ((84, 92), 1.2, False, (0, 0)),
    ],
)
def test_a_large_bubble_of_the_first_frames_is_no_background(shape, ratio, upright, off):
    result = track(movie_of(filmed(shape, ratio, upright, off)))
    assert result.background.frames == 0
    assert wrong(result.readings, COLLAPSE) == []
    assert sum(r.used for r in result.readings) > 0.8 * len(COLLAPSE)
    rest = [r.radius for r in result.readings[-20:]]
    assert abs(np.mean(rest) / 22 - 1) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    "radii",
    [
        COLLAPSE,
        COLLAPSE[::-1],
        [95.0] * 2 + [40.0] * 20 + [30.0] * 3,
    ],
)
def test_empty_frames_before_a_bubble_that_the_frame_cuts_are_the_background(radii):
    result = track(movie_of(filmed((96, 128), 1.2, radii=radii, empty=4)))
    assert result.background.frames == 4
    assert wrong(result.readings, [0.0] * 4 + list(radii)) == []


MOSTLY_COVERED = [*(90 * (1 - np.linspace(0, 0.97, 20) ** 2) ** 0.5), 30.0, 50, 64, 70, 71, 70, 64, 52, *[60.0] * 32]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "off"),
    [
        ((96, 144), (0, 0)),
        ((112, 160), (10, 6)),
        ((64, 192), (-9, 2)),
    ],
)
def test_a_bubble_that_covers_most_of_most_frames_is_read_by_its_arcs(shape, off):
    result = track(movie_of(filmed(shape, off=off, radii=MOSTLY_COVERED)))
    assert result.background.frames == 0
    assert wrong(result.readings, MOSTLY_COVERED) == []
    rest = [r.radius for r in result.readings[-30:] if r.used]
    assert len(rest) > 25
    assert abs(np.mean(rest) / 60 - 1) < 0.01


def test_a_bubble_that_leaves_hardly_any_background_to_be_seen_is_refused():
    radii = 1.2 * np.array(MOSTLY_COVERED)
    with pytest.raises(
        DataError, match="no frame is empty, and beside any smooth background hardly anything has a round"
    ):
        track(movie_of(filmed((96, 144), radii=radii)))


def glaring(shape, off, radii, glare, depth, dirt, seed, bright=False):
    """Frames of discs that are dark, or ``bright`` in a dark field, whose middle shows the lamp within a share of their
    radius; ``dirt`` is the relative std of a lasting texture of the light."""
    noise = np.random.default_rng(seed)
    y, x = (np.arange(side) - (side - 1) / 2 for side in shape)
    rho = np.hypot(x - off[0], y[:, None] - off[1])
    texture = ndimage.gaussian_filter(noise.normal(size=shape), 2)
    light = 150 * (1 + 0.0004 * (x + y[:, None])) * (1 + dirt * texture / texture.std())
    frames = []
    for R in radii:
        shade = depth * (expit((R - rho) / 0.7) - 0.7 * expit((glare * R - rho) / 0.7))
        image = 15 + 0.15 * light + 150 * shade if bright else light * (1 - shade)
        frames.append(np.clip(np.rint(image + noise.normal(0, 2.5, shape)), 0, 255).astype(np.uint8))
    return frames


SLOW_COLLAPSE = [*(54.4 * (1 - np.linspace(0, 0.88, 14) ** 2) ** 0.5), *(30 + 15.5 * np.linspace(0, 1, 8) ** 0.5)]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dark_bubble_with_a_bright_middle_is_not_taken_for_a_bright_one(seed):
    result = track(movie_of(glaring((128, 128), (-9.5, 6.4), SLOW_COLLAPSE, 0.36, 0.39, 0.02, seed)))
    assert wrong(result.readings, SLOW_COLLAPSE) == []
    assert sum(r.used for r in result.readings) > 0.8 * len(SLOW_COLLAPSE)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_dark_middle_of_a_bubble_that_fills_a_dark_field_is_not_taken_for_the_bubble(seed):
    radii = 52.2 + 1.5 * np.sin(np.arange(12) / 2)
    result = track(movie_of(glaring((127, 112), (0, 0), radii, 0.37, 0.68, 0.08, seed, bright=True)))
    assert wrong(result.readings, radii) == []
    assert sum(r.used for r in result.readings) > 8


@pytest.mark.slow
@pytest.mark.parametrize("swing", [0.25, 0.5, 1.28])  # to each side
@pytest.mark.parametrize(("glare", "dirt"), [(0.0, 0.02), (0.37, 0.02), (0.37, 0.08)])
@pytest.mark.parametrize(
    ("radius", "shape", "off"),
    [(42.6, (127, 112), (0, 0)), (25.0, (128, 160), (5, -4))],
)
def test_a_bright_bubble_whose_edge_moves_by_half_a_pixel_is_no_aperture(radius, shape, off, glare, dirt, swing):
    radii = radius + swing * np.sin(np.arange(12) / 2)
    movie = movie_of(glaring(shape, off, radii, glare, 0.68, dirt, 2, bright=True))
    with contextlib.nullcontext() if swing > 0.3 else contextlib.suppress(DataError):  # it may be refused
        result = track(movie, 1)
        assert wrong(result.readings, radii) == []
        assert all(r.used for r in result.readings)


@pytest.mark.parametrize(("flash", "empty"), [(1.5, 3), (5.0, 1)])
def test_a_movie_may_begin_with_a_flash(flash, empty):
    """Which is no background: beside it nothing was read, or radii were half a pixel off."""
    radii = np.linspace(20, 7, 8)
    lamp = 1 - 0.3 * np.linspace(-1, 1, 72)[:, None] ** 2 - 0.2 * np.linspace(-1, 1, 80) ** 2
    shown = [
        frame * lamp * (flash if n == 0 else 1) for n, frame in enumerate(filmed((72, 80), radii=radii, empty=empty))
    ]
    readings = track(movie_of([np.minimum(frame, 255).astype(np.uint8) for frame in shown])).readings
    assert [r.frame for r in readings if not r.used] == list(range(empty))
    np.testing.assert_allclose([r.radius for r in readings[empty:]], radii, atol=0.15)
