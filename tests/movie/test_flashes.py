"""Several flashes in one exposure: nested circles become readings at the instants of the flashes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from movies import movie_of

from en4dvar.plumbing.units import UnitError
from en4dvar_movie.flashes import in_time, parse_flashes
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.table import Scale, to_csv
from en4dvar_movie.tracking import track

FLASHES = (0.0, 0.3, 0.6)
AT = np.arange(6)[:, None] + np.array(FLASHES)  # in frames


def path(t):
    return 36 - 9.0 * np.abs(t - 2.8)


def tracked(scene=Scene(noise=5.0), seed=1):  # noqa: B008  # a frozen value
    frames = list(render(path(AT), scene, np.random.default_rng(seed)))
    return track(replace(movie_of(frames), rate=1.0), flashes=FLASHES)


def test_circles_three_pixels_apart_are_read_at_their_flashes():
    """2.7 pixels from circle to circle, in the order of time: the smallest first while the bubble grows."""
    found = tracked()
    used = [r for r in found.readings if r.used]
    assert [(r.frame - 3, r.flash) for r in used] == [(k, f) for k in range(6) for f in range(3)]
    off = np.array([r.radius for r in used]) - path(AT).ravel()
    std = np.array([r.errors.std for r in used])
    assert np.abs(off).max() < 0.5
    assert 0.5 < np.sqrt(np.mean((off / std) ** 2)) < 1.7
    assert std.max() < 0.3


def test_a_line_of_the_table_for_each_circle():
    scale = Scale(2e-6, 1e6, 1e-7, (0.0, 0.3e-6, 0.6e-6))
    lines = [line for line in to_csv(tracked().readings, scale, "m", "c").splitlines() if line[0].isdigit()]
    assert [line.split(",")[:2] for line in lines[3:7]] == [["3", "3"], ["3", "3.3"], ["3", "3.6"], ["4", "4"]]
    assert all(line.split(",")[-2] == "1" for line in lines[3:])


def test_circles_too_close_share_their_mean_and_say_so():
    frames = list(render(np.array([[30.0, 30.8], [20.0, 26.0]]), Scene(), np.random.default_rng(2)))
    readings = track(replace(movie_of(frames), rate=1e5), flashes=(0.0, 1e-6)).readings
    close, apart = readings[3], readings[5]
    assert abs(close.radius - 30.4) < 0.1
    assert 0.3 < close.errors.std < 1.5
    assert "too close" in close.reason
    assert apart.reason == ""


@pytest.mark.parametrize("turn", [2.1, 6.4, 30.0])
def test_the_order_of_circles_is_that_of_a_smooth_history(turn):
    """Against the truth, through a maximum within a frame; the circles are given by size."""
    at = np.arange(10)[:, None] + np.array(FLASHES)
    radii = 60 - 0.7 * (at - turn) ** 2
    orders = in_time([np.sort(r)[::-1] for r in radii], np.arange(10.0), FLASHES)
    back = [np.sort(r)[::-1][list(order)] for r, order in zip(radii, orders, strict=True)]
    np.testing.assert_allclose(back, radii)


@pytest.mark.parametrize(
    ("text", "words"),
    [("2 us, 1 us", "order of time"), ("0 us,1 us,2 us,3 us,4 us,5 us", "at most 5"), ("0 us, 3", "unit")],
)
def test_flashes_that_cannot_be(text, words):
    with pytest.raises(UnitError, match=words):
        parse_flashes(text)
