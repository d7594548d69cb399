"""Radii read from rendered movies, whose truth is known, and from a real one that a person has read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from movies import CLASSES, SHARED, against_a_person, film, from_the_steepest, movie_of, rendered

from en4dvar.plumbing.errors import DataError
from en4dvar_movie.background import find_background
from en4dvar_movie.choice import Correction
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track

KINDS = [kind for kind in CLASSES if kind != "ellipse"]
RADII = np.array([12.3, 20.0, 31.7, 40.2, 25.5, 9.1])


def frames(scene=Scene(), radii=RADII, seed=1):  # noqa: B008  # a frozen value
    return list(render(radii[:, None], scene, np.random.default_rng(seed)))


@pytest.mark.parametrize("kind", [*KINDS[:4], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[4:])])
def test_radii_of_every_class_of_frame_are_the_true_ones(kind):
    scores, wrong = rendered(kind, 4)
    assert np.isfinite(wrong).mean() == 1
    assert abs(np.mean(wrong)) < 0.1
    assert np.sqrt(np.mean(scores**2)) < 3


@pytest.mark.slow
def test_dirt_that_drifts_in_the_empty_frames_moves_no_radius():
    """It would be a part of the background, and so at the same place in all frames."""
    true, off = np.linspace(9.0, 13.0, 15), []
    for seed in range(31, 39):
        found = track(movie_of(frames(Scene((48, 48), noise=4.0, dirt=8, centre=0.4), true, seed)))
        off.append(np.nanmean(np.array([r.radius for r in found.readings[3:]]) - true))
    assert np.sqrt(np.mean(np.square(off))) < 0.03


def test_a_lamp_that_flickers_leaves_no_pattern_in_the_mean_of_empty_frames():
    """Pixels that leave out one of them, which is brighter, would be darker than the others."""
    scene, lamp = Scene((64, 64), noise=6.0, before=6), np.array([1.0, 1.04, 0.97, 1.06, 0.95, 1.02])
    shown = frames(scene, RADII[:2])
    shown[:6] = [np.rint(frame * part).astype(np.uint8) for frame, part in zip(shown, lamp, strict=False)]
    ratio = find_background(movie_of(shown))[0].level / frames(replace(scene, noise=0.0), RADII[:2])[0]
    assert np.std(ratio / np.median(ratio)) * scene.level < 0.7


@pytest.mark.parametrize("seed", [51, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (52, 53, 54))])
def test_the_frames_of_a_bubble_that_begins_small_are_no_background(seed):
    true = np.array([3.4, 3.1, 2.8, 2.6, 3.0, 4.0, 5.5, 7.0, 9.0, 11.0, 12.0, 12.0, 11.0, 9.0, 7.0, 5.0, *[4.0] * 8])
    found = track(movie_of(frames(Scene((64, 64), noise=8.0), true, seed)))
    assert found.background.frames == 3
    assert abs(np.mean([r.radius for r in found.readings[-8:]]) - 4) < 0.15


@pytest.mark.slow
def test_a_few_large_bubbles_tell_the_contrast_of_many_small_ones():
    """Of the light in a small bubble's centre, some is blurred to its edge."""
    true = np.concatenate([np.linspace(24.0, 4.0, 8), np.full(40, 3.8)])
    for seed in range(41, 45):
        found = track(movie_of(frames(Scene((70, 70), noise=7.5, centre=0.4), true, seed)))
        assert abs(found.optics.contrast + 0.5) < 0.02


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kind", CLASSES)
def test_stated_errors_are_the_real_ones(kind):
    scores, wrong = (np.concatenate(part) for part in zip(*(rendered(kind, n) for n in range(40)), strict=True))
    read = np.isfinite(scores)
    assert read.mean() > 0.98
    assert abs(np.mean(wrong[read])) < 0.1
    assert 0.8 < np.mean(np.abs(scores[read]) < 1.6449) < 0.99


def test_bright_on_dark_is_read_alike():
    found = track(movie_of([255 - frame for frame in frames()]))
    off = np.array([r.radius for r in found.readings[3:]]) - RADII
    assert np.abs(off).max() < 0.2
    assert not any(r.used for r in found.readings[:3])


def test_a_movie_that_begins_with_the_bubble():
    found = track(movie_of(frames(Scene(before=0, uneven=0.0))))
    assert found.background.frames == 0
    assert np.abs(np.array([r.radius for r in found.readings]) - RADII).max() < 0.3


def test_same_bits_for_any_number_of_workers():
    movie = movie_of(frames())
    one, three = (np.array([(r.radius, r.errors.std) for r in track(movie, n).readings]) for n in (1, 3))
    assert np.isfinite(one[3:]).all()
    assert one.tobytes() == three.tobytes()


def test_a_flash_is_named_and_left_out():
    shown = frames()
    shown[4] = np.full_like(shown[4], 255)
    found = track(movie_of(shown))
    assert not found.readings[4].used
    assert "flash" in found.readings[4].reason
    assert sum(r.used for r in found.readings) == 5


