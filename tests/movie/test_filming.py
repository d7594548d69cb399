"""``en4dvar simulate --movie``: the movie shows the radii of the simulation, whatever is before the lens."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.plumbing.errors import ConfigError
from en4dvar_movie.filming import Camera, described, exposures, film, parse_settings
from en4dvar_movie.frames import open_movie
from en4dvar_movie.page import RED
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track


class Config:
    """A configuration of a radius that is told by its instants."""

    class observable:
        name, unit = "radius", "m"


def radius(t):
    return 1e-6 * (80 - 4e5 * t)


@pytest.fixture
def config(monkeypatch):
    class Told:
        def __init__(self, times):
            self.times, self.values = times, radius(times)

    monkeypatch.setattr("en4dvar.runs.simulation.simulate", lambda config, times: Told(times))
    return Config


TIMES = np.arange(12) * 1e-5


@pytest.mark.parametrize("name", ["m.tif", pytest.param("m.mp4", marks=pytest.mark.slow)])
def test_the_movie_shows_the_simulated_radii(config, tmp_path, name):
    settings = {"pixel": "2 um", "exposure": "500 ns", "centre": "0.4", "dirt": "8", "drift": "0.1", "noise": "4"}
    words = film(config, TIMES, tmp_path / name, settings, 3)
    assert "radii from 17.9 to 40.0 pixels" in words
    movie = open_movie(tmp_path / name)
    if name == "m.tif":
        assert (movie.pixel, movie.rate) == (pytest.approx(2e-6), pytest.approx(1e5))
    found = track(movie)
    off = np.array([r.radius for r in found.readings[3:]]) - radius(TIMES) / 2e-6
    assert np.abs(off).max() < 0.2
    assert not any(r.used for r in found.readings[:3])
    film(config, TIMES, tmp_path / ("again" + name), settings, 3)
    assert (tmp_path / ("again" + name)).read_bytes()[-5000:] == (tmp_path / name).read_bytes()[-5000:]


def test_it_is_told_where_the_clock_of_the_table_begins_and_that_the_frame_is_too_small(config, tmp_path):
    """Four empty frames before the first instant, the fourth of the steps, and the clocks of both agree."""
    agree, cut = "frame 4 is at 40 us and frame 0, from which 'track' counts, at 0 us;", "a larger shape or pixel"
    words = film(config, TIMES + 4e-5, tmp_path / "a.tif", {"before": "4"}, 3)
    assert agree in words
    assert cut not in words
    words = film(config, TIMES, tmp_path / "b.tif", {"pixel": "1 um"}, 3)
    assert "frame 3 is at 0 us and frame 0, from which 'track' counts, at -30 us;" in words
    assert words.endswith(f"; the frame cuts the outline, {cut} shows it")


def test_sixteen_bits(config, tmp_path):
    film(config, TIMES, tmp_path / "m.tif", {"bits": "16", "level": "20000", "noise": "300", "before": "0"}, 1)
    frames = list(open_movie(tmp_path / "m.tif").frames())
    assert len(frames) == 12
    assert frames[0].dtype == np.uint16
    assert 15_000 < np.median(frames[0][:8]) < 25_000


def test_the_frame_cuts_the_bubble_as_it_would_any_part_of_a_larger_picture():
    """Light is blurred into the frame from beyond its border."""
    quiet = Scene(noise=0.0, uneven=0.0, before=0, bits=16, level=50_000.0, blur=3.0)
    whole = next(render(np.array([[50.0]]), quiet, np.random.default_rng(0))).astype(float)
    part = Scene(**{**quiet.__dict__, "shape": (64, 128)})
    cut = next(render(np.array([[50.0]]), part, np.random.default_rng(0))).astype(float)
    np.testing.assert_allclose(cut, whole[32:96], atol=1)


def test_a_disc_takes_its_area_from_the_light():
    quiet = Scene(noise=0.0, uneven=0.0, before=0, bits=16, level=50_000.0, contrast=1.0)
    frame = next(render(np.array([[20.0, 30.0]]), quiet, np.random.default_rng(0)))
    missing = np.sum(1 - frame / 50_000.0)
    assert missing == pytest.approx(np.pi * (20**2 + 30**2) / 2, rel=1e-3)


def test_instants_of_flashes_and_exposures():
    camera = Camera(exposure=2e-7, flashes=(0.0, 1e-6))
    at = exposures(np.array([0.0, 1e-5]), camera)
    assert at.shape == (2, 18)
    np.testing.assert_allclose(at[1, [0, 8, 9, 17]], 1e-5 + np.array([-1e-7, 1e-7, 9e-7, 1.1e-6]))


def test_every_setting_is_described_and_read():
    names = {f.name for kind in (Camera, Scene) for f in fields(kind)}
    assert {line.split(":")[0].strip() for line in described()} == names
    assert "  pixel: size of a pixel (default 2e-06 m)" in described()
    assert "  shape: WIDTHxHEIGHT of a frame (default 128x128)" in described()
    camera, scene = parse_settings(
        {"pixel": "3 um", "flashes": "0 us, 2 us", "shape": "96x64", "bubble": "4.5,3", "dirt": "7", "blur": "2"}
    )
    assert (camera.pixel, camera.flashes) == (3e-6, (0.0, 2e-6))
    assert (scene.shape, scene.bubble, scene.dirt, scene.blur) == ((64, 96), (4.5, 3.0), 7, 2.0)


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("blurr", "2", "did you mean 'blur'"),
        ("blur", "wide", "blur=wide"),
        ("pixel", "0 um", "greater than 0"),
        ("pixel", "2", "unit"),
        ("shape", "9x9", "cannot be filmed"),
        ("shape", "128", "two numbers"),
        ("bits", "12", "bits=12"),
        ("contrast", "2", "contrast=2"),
        ("blur", "nan", "blur=nan"),
    ],
)
def test_settings_that_cannot_be(key, text, words):
    with pytest.raises(ConfigError, match=words):
        parse_settings({key: text})


def test_what_is_no_radius_and_frames_without_a_rate(config, tmp_path):
    with pytest.raises(ConfigError, match="evenly spaced"):
        film(config, np.array([0.0, 1e-6, 3e-6]), tmp_path / "m.tif", {}, 0)
    assert not (tmp_path / "m.tif").exists()


LASER = """
name: laser
model: {name: bubble, law: neo-hookean-kelvin-voigt, start: laser, gas: polytropic, vapour_pressure: saturated}
parameters: {G: 8 kPa, mu: 0.1 Pa s, R_eq: 40 um, R_max: 200 um}
"""


@pytest.mark.slow
def test_the_movie_of_a_laser_bubble_and_back(tmp_path, monkeypatch):
    """The commands of docs/render_movies.md, against the table of the same simulation."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "laser.yaml").write_text(LASER)
    asked = ["--movie-set", "pixel=4 um", "--movie-set", "exposure=500 ns", "--movie-set", "noise=5"]
    words = ["simulate", "laser.yaml", "--times", "0 us:60 us:2 us", "--seed", "3", "--out", "gel_true.csv"]
    outcome = CliRunner().invoke(main, [*words, "--movie", "gel.tif", *asked])
    assert outcome.exit_code == 0, outcome.output
    outcome = CliRunner().invoke(main, ["track", "gel.tif", "--exposure", "500 ns", "--outlined", "seen.tif"])
    assert outcome.exit_code == 0, outcome.output
    assert "31 of 34 frames read" in outcome.output
    truth = np.genfromtxt("gel_true.csv", delimiter=",", skip_header=4)[:, 1]
    told = np.genfromtxt("gel.csv", delimiter=",", skip_header=5, usecols=(2, 3))[3:]
    off = np.abs(told[:, 0] - truth)
    assert np.median(off) < 0.3
    assert np.mean(off < 3 * told[:, 1]) > 0.9
    seen = list(open_movie("seen.tif").open())
    assert seen[5].shape == (512, 512, 3)
    assert np.any(np.all(seen[5] == RED, axis=-1))
    assert not np.any(np.all(seen[0] == RED, axis=-1))
