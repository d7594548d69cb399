"""TIFF stacks with channels or slices, and what ImageJ writes of time and of pixels."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from en4dvar.plumbing.errors import DataError
from en4dvar_movie.frames import open_movie, with_scale

FRAMES = np.random.default_rng(2).integers(0, 200, (6, 32, 48), dtype=np.uint8)
BLACK = np.zeros_like(FRAMES)
SCALE = {"unit": "um", "finterval": 1e-5}


def stack(path, frames, kind="imagej", resolution=(0.5, 0.5), **metadata):
    options = {"imagej": {"imagej": True}, "ome": {"ome": True}, "shaped": {}}[kind]
    tifffile.imwrite(path, frames, photometric="minisblack", resolution=resolution, metadata={**metadata}, **options)
    return open_movie(path)


@pytest.mark.parametrize("kind", ["imagej", "ome", "shaped"])
@pytest.mark.parametrize("axes", ["TCYX", "ZCYX", "CTYX"])
@pytest.mark.parametrize("shades", [[BLACK, FRAMES], [FRAMES // 3, FRAMES, FRAMES // 2]])
def test_channels_are_the_colours_of_a_frame(tmp_path, kind, axes, shades):
    if kind == "imagej" and axes == "CTYX":
        pytest.skip("ImageJ knows one order of axes")
    movie = stack(tmp_path / "m.tif", np.stack(shades, axis=axes.index("C")), kind, axes=axes)
    assert np.array_equal(np.array(list(movie.frames())), FRAMES)
    assert movie.count == len(FRAMES)
    assert "the channel with most light, green, is used" in movie.notes[0]


@pytest.mark.parametrize("axes", ["TYX", "ZYX", "CYX"])
def test_the_only_axis_is_time(tmp_path, axes):
    assert np.array_equal(np.array(list(stack(tmp_path / "m.tif", FRAMES, axes=axes).frames())), FRAMES)


@pytest.mark.parametrize(
    ("axes", "words"), [("TZYX", "each frame has 4 slices in depth"), ("TCYX", "each frame has 4 channels")]
)
def test_slices_and_many_channels_are_refused(tmp_path, axes, words):
    with pytest.raises(DataError, match=words):
        stack(tmp_path / "m.tif", np.stack([FRAMES] * 4, axis=1), axes=axes)


@pytest.mark.parametrize(
    ("unit", "rate"),
    [(None, 0.5), ("sec", 0.5), ("ms", 500), ("msec", 500), ("usec", 5e5), ("µs", 5e5), ("ns", 5e8)],
)
def test_the_unit_of_the_interval_is_read(tmp_path, unit, rate):
    times = {"finterval": 2.0} | ({} if unit is None else {"tunit": unit.replace("µ", "\\u00B5")})
    movie = stack(tmp_path / "m.tif", FRAMES, unit="um", **times)
    assert with_scale(movie, None, None).rate == pytest.approx(rate)


def test_an_interval_of_an_unknown_unit_is_not_used(tmp_path):
    movie = stack(tmp_path / "m.tif", FRAMES, unit="um", finterval=2.0, tunit="ticks")
    with pytest.raises(DataError, match=r"add --frame-rate '270 kHz'; its frames are 2 ticks apart, which is no known"):
        with_scale(movie, None, None)


def test_pixels_that_are_no_squares_are_not_used(tmp_path):
    movie = stack(tmp_path / "m.tif", FRAMES, resolution=(0.25, 0.125), **SCALE)
    with pytest.raises(DataError, match=r"add --pixel '2.76 um'; pixels of 4 × 8 um are no squares"):
        with_scale(movie, None, None)
    assert with_scale(movie, 4e-6, None).pixel == 4e-6
    assert "no squares" in movie.notes[0]