def test_a_frame_that_the_file_holds_damaged_is_named_and_left_out():
    found = track(replace(movie_of(frames()), damaged={4}))
    assert [r.frame for r in found.readings if r.reason == "the file is damaged here"] == [4]
    assert sum(r.used for r in found.readings) == 5


@pytest.mark.slow
def test_noise_at_the_edge_of_a_small_bubble_is_no_motion():
    """A bubble of 2.7 pixels whose wall moves slowly: noise widens its edge by more than 0.15 of its radius."""
    radii = np.concatenate([np.linspace(17.0, 8.0, 20), 2.7 + 0.4 * np.sin(np.arange(12.0))])
    moved = []
    for seed in range(11, 17):
        shown = render(radii[:, None], Scene(noise=7.0, drift=0.2), np.random.default_rng(seed))
        small = track(movie_of(list(shown))).readings[23:]
        moved += ["within the exposure" in reading.reason for reading in small if np.isfinite(reading.radius)]
    assert np.mean(moved) < 0.1


@pytest.mark.slow
def test_stated_errors_of_a_small_bubble_are_at_most_twice_the_real_ones():
    """A collapse, and a rest of 2.9 pixels that is most of the movie, beside specks of dirt."""
    true = np.concatenate([np.linspace(17.0, 3.0, 15), np.full(45, 2.9)])
    scores = []
    for seed in range(21, 25):
        shown = render(true[:, None], Scene(noise=8.0, drift=0.02, dirt=8), np.random.default_rng(seed))
        small = track(movie_of(list(shown))).readings[18:]
        scores += [(r.radius - 2.9) / r.errors.std for r in small if np.isfinite(r.radius)]
    assert len(scores) > 160
    assert 0.5 < np.median(np.abs(scores)) / 0.674 < 1.3


@pytest.mark.slow
def test_what_a_lasting_shape_hides_is_one_factor_of_all_radii():
    """Ellipsoids that keep their shape: what is not seen of them is no scatter, and their readings do not scatter."""
    off, scatter = [], []
    for seed in range(60, 72):
        read = track(movie_of(frames(Scene(noise=4.0, ellipticity=0.03), seed=seed))).readings[Scene.before :]
        relative = np.array([r.radius for r in read]) / RADII - 1
        off.append(np.median(relative) / read[0].errors.factor)
        scatter += list((relative - np.median(relative)) * RADII / [r.errors.std for r in read])
    assert 0.2 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert 0.5 < np.sqrt(np.mean(np.square(scatter))) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("first", [80, 83])
def test_an_elongated_bubble_that_the_frame_cuts_has_an_error_to_match(first):
    """A circle about the parts of its outline that are seen is another one than about the whole."""
    true, off = np.array([12.0, 18.0, 22.0, 30.0, 34.0, 31.0, 24.0, 19.0, 15.0]), []
    for seed in range(first, first + 3):
        shown = frames(Scene((56, 128), noise=2.0, ellipticity=0.05), true, seed)
        read = track(movie_of(shown)).readings[Scene.before :]
        off += [(r.radius - R) / r.errors.std for r, R in zip(read, true, strict=True) if r.used and R > 28]
    assert len(off) > 6
    assert np.max(np.abs(off)) < 4
    assert np.sqrt(np.mean(np.square(off))) > 0.2  # nor is it said to be hardly known


def test_a_bubble_that_turns_within_the_exposure_has_an_error_to_match():
    """The largest disc of the exposure casts some shade, the smallest is where the bubble is at its middle."""
    still = np.array([34.0, 27.0, 21.0, 0.0, 21.0, 27.0, 34.0])
    radii = np.repeat(still[:, None], 41, axis=1)
    radii[3] = 6 + 14 * np.abs(np.linspace(-1, 1, 41))
    found = track(movie_of(list(render(radii, Scene(), np.random.default_rng(4)))))
    reading = found.readings[6]
    assert "turned within the exposure" in reading.reason
    assert abs(reading.radius - 6) < 2.5 * reading.errors.std
    assert reading.errors.std < 8
    assert all(r.errors.std < 0.1 for r in found.readings[3:] if r is not reading)


def test_no_bubble_is_darker_than_the_clearest():
    """A collapse within the exposure about a bright centre, which a darker bubble of a wider edge would fit as well."""
    radii = np.repeat(np.array([40.0, 35.0, 30.0, 0.0, 30.0, 35.0, 40.0])[:, None], 41, axis=1)
    radii[3] = 4 + 20 * np.abs(np.linspace(-1, 1, 41))
    found = track(movie_of(list(render(radii, Scene(centre=0.5), np.random.default_rng(4)))))
    darkest = min(r.outline.contrast for r in found.readings if r.outline is not None)
    assert darkest > 1.02 * found.optics.contrast


