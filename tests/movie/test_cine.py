"""Cine files of Phantom cameras, written here byte by byte after the maker's description of the format."""

from __future__ import annotations

import csv
import struct

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar_movie.frames import open_movie, with_scale
from en4dvar_movie.scene import Scene, render

RATE = 270_000
SETUP = 0x163C  # bytes of the smallest setup that says the frame rate
RADII = np.array([12.3, 19.0, 24.7, 21.2, 15.5, 9.1])


def write_cine(path, frames):
    """Uncompressed grey frames: headers of file and bitmap, setup, places of frames, frames from the lowest row up."""
    count, (height, width), bits = len(frames), frames[0].shape, 8 * frames[0].dtype.itemsize
    setup = bytearray(SETUP)
    struct.pack_into("<HH", setup, 140, 0x5453, SETUP)
    struct.pack_into("<I", setup, 768, RATE)
    struct.pack_into("<I", setup, 896, bits)
    place = 44 + 40 + SETUP
    size = height * width * bits // 8
    content = b"CI" + struct.pack("<HHHiIiIIII8x", 44, 0, 1, -2, count, -2, count, 44, 84, place)
    content += struct.pack("<IiiHHIIiiII", 40, width, height, 1, bits, 0, size, 45454, 45454, 0, 0) + setup
    content += struct.pack(f"<{count}q", *(place + 8 * count + k * (8 + size) for k in range(count)))
    content += b"".join(struct.pack("<II", 8, size) + frame[::-1].tobytes() for frame in frames)
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["u1", "<u2"])
def test_frames_and_rate_of_the_camera(tmp_path, kind):
    frames = np.random.default_rng(4).integers(0, np.iinfo(kind).max, (4, 32, 48)).astype(kind)
    write_cine(tmp_path / "m.cine", frames)
    movie = open_movie(tmp_path / "m.cine")
    assert (movie.count, movie.rate, movie.notes) == (4, RATE, [])
    assert np.array_equal(np.array(list(movie.frames())), frames)
    assert with_scale(movie, 1e-6, 1e5).rate == 1e5  # what is given goes before what the file says


def test_of_one_that_is_cut_off_the_whole_frames_are_read(tmp_path):
    frames = np.random.default_rng(4).integers(0, 255, (4, 32, 48)).astype(np.uint8)
    write_cine(tmp_path / "m.cine", frames)
    (tmp_path / "m.cine").write_bytes((tmp_path / "m.cine").read_bytes()[:-2000])  # a frame has 1544 bytes
    movie = open_movie(tmp_path / "m.cine")
    assert np.array_equal(np.array(list(movie.frames())), frames[:2])
    assert "the file is cut off: it says that it holds 4 frames, 2 are there" in movie.notes[0]


def test_it_is_tracked_without_a_frame_rate(tmp_path):
    scene = Scene(shape=(112, 72), bubble=(35.3, 56.2), noise=2.0)
    write_cine(tmp_path / "m.cine", list(render(RADII[:, None], scene, np.random.default_rng(5))))
    words = ["track", str(tmp_path / "m.cine"), "--pixel", "2 um", "--out", str(tmp_path / "m.csv")]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    lines = [line for line in (tmp_path / "m.csv").read_text().splitlines() if not line.startswith("#")]
    table = list(csv.DictReader(lines))
    assert [float(row["R_um"]) for row in table if row["R_um"]] == pytest.approx(list(2 * RADII), abs=0.3)
    assert [float(row["t_us"]) for row in table] == pytest.approx([1e6 * k / RATE for k in range(len(table))])
