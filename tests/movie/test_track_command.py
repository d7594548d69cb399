"""``en4dvar track``: its table goes through ``init`` into a configuration whose errors are those of each reading."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from movies import movie_of

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar_movie.frames import MOVING
from en4dvar_movie.page import page_text
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.table import Scale, to_csv
from en4dvar_movie.tracking import track

PIXEL, RATE = 2.5, 4e5  # µm, 1/s
SCALE = ["--pixel", f"{PIXEL} um", "--frame-rate", "400 kHz"]


def history():
    """Radii (K,) in pixels of a collapse and a rebound."""
    t = np.linspace(0, 2.6, 27)
    return 3 + 38 * np.abs(np.cos(np.pi * t / 2)) ** 0.7 * np.where(t < 1, 1, 0.6)


def tracked(folder, monkeypatch, last=27):
    monkeypatch.chdir(folder)
    frames = list(render(np.maximum(history()[:last], 5)[:, None], Scene(), np.random.default_rng(3)))
    tifffile.imwrite(folder / "gel.tif", np.array(frames), photometric="minisblack")
    words = ["track", "gel.tif", *SCALE, "--out", "gel.csv"]
    return CliRunner().invoke(main, words)


def test_from_the_movie_to_observations(tmp_path, monkeypatch):
    outcome = tracked(tmp_path, monkeypatch)
    assert outcome.exit_code == 0, outcome.output
    assert "27 of 30 frames read" in outcome.output
    lines = (tmp_path / "gel.csv").read_text().splitlines()
    comment = [line for line in lines if line.startswith("#")]
    assert "pixel: 2.5 um; frame rate: 400000 Hz" in " ".join(comment)
    shape = "eccentricity,angle_deg,mode_2_um,mode_3_um,mode_4_um,mode_std_um"
    assert lines[len(comment)] == f"frame,t_us,R_um,R_std_um,t_std_us,x_um,y_um,{shape},used,reason"
    assert lines[len(comment) + 1].endswith(",,,,,,,,,,,,0,no bubble: the frame is one of the background's")
    page = (tmp_path / "gel.html").read_text()
    assert page.count("<polygon") == 27
    assert CliRunner().invoke(main, ["init", "--data", "gel.csv", "--start", "laser"]).exit_code == 0
    (problem,) = build(load_config(tmp_path / "gel.yaml"))
    readings = np.genfromtxt(lines[len(comment) + 1 :], delimiter=",", usecols=(2, 3))[3:] * 1e-6
    count = len(problem.observations.times)
    np.testing.assert_allclose(problem.observations.values, readings[:count, 0])
    np.testing.assert_allclose(problem.observations.noise.std, readings[:count, 1])
    np.testing.assert_allclose(problem.observations.noise.time_std, 0.01 / RATE)
    (offset,) = (term for term in problem.prior.terms if term.parameter.name == "reading_offset")
    edge = 0.05 * np.sqrt(2 * np.pi) * 1.25  # px: 5 % of the contrast at the edge of this movie, 1.2 px and the pixel's
    np.testing.assert_allclose([offset.mean, offset.std], [0, 1e-6 * PIXEL * edge], atol=1e-8)


@pytest.mark.parametrize("option", ["--out", "--page", "--outlined"])
def test_a_movie_is_not_replaced_by_what_is_read_from_it(tmp_path, monkeypatch, option):
    tracked(tmp_path, monkeypatch, 4)
    held = (tmp_path / "gel.tif").read_bytes()
    outcome = CliRunner().invoke(main, ["track", "gel.tif", *SCALE, "--force", option, "gel.tif"])
    assert outcome.exit_code == 2
    assert "gel.tif: is what the command reads, and is not replaced; give another name" in outcome.output
    assert (tmp_path / "gel.tif").read_bytes() == held


def test_a_frame_of_a_folder_is_not_replaced_by_the_outlined_movie(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        tifffile.imwrite(tmp_path / f"{number}.tif", np.zeros((40, 40), dtype=np.uint8))
    outcome = CliRunner().invoke(main, ["track", ".", *SCALE, "--force", "--outlined", "1.tif", "--out", "gel.csv"])
    assert (outcome.exit_code, "1.tif: is what the command reads" in outcome.output) == (2, True)


@pytest.mark.parametrize(("factor", "words"), [(2e-5, 0), (3e-3, 1)])
def test_a_lasting_shape_is_on_the_page_where_it_is_felt(factor, words):
    movie = movie_of(list(render(np.array([[20.0], [22.0]]), Scene(), np.random.default_rng(3))))
    seen = track(movie)
    readings = [replace(r, errors=replace(r.errors, factor=factor)) for r in seen.readings]
    page = page_text(movie, replace(seen, readings=readings), Scale(2e-6, 2.5e6), "en4dvar track")
    assert "2 µm a pixel, 2500000 frames a second" in page
    assert page.count("A shape that lasts") == page.count("wrong by 0.3 %") == words


@pytest.mark.slow
def test_from_the_movie_to_the_configuration_in_one_step(tmp_path, monkeypatch):
    alone = tracked(tmp_path, monkeypatch)
    assert alone.exit_code == 0
    assert "next: en4dvar init --data gel.csv\n" in alone.output
    scale = ["--pixel", f"{PIXEL} um", "--frame-rate", "400 kHz"]
    words = ["init", "--movie", "gel.tif", *scale, "--start", "laser", "--out", "own.yaml"]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 0, outcome.output
    assert outcome.output.count("next: ") == 1  # it goes on by itself
    readings = [(tmp_path / f"{name}.csv").read_text().split("\nframe,")[1] for name in ("gel", "own")]
    assert readings[0] == readings[1]
    (problem,) = build(load_config(tmp_path / "own.yaml"))
    assert problem.observations.source.endswith("own.csv")
    mute = CliRunner().invoke(main, ["init", "--movie", "gel.tif", "--out", "mute.yaml"])
    assert mute.exit_code == 2
    assert "never guessed" in mute.output
    for wrong, words in ((["--data", "gel.csv", "--movie", "gel.tif"], "not together"), (scale, "needs a --movie")):
        refused = CliRunner().invoke(main, ["init", *wrong])
        assert refused.exit_code == 2
        assert words in refused.output


@pytest.mark.slow
def test_flashes_raw_frames_and_corrections_go_through_that_step_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    times = np.add.outer(np.arange(12) * 2.5, [0.0, 1.0])  # us
    radii = 9 + 35 * np.abs(np.cos(np.pi * (times - 4) / 32))
    np.array(list(render(radii, Scene(), np.random.default_rng(3)))).tofile("gel.raw")
    (tmp_path / "by_hand.txt").write_text("5 out  two bubbles\n")
    scale = ["--pixel", f"{PIXEL} um", "--frame-rate", "400 kHz", "--flashes", "0 us, 1 us", "--exposure", "50 ns"]
    words = ["init", "--movie", "gel.raw", "--raw", "128x128x8", "--corrections", "by_hand.txt", *scale]
    outcome = CliRunner().invoke(main, [*words, "--start", "laser", "--out", "gel.yaml"])
    assert outcome.exit_code == 0, outcome.output
    table = np.genfromtxt(tmp_path / "gel.csv", delimiter=",", skip_header=5, usecols=(0, 1, 2))
    t, read = table[np.isfinite(table[:, 2]) & (table[:, 0] != 5)].T[1:]
    truth = dict(zip(np.round(times.ravel() + 7.5, 6), PIXEL * radii.ravel(), strict=True))  # after three empty frames
    assert len(t) == 22
    np.testing.assert_allclose(read, [truth[instant] for instant in t], atol=PIXEL)
    (problem,) = build(load_config(tmp_path / "gel.yaml"))
    assert len(problem.observations.times) >= 10  # from the top to the trough, whose own reading lies at the very end
    refused = CliRunner().invoke(main, ["init", "--flashes", "0 us, 1 us"])
    assert refused.exit_code == 2
    assert "--flashes needs a --movie" in refused.output


def test_the_table_of_another_movie_of_that_name_is_replaced_only_by_its_name(tmp_path, monkeypatch):
    assert tracked(tmp_path, monkeypatch, 6).exit_code == 0
    own = CliRunner().invoke(main, ["track", "gel.tif", *SCALE, "--out", "gel.csv", "--force"])
    assert own.exit_code == 0, own.output
    (tmp_path / "gel.tif").rename(tmp_path / "gel.tiff")
    before = (tmp_path / "gel.csv").read_bytes()
    other = CliRunner().invoke(main, ["track", "gel.tiff", *SCALE, "--force"])
    assert other.exit_code != 0
    assert "gel.csv: was read from gel.tif and is not replaced; give --out another name" in other.output
    assert (tmp_path / "gel.csv").read_bytes() == before
    named = CliRunner().invoke(main, ["track", "gel.tiff", *SCALE, "--force", "--out", "gel.csv"])
    assert named.exit_code == 0, named.output


def test_the_table_of_a_movie_of_that_name_in_another_folder_is_replaced_only_by_its_name(tmp_path, monkeypatch):
    assert tracked(tmp_path, monkeypatch, 6).exit_code == 0
    before = (tmp_path / "gel.csv").read_bytes()
    (tmp_path / "second").mkdir()
    shutil.copy(tmp_path / "gel.tif", tmp_path / "second")
    other = CliRunner().invoke(main, ["track", "second/gel.tif", *SCALE, "--force"])
    assert other.exit_code != 0
    assert "gel.csv: was read from gel.tif and is not replaced; give --out another name" in other.output
    assert (tmp_path / "gel.csv").read_bytes() == before
    own = CliRunner().invoke(main, ["track", str(tmp_path / "gel.tif"), *SCALE, "--force"])
    assert own.exit_code == 0, own.output


def test_nothing_is_replaced_and_the_scale_is_asked_for(tmp_path, monkeypatch):
    assert tracked(tmp_path, monkeypatch, 6).exit_code == 0
    again = tracked(tmp_path, monkeypatch, 6)
    assert again.exit_code == 2
    assert "exists" in again.output
    mute = CliRunner().invoke(main, ["track", "gel.tif", "--out", "b.csv"])
    assert mute.exit_code == 2
    assert "never guessed" in mute.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--exposure", "3 us"], "longer than the 2.5 us between two frames"),
        (["--flashes", "0 us, 2.6 us"], "more than the 2.5 us between two frames"),
        (["--flashes", "1 us, 0 us"], "in the order of time"),
        (["--pixel", "-1 um"], "--pixel must be positive"),
        (["--pixel", "4 m"], "--pixel 4 m: pixels of 1 nm to 1 mm are read; is the unit right?"),
        (["--pixel", "2.76e-6"], "2.76e-6 has no unit; write e.g. '2.76e-6 m'"),
        (["--frame-rate", "1e6"], "1e6 has no unit; write e.g. '1e6 Hz'"),
        (["--frame-rate", "270"], "270 has no unit; write e.g. '270 kHz'"),
        (["--outlined", "seen.gif"], "seen.gif: not a movie by its suffix"),
    ],
)
def test_options_that_cannot_be(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("m.tif", np.zeros((3, 32, 32), np.uint8), photometric="minisblack")
    scale = ["--pixel", "1 um", "--frame-rate", "400 kHz"]
    outcome = CliRunner().invoke(main, ["track", "m.tif", *scale, *words])
    assert outcome.exit_code == 2
    assert message in outcome.output


@pytest.mark.parametrize("pixel", [0.005, 20.0])
def test_lengths_have_digits_for_pixels_of_any_size(pixel):
    shown = Scale(1e-6 * pixel, RATE, float("nan"))
    readings = track(movie_of(list(render(history()[:4, None], Scene(), np.random.default_rng(3))))).readings
    rows = to_csv(readings, shown, "gel.tif", "").split("used,reason\n")[1].splitlines()[3:]
    written = np.array([[float(text) for text in row.split(",")[2:4]] for row in rows]) / pixel
    np.testing.assert_allclose(written[:, 0], [r.radius for r in readings[3:]], atol=1e-4)
    np.testing.assert_allclose(written[:, 1], [r.errors.std for r in readings[3:]], rtol=1e-3)


def test_what_is_wrong_of_a_movie_is_said_of_the_command_that_was_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("gel.tif", np.zeros((2, 64, 64), np.uint8), photometric="minisblack")
    words = ["init", "--movie", "gel.tif", "--pixel", "3 mm", "--frame-rate", "400 kHz"]
    refused = CliRunner().invoke(main, words)
    assert refused.exit_code == 2
    assert "is the unit right?" in refused.output
    assert "init [OPTIONS]" in refused.output
    assert "track" not in refused.output


def test_the_help_names_every_kind_of_movie_that_is_read():
    """It left out cine, mov and mkv."""
    told = " ".join(CliRunner().invoke(main, ["track", "--help"]).output.split())
    assert [suffix for suffix in MOVING if suffix not in (".tif", ".tiff") and suffix[1:] not in told] == []