def test_dirt_is_no_bubble():
    """Neither in a frame of the background, at the bubble's place, nor later elsewhere."""
    shown = frames()
    shown[1] = frames(Scene(bubble=(62.0, 60.0)), np.array([3.5]))[3]
    shown.append(frames(Scene(bubble=(20.0, 100.0)), np.array([5.0]))[3])
    found = track(movie_of(shown))
    assert [r.frame for r in found.readings if r.used] == [3, 4, 5, 6, 7, 8]
    assert "background" in found.readings[1].reason
    assert "elsewhere" in found.readings[9].reason


def test_specks_of_dirt_do_not_tell_how_sharp_an_edge_is():
    _, shown = film("dirt", 7000)
    assert find_background(movie_of(shown))[1].width == pytest.approx(1.2, abs=0.15)


@pytest.mark.slow
def test_nested_circles_of_a_faint_frame_are_found():
    """A first step would shrink the innermost one to nothing."""
    scores, _ = rendered("three flashes, 3 to 8 px apart", 5003)
    assert np.isfinite(scores).all()


def test_corrections_by_hand():
    movie = movie_of(frames())
    found = track(movie, corrections={5: Correction(True, None, "two bubbles")})
    assert found.readings[5].reason == "left out by hand: two bubbles"
    assert not found.readings[5].used


@pytest.mark.parametrize(("level", "words"), [(0, "black"), (255, "white"), (77, "one brightness")])
def test_movies_of_nothing(level, words):
    with pytest.raises(DataError, match=words):
        find_background(movie_of([np.full((64, 64), level, np.uint8)] * 5))


def test_a_movie_without_a_bubble():
    noise = np.random.default_rng(0)
    with pytest.raises(DataError, match="no frame shows a bubble"):
        track(movie_of([noise.normal(100, 3, (64, 64)).astype(np.uint8) for _ in range(8)]))


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data")
def test_the_real_movie_agrees_with_a_person_and_with_the_steepest_light():
    """The person's radii at rest, half a pixel smaller, lie inside of where the light grows fastest."""
    found, off = against_a_person()
    assert len(off) == 98
    assert abs(np.median(from_the_steepest(found))) < 0.2
    assert np.mean(np.abs(off) < 2) > 0.97  # two frames of a collapse within the exposure are read smaller
    assert [r.frame for r in found.readings if not r.used] == [0, 1, 2]


@pytest.mark.parametrize("noise", [pytest.param(2.0, marks=pytest.mark.slow), 10.0])
def test_a_bubble_that_covers_half_of_the_frame_is_no_change_of_light(noise):
    """The median brightness of such a frame is that of the bubble's edge."""
    radii = np.linspace(36.0, 43.0, 15)
    found = track(movie_of(frames(Scene(shape=(96, 96), noise=noise), radii)))
    off = np.array([r.radius for r in found.readings[3:]]) - radii
    assert np.abs(off).max() < 0.15
    assert np.abs(off / [r.errors.std for r in found.readings[3:]]).max() < 5


@pytest.mark.slow
@pytest.mark.parametrize("lamp", ["fades", "flickers"])
def test_a_lamp_that_changes_much_leaves_the_radii(lamp):
    radii = np.linspace(31.0, 8.0, 24)
    shown = frames(radii=radii)
    light = np.linspace(1, 0.6, 27) if lamp == "fades" else 1 + 0.2 * np.random.default_rng(5).standard_normal(27)
    read = track(
        movie_of([np.rint(np.minimum(f * part, 255)).astype(np.uint8) for f, part in zip(shown, light, strict=True)])
    )
    assert [r.frame for r in read.readings if not r.used] == [0, 1, 2]
    np.testing.assert_allclose([r.radius for r in read.readings[3:]], radii, atol=0.2)


def test_a_bubble_that_leaves_only_corners_is_no_change_of_light():
    radii = np.array([*np.linspace(30.0, 60.0, 12), *np.linspace(60.0, 30.0, 12)])
    read = track(movie_of(frames(Scene(shape=(96, 96)), radii)))
    assert [r.frame for r in read.readings if not r.used] == [0, 1, 2]
    np.testing.assert_allclose([r.radius for r in read.readings[3:]], radii, atol=0.5)


def test_frames_with_a_subtracted_background_say_what_to_do_and_that_helps():
    shown = np.array(frames(Scene((64, 64)), RADII[:2]), dtype=np.float32)
    shown -= shown[0]
    with pytest.raises(DataError, match="are negative where they are darkest"):
        track(movie_of(list(shown)))
    found = track(movie_of(list(shown - shown.min())))
    assert [r.radius for r in found.readings if r.used] == pytest.approx(RADII[:2], abs=0.2)


def test_a_black_frame_is_no_flash():
    """Divided by its own brightness it was endlessly bright."""
    shown = frames(Scene((64, 64)), np.array([18.0, 17.0, 15.0, 12.0]))
    shown[4] = np.zeros_like(shown[4])
    reading = track(movie_of(shown)).readings[4]
    assert not reading.used
    assert reading.reason == "no bubble: nothing that has an outline differs from the background"
