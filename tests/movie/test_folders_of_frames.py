"""Folders of frames: the numbers in their names are signed and decimal, and missing ones are told and keep the time."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from en4dvar.cli import main
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.frames import open_movie
from en4dvar_movie.numbering import in_order
from en4dvar_movie.scene import Scene, render

COUNT = range(55)
LINES = {
    "sign": [f"frame_{k - 3:+d}.png" for k in COUNT],
    "minus alone": [f"shot7_{k - 3}.png" for k in COUNT],
    "minus that others lack": [f"frame-{3 - k}.png" if k < 3 else f"frame{k - 3}.png" for k in COUNT],
    "minus first": [f"{k - 3}.png" for k in COUNT],
    "all before the trigger": [f"f_{k - 60}.png" for k in COUNT],
    "minus that joins": [f"shot7-{k}.png" for k in COUNT],
    "date": [f"2024-03-01 run 2.1 img-{k:03d}.png" for k in COUNT],
    "decimals": [f"t{k * 0.25:g}us.png" for k in COUNT],
    "decimals that are rounded": [f"t_{(k - 3) * 0.37037:.2f}us.png" for k in COUNT],
    "whole numbers that are rounded": [f"t{k * 2.5:.0f}us.png" for k in COUNT],
    "count after a point": [f"run1.{k}.png" for k in COUNT],
    "count and time": [f"cam_{k:04d}_t{k * 0.5:.1f}.png" for k in COUNT],
}


def ordered(names):
    shuffled = np.random.default_rng(1).permutation(names)
    files, missing, notes = in_order(Path("d"), [Path("d", name) for name in shuffled])
    return [file.name for file in files], missing, notes


@pytest.mark.parametrize("kind", LINES)
def test_frames_come_in_the_order_of_signed_and_decimal_numbers(kind):
    names, missing, notes = ordered(LINES[kind])
    assert names == LINES[kind]
    assert not any(missing)
    assert not notes


@pytest.mark.parametrize("kind", LINES)
def test_missing_numbers_are_told(kind):
    left = [name for k, name in enumerate(LINES[kind]) if k not in (9, 10, 30)]
    names, missing, (note,) = ordered(left)
    assert names == left
    assert [k for k, n in enumerate(missing) if n] == [8, 27]
    assert sum(missing) == 3
    assert "3 frames are missing by the numbers in the names, after" in note


def test_numbers_that_go_up_by_ten_are_told_and_those_that_count_nothing():
    assert "go up by 10; the frame rate is taken as that" in ordered([f"f{10 * k:03d}.png" for k in COUNT])[2][0]
    assert (
        "no number in the names counts" in ordered([f"12.{k // 60:02d}.{k % 60:02d}.png" for k in range(50, 80)])[2][0]
    )
    assert "no number in the names counts" in ordered(["aa.png", "ab.png"])[2][0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["calibration.png"], "not named as the other 55 frames are, and so no frame: calibration.png; move it"),
        (["f012.tif"], "f012.png and f012.tif have the same numbers|f012.tif and f012.png have the same numbers"),
        (["f900000.png"], "go up by 1 to 899946, which tells no steady clock; name frames by their count"),
    ],
)
def test_pictures_that_are_no_frames_are_refused_by_name(more, words):
    with pytest.raises(DataError, match=words):
        ordered([*(f"f{k:03d}.png" for k in COUNT), *more])


def test_times_follow_the_numbers_and_a_missing_frame_has_no_radius(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    radii = np.array([9.1, 15.3, 20.2, 22.7, 20.4, 16.1, 10.2])
    (tmp_path / "m").mkdir()
    for k, frame in enumerate(render(radii[:, None], Scene((64, 64), noise=2.0), np.random.default_rng(2))):
        if k not in (5, 6):
            Image.fromarray(frame).save(tmp_path / "m" / f"img_{k - 3:+d}.png")
    scale = ["--pixel", "1 um", "--frame-rate", "1 MHz", "--out", "m.csv"]
    outcome = CliRunner().invoke(main, ["track", "m", *scale])
    assert outcome.exit_code == 0, outcome.output
    assert "2 frames are missing by the numbers in the names, after img_+1.png" in outcome.output
    rows = list(csv.DictReader(line for line in (tmp_path / "m.csv").read_text().splitlines() if line[0] != "#"))
    assert [float(row["t_us"]) for row in rows] == list(range(10))
    assert [row["reason"] for row in rows[5:7]] == ["the frame is missing in the folder"] * 2
    read = {k: float(row["R_um"]) for k, row in enumerate(rows) if row["R_um"]}
    assert list(read) == [3, 4, 7, 8, 9]
    assert all(abs(read[k] - radii[k - 3]) < 0.2 for k in read)


def test_a_frame_of_another_size_is_named(tmp_path):
    for k, rows in enumerate((32, 32, 24)):
        Image.fromarray(np.zeros((rows, 32), np.uint8)).save(tmp_path / f"f{k}.png")
    with pytest.raises(DataError, match=r"frame 2 \(f2.png\) is 32 × 24, the first 32 × 32"):
        list(open_movie(tmp_path).frames())
