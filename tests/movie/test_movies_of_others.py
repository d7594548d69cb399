"""``en4dvar track`` on every kind of file that a laboratory has, each written by the library of its format."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from PIL import Image

from en4dvar.cli import main
from en4dvar_movie.scene import Scene, render

RADII = np.array([12.3, 19.0, 24.7, 21.2, 15.5, 9.1])
UPRIGHT = Scene(shape=(112, 72), bubble=(35.3, 56.2), noise=2.0)  # 112 rows of 72 pixels
DEEP = {10: 4.0, 12: 16.0, 16: 200.0}  # bits → grey levels of a level of 8 bit
SCALE = ["--pixel", "2 um", "--frame-rate", "200 kHz", "--out", "m.csv"]


def filmed(scene=UPRIGHT, brighter=1.0, bits=8):
    scene = replace(scene, level=brighter * scene.level, noise=brighter * scene.noise, bits=bits)
    return list(render(RADII[:, None], scene, np.random.default_rng(5)))


def video(path, frames, codec, kind, given="gray", **options):
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.options = kind, options
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=given).reformat(format=kind)))
        file.mux(stream.encode())


def pictures(folder, frames, suffix, mode="L"):
    folder.mkdir()
    for k, frame in enumerate(frames):
        Image.fromarray(frame).convert(mode).save(folder / f"shot_{k + 8}{suffix}")


def gif(path):
    first, *others = (Image.fromarray(frame) for frame in filmed())
    first.save(path, save_all=True, append_images=others, duration=40, disposal=1)


def raw(path, bits):
    np.array(filmed(brighter=DEEP.get(bits, 1.0), bits=8 if bits == 8 else 16)).tofile(path)


def stack(path, bits, **options):
    frames = np.array(filmed(brighter=DEEP.get(bits, 1.0), bits=bits))
    tifffile.imwrite(path, frames, photometric="minisblack", **options)


KINDS = {
    "m.gif": gif,
    "m.mp4": lambda path: video(path, filmed(), "libx264", "gray", qp="0"),
    "lossy.mp4": lambda path: video(path, filmed(), "libx264", "yuv420p", crf="18"),
    "m.avi": lambda path: video(path, filmed(), "rawvideo", "gray"),
    "jpeg.avi": lambda path: video(path, filmed(), "mjpeg", "yuvj420p", qscale="2"),
    "ten bit.mkv": lambda path: video(path, filmed(brighter=200.0, bits=16), "ffv1", "gray10le", "gray16le"),
    "sixteen bit.mkv": lambda path: video(path, filmed(brighter=200.0, bits=16), "ffv1", "gray16le", "gray16le"),
    "m.tif": lambda path: stack(path, 8),
    "deep.tif": lambda path: stack(path, 16),
    "packed.tif": lambda path: stack(path, 16, compression="zlib"),
    "imagej.tif": lambda path: stack(path, 16, imagej=True),
    "png": lambda path: pictures(path, filmed(), ".png"),
    "palette": lambda path: pictures(path, filmed(), ".png", "P"),
    "bmp": lambda path: pictures(path, filmed(), ".bmp"),
    "jpg": lambda path: pictures(path, filmed(), ".jpg"),
    "png of 16 bit": lambda path: pictures(path, filmed(brighter=200.0, bits=16), ".png", "I;16"),
    "72x112x8": lambda path: raw(path, 8),
    "72x112x10": lambda path: raw(path, 10),
    "72x112x12": lambda path: raw(path, 12),
    "72x112x16": lambda path: raw(path, 16),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_radii_are_read_from_movies_of_every_kind(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    KINDS[name](tmp_path / name)
    outcome = CliRunner().invoke(main, ["track", name, *SCALE, *(["--raw", name] if name.startswith("72") else [])])
    assert outcome.exit_code == 0, outcome.output
    lines = [line for line in (tmp_path / "m.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert [row["used"] for row in rows] == [*"000", *"1" * len(RADII)]
    read = np.array([[float(row[key]) for key in ("R_um", "R_std_um", "x_um", "y_um")] for row in rows[3:]]) / 2
    off = np.abs(read[:, 0] - RADII)
    assert np.all(off < np.maximum(5 * read[:, 1], 0.1))
    assert off.max() < 0.3
    np.testing.assert_allclose(read[:, 2:], [UPRIGHT.bubble] * len(RADII), atol=0.2)


def most_memory(folder, frames):
    """Bytes that a process takes at most which tracks so many frames of 96 × 64, from a raw file."""
    few = list(render(np.tile(RADII, 5)[:, None], Scene(shape=(64, 96), noise=2.0), np.random.default_rng(1)))
    with (folder / "m.raw").open("wb") as file:
        for k in range(frames):
            file.write(few[k if k < 3 else 3 + (k - 3) % 30].tobytes())
    words = ["track", "m.raw", "--raw", "96x64x8", *SCALE, "--force", "--workers", "1"]
    code = (
        "import resource, sys\nfrom en4dvar.cli import main\ntry:\n    main(sys.argv[1:])\nfinally:\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=folder, capture_output=True, text=True, check=True)
    assert f"{frames - 3} of {frames} frames read" in done.stdout
    return 1024 * int(done.stdout.split()[-1])


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted in KiB on Linux")
def test_a_movie_of_sixty_megabytes_is_never_held_whole(tmp_path: Path):
    short, long = most_memory(tmp_path, 300), most_memory(tmp_path, 10_000)
    assert (tmp_path / "m.raw").stat().st_size > 60e6
    assert long - short < 60e6
