"""One bubble is followed: among others, beside what changes but is none, and doubtful frames wait for a correction.

The movies are those of benchmarks/nasty_movies.py, rendered with other code than the program's.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from movies import movie_of, nasty
from nasty_movies import film
from PIL import Image

from en4dvar.cli import main
from en4dvar_movie.candidates import Candidate, Look
from en4dvar_movie.choice import Correction
from en4dvar_movie.following import Chain, doubts, reasons
from en4dvar_movie.outline import Circle, Outline
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import doubted, track


def read(filmed, **options):
    """Radii (K,), NaN where not used, and the track."""
    result = track(replace(movie_of(filmed.frames), rate=1.0), **options)
    return np.array([r.radius if r.used else np.nan for r in result.readings]), result


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["second bubble", "second enters", "time stamp", "stripes", "scale bar", "needle"])
def test_the_laser_s_bubble_is_followed_beside_whatever_else_is_there(kind):
    of = nasty(kind, 1)
    good = of["good"].astype(bool)
    assert np.isfinite(of["wrong"][good]).mean() > 0.9
    assert not np.any((np.abs(of["wrong"]) > 2) & (np.abs(of["score"]) > 5))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("stripes", 4112),  # of which the bubble covers most of the brighter half
        ("stripes", 4119),  # whose patches change where the bubble comes
        ("bright centre", 4105),  # low, and brighter here and darker there, as writing
        ("drifting specks", 4103),  # a small one begins where another was in the background
        ("shock wave", 4103),  # a ring that is read in two frames in a row
    ],
)
def test_what_looks_like_a_lamp_writing_light_or_a_wall_does_not_lose_the_bubble(kind, seed):
    of = nasty(kind, seed)
    assert np.isfinite(of["wrong"][of["good"].astype(bool)]).mean() > 0.9
    assert not np.any((np.abs(of["wrong"]) > 2) & (np.abs(of["score"]) > 5))


def test_a_small_bubble_at_rest_is_no_time_stamp():
    """It trembles by a third of a pixel, so that its rim becomes brighter here and darker there in every frame."""
    rng, radii = np.random.default_rng(5), np.append(np.linspace(12, 25, 5), np.full(30, 6.5))
    y, x = np.mgrid[:96, :96]
    frames = [np.full((96, 96), 150.0)]
    for radius in radii:
        left, top = 47 + 0.3 * rng.standard_normal(2)
        frames.append(150 - 130 / (1 + np.exp((np.hypot(x - left, y - top) - radius) / 0.6)))
    noisy = [(frame + 3 * rng.standard_normal(frame.shape)).round().astype(np.uint8) for frame in frames]
    radius, _ = read(SimpleNamespace(frames=noisy))
    np.testing.assert_allclose(radius[1:], radii, atol=0.2)


@pytest.mark.slow
def test_a_lamp_that_flickers_does_not_make_a_bubble_bright():
    of = nasty("flicker", 8)
    assert np.isfinite(of["wrong"][of["good"].astype(bool)]).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["interlaced", "two flashes"])
def test_frames_of_two_images_are_doubted(kind):
    filmed = film(kind, 2)
    radius, result = read(filmed)
    off = np.abs(radius - filmed.radius[0])
    assert np.nanmax(off) < 2
    words = {"interlaced": "interlaced: ", "two flashes": "two edges: "}[kind]
    assert any(r.doubt.startswith(words.split(":")[0]) and r.reason == r.doubt for r in result.readings)
    assert words.split(":")[0] in doubted(result.readings)


@pytest.mark.slow
def test_the_user_s_bubble_is_followed_and_the_other_is_there_too():
    filmed = film("side by side, pointed at", 0)
    for bubble, other in ((0, 1), (1, 0)):
        x, y = np.nanmedian(filmed.centre[bubble], axis=0)
        radius, result = read(filmed, point=(x, y))
        assert np.nanmax(np.abs(radius - filmed.radius[bubble])) < 2
        second = np.array([r.radius if r.used else np.nan for r in result.others[0]])
        assert np.nanmax(np.abs(second - filmed.radius[other])) < 2


@pytest.mark.slow
def test_bubbles_that_are_alike_are_told():
    _, result = read(film("side by side, unmarked", 0))
    (note,) = result.notes
    assert "2 bubbles are alike" in note
    assert "--bubble" in note


def circle(frame, x, R, y=50.0):
    outline = Outline(Circle(x, y, R), 1.2, -0.5, 0.01, np.zeros((2, 0)), 1e-4, 1.0, 0.0, 0.0, 1.0)
    return Candidate(frame, (outline,))


def test_a_centre_and_a_radius_that_jump_are_doubted_and_a_collapse_is_not():
    radii = 20 - 0.2 * np.arange(12.0)
    steady = [circle(k, 50.0, R) for k, R in enumerate(radii)]
    assert doubts(Chain(tuple(steady)), []) == {}
    for wrong in (circle(6, 58.0, radii[6]), circle(6, 50.0, radii[6] + 6)):
        (frame,) = doubts(Chain((*steady[:6], wrong, *steady[7:])), [])
        assert frame == 6
    collapse = [circle(k, 50.0, R) for k, R in enumerate([30, 28, 25, 20, 5, 19, 24, 26, 27])]
    assert doubts(Chain(tuple(collapse)), []) == {}


def test_the_wall_of_a_blur_travels_no_further_than_its_place_is_unknown():
    sharp = [circle(k, 50.0, 20 + np.sin(k)) for k in range(15)]
    blurs = [circle(k, 50.0, 3.9 + 2.4 * (k % 2)) for k in range(8)]
    blurs = [replace(c, outlines=(replace(c.outlines[0], width=5.5),)) for c in blurs]
    assert Chain(tuple(sharp)).score > 1.5 * Chain(tuple(blurs)).score


def test_a_wall_that_travels_slowly_scores_more_than_a_larger_one_that_rests():
    slow, rests = ([circle(k, 50.0, 22 - step * k) for k in range(30)] for step in (0.55, 0.0))
    assert Chain(tuple(slow)).score > Chain(tuple(rests)).score


def test_patches_of_a_few_frames_far_between_are_no_wall_that_travels():
    """As those of bands of light that roll through the frames: no radius of theirs continues another."""
    wall = [24.3, 32.2, 36.8, 39.2, 40.1, 39.2, 36.8, 32.1, 24.2, 8.6, 7.3, *[6.6] * 12]
    bubble = [circle(k, 50.0, R) for k, R in enumerate(wall)]
    bands = [circle(k, 50.0, R, 70.0) for k, R in ((15, 23.8), (21, 16.6), (23, 32.5), (26, 15.4), (31, 35.0))]
    assert Chain(tuple(bubble)).score > 1.5 * Chain(tuple(bands)).score


def test_a_bubble_that_touches_is_told():
    own = Chain(tuple(circle(k, 50.0, 20.0) for k in range(20)))
    other = Chain(tuple(circle(k, 110.0 - 4 * k, 8.0) for k in range(20)))
    doubtful = doubts(own, [other])
    assert min(doubtful) in range(4, 8)  # the gap is 32 − 4 k pixels; it counts from 5 on, and three frames before
    assert all("two bubbles" in words for words in doubtful.values())


def test_the_light_beside_a_bubble_is_not_that_within_a_larger_one():
    radii = np.array([30.0, 38, 44, 46, 46, 44, 38, 30])  # from 44 on it covers more than half of what is far from ours
    scenes = [
        Scene(shape=(98, 160), noise=0.0, uneven=0.0, level=5e4, bits=16, bubble=at) for at in ((48, 49), (128, 48))
    ]
    films = [
        np.array(list(render(share * radii[:, None], scene, np.random.default_rng(1))), float)
        for share, scene in zip((1, 0.4), scenes, strict=True)
    ]
    light = 3e-3 * films[0] * films[1] / 5e4
    frames = list(np.rint(light + np.random.default_rng(2).normal(0, 1, light.shape)).astype(np.uint8))
    radius, _ = read(SimpleNamespace(frames=frames), point=(128.0, 48.0))
    assert np.all(np.abs(radius[3:] - 0.4 * radii) < 0.05)


def test_why_a_bubble_is_not_read_is_told_of_its_own_place():
    own, other = circle(1, 52.0, 20.0), circle(1, 150.0, 25.0)
    bubble = Chain((circle(0, 50.0, 20.0), circle(2, 50.0, 20.0)))
    looks = [Look(0, bubble.candidates[:1]), Look(1, (other, replace(own, fault="faint"))), Look(2), Look(3, (other,))]
    why = reasons(looks, bubble)
    assert why[1] == "faint"
    assert why[3].startswith("elsewhere")


@pytest.mark.slow
def test_a_correction_confirms_a_doubtful_frame():
    filmed = film("interlaced", 2)
    _, result = read(filmed)
    number = next(r.frame for r in result.readings if r.doubt)
    confirmed = read(filmed, corrections={number: Correction(False, None, "looked at")})[1].readings[number]
    assert confirmed.used
    assert confirmed.reason == "by hand: looked at"


@pytest.mark.slow
def test_all_bubbles_by_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    filmed = film("side by side, pointed at", 0)
    tifffile.imwrite("m.tif", np.array(filmed.frames), photometric="minisblack")
    x, y = np.nanmedian(filmed.centre[1], axis=0)
    words = ["track", "m.tif", "--pixel", "1 um", "--frame-rate", "1 MHz", "--bubble", f"{x:.0f},{y:.0f}", "--all"]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 0, outcome.output
    assert "another bubble: m_2.csv" in outcome.output
    for name, bubble in (("m", 1), ("m_2", 0)):
        table = np.genfromtxt(f"{name}.csv", delimiter=",", skip_header=4, usecols=(0, 2))
        used = table[np.isfinite(table[:, 1])]
        assert len(used) > 30
        assert np.abs(used[:, 1] - filmed.radius[bubble][used[:, 0].astype(int)]).max() < 2
    again = CliRunner().invoke(main, [*words, "--out", "n.csv", "--page", "n.html"])
    assert again.exit_code == 0
    assert CliRunner().invoke(main, words).exit_code == 2


@pytest.mark.slow
def test_a_region_and_a_mask_choose_too():
    filmed = film("side by side, pointed at", 0)
    height, width = filmed.frames[0].shape
    for columns, bubble in ((slice(0, 72), 0), (slice(72, width), 1)):
        part = np.zeros((height, width), dtype=bool)
        part[:, columns] = True
        radius, _ = read(filmed, watched=part)
        assert np.isfinite(radius).sum() > 30
        assert np.nanmax(np.abs(radius - filmed.radius[bubble])) < 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--bubble", "3"], "write X,Y"),
        (["--region", "0,0,40,10"], "not within the frame of 32 × 32 pixels"),
        (["--region", "3,3,1,20"], "leave nothing of the frame that a bubble is seen in"),
        (["--region", "0,0,4"], "write X,Y,WIDTH,HEIGHT"),
        (["--mask", "small.png"], "8 × 8 pixels, the frames have 32 × 32"),
        (["--mask", "black.png"], "leave nothing"),
        (["--mask", "none.png"], "none.png"),
        (["--mask", "m.txt"], "not a picture by its suffix"),
    ],
)
def test_choices_that_cannot_be(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("m.tif", np.zeros((3, 32, 32), np.uint8), photometric="minisblack")
    for name, side in (("small", 8), ("black", 32)):
        Image.fromarray(np.zeros((side, side), np.uint8)).save(f"{name}.png")
    (tmp_path / "m.txt").write_text("no picture")
    outcome = CliRunner().invoke(main, ["track", "m.tif", "--pixel", "1 um", "--frame-rate", "1 Hz", *words])
    assert outcome.exit_code == 2
    assert message in outcome.output


@pytest.mark.slow
def test_a_point_far_from_any_bubble(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("m.tif", np.array(film("clean", 0).frames), photometric="minisblack")
    words = ["track", "m.tif", "--pixel", "1 um", "--frame-rate", "1 MHz", "--bubble", "5,5"]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 2
    assert "no bubble is seen near 5,5" in outcome.output


def test_a_copied_frame_is_doubtful_where_the_wall_moves():
    """No noise tells it in a compressed video: radii were 4 pixels off, in silence."""
    radii = np.array([30, 29, 27, 24, 24.02, 16, 10, 9.9, 13, 16, 18, 18.1, 18, 17.9, 17.8])
    outline = Outline(Circle(0, 0, 1), 1.0, -0.5, 0.01, np.zeros((2, 1)), 1e-4, 1.0, 0.0, 0.1, 1.0)
    chain = Chain(tuple(Candidate(k, (replace(outline, circle=Circle(0, 0, R)),)) for k, R in enumerate(radii)))
    words = doubts(chain, [])
    assert list(words) == [4]
    assert words[4].startswith("copy: the radius is that of the frame before, but changes by 3.0 and 8.0 pixels")
    gaps = Chain(tuple(c for c in chain.candidates if c.frame != 2))
    assert not doubts(gaps, [])
