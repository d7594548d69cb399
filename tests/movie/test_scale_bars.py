"""White scale bars that are burnt into the frames are neither bubble nor background, and no camera moves them."""

from __future__ import annotations

import numpy as np
import pytest
from movies import movie_of
from scipy import ndimage
from scipy.special import expit

from en4dvar_movie.burnt import burnt_in, margins
from en4dvar_movie.tracking import track

RADII = np.array([*(52 * (1 - np.linspace(-0.95, 0.97, 14) ** 2) ** 0.5), 16, 19, 20, 19, 16, 12, 14, 15, *[13] * 4])


def barred(empty=0, drift=(0.0, 0.0), texture=0.0, seed=1):
    """Frames of dark bubbles in vignetted light, with a scale bar; structure of the light drifts by so much a frame."""
    noise = np.random.default_rng(seed)
    y, x = np.mgrid[:160, :160]
    structure = texture * ndimage.gaussian_filter(noise.normal(size=(220, 220)), 2) / 0.14
    light = 150 * (1 - 0.35 * ((x - 80) ** 2 + (y - 80) ** 2) / 113**2)
    frames = []
    for number, R in enumerate([0.01] * empty + list(RADII)):
        down, across = (round(step * number) for step in drift)
        still = light * (1 + structure[30 - down : 190 - down, 30 - across : 190 - across])
        image = still * (1 - 0.75 * expit((R - np.hypot(x - 82 - across, y - 78 - down)) / 0.7))
        image = image + noise.normal(0, 3, image.shape)
        image[146:150, 90:140] = image[138:144, 110:112] = image[138:144, 116:118] = 255
        frames.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return frames


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("empty", "drift", "texture"), [(0, (0.0, 0.0), 0.0), pytest.param(5, (0.25, 0.4), 0.02, marks=pytest.mark.slow)]
)
def test_a_bubble_beside_a_scale_bar_is_read(empty, drift, texture, seed):
    movie = movie_of(barred(empty, drift, texture, seed))
    result = track(movie)
    assert (result.background.drift is not None) == any(drift)
    assert any("what is burnt into the picture, as a scale bar, about 11" in note for note in movie.notes)
    radii = np.array([r.radius for r in result.readings[empty:] if r.used])
    truth = np.array([R for r, R in zip(result.readings[empty:], RADII, strict=True) if r.used])
    assert len(radii) > 0.9 * len(RADII)
    assert np.abs(radii - truth).max() < 0.5


def test_a_luminous_bubble_and_an_overexposed_field_are_not_burnt_in():
    frames = [frame.astype(int) for frame in barred()]
    bar = burnt_in(frames)
    assert bar[136:152, 88:142].sum() == bar.sum() > 400
    for shown in ([255 - f for f in frames], [2 * (200 - f) for f in frames], [2 * f for f in frames]):
        clipped = np.clip(shown, 0, 255)
        clipped[:, 130:] = 100
        assert not burnt_in(clipped.astype(np.uint8)).any()
    needle = np.array(frames)
    needle[:, 60:64, 130:] = 255  # overexposed, and from the border
    assert not burnt_in(needle)[50:74, 100:].any()
    assert burnt_in(needle)[136:152, 88:142].sum() == bar.sum()
    wall = np.full((24, 80, 80), 255, dtype=np.uint8)
    wall[:, 50:] = 10  # in a field that is overexposed
    assert not burnt_in(wall).any()


def test_a_bar_before_a_bubble_is_no_border_from_which_the_bubble_comes():
    noise = np.random.default_rng(1)
    y, x = np.mgrid[:120, :136]
    radii = 21.5 + np.sin(np.arange(15))
    frames = [
        150 * (1 - 0.75 * expit((R - np.hypot(x - 42, y - 56)) / 0.5)) + noise.normal(0, 2, x.shape) for R in radii
    ]
    for frame in frames:
        frame[31:36, 20:55] = 255
    movie = movie_of([np.clip(np.rint(frame), 0, 255).astype(np.uint8) for frame in frames])
    read = [r.radius for r in track(movie).readings]
    assert not any("stands still" in note for note in movie.notes)
    np.testing.assert_allclose(read, radii, atol=0.2)


@pytest.mark.parametrize("light", [255, 70])
def test_margins_about_the_pictures_are_no_background(light):
    """Radii were 50 pixels too large, in silence, of a movie without an empty frame on a white canvas."""
    pictures = [frame[40:136, 36:132] for frame in barred()[14:22]]
    frames = [np.pad(picture, ((8, 8), (12, 6)), constant_values=light) for picture in pictures]
    assert not margins(pictures).any()
    part = margins(frames)
    assert part.sum() == part.size - part[10:-10, 14:-8].size
    assert not part[10:-10, 14:-8].any()
    result = track(movie_of(frames))
    radii = np.array([r.radius if r.used else np.nan for r in result.readings])
    np.testing.assert_allclose(radii, RADII[14:22], atol=0.2)


def test_overexposed_light_is_no_margin():
    shown = np.clip([2 * frame.astype(int) for frame in barred()], 0, 255).astype(np.uint8)
    assert not margins(shown).any()
    assert not margins([255 * (frame > 100).astype(np.uint8) for frame in barred()]).any()
