"""Reading movies: each format gives the same frames, each fault one message."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from PIL import Image

from en4dvar.plumbing.errors import DataError
from en4dvar_movie.choice import read_corrections
from en4dvar_movie.frames import open_movie, with_scale, write_movie

FRAMES = np.random.default_rng(2).integers(0, 256, (4, 32, 48), dtype=np.uint8)


def read(path, raw=None):
    return np.array(list(open_movie(path, raw).frames()))


def test_tiff_png_and_raw_give_the_frames(tmp_path):
    tifffile.imwrite(tmp_path / "m.tif", FRAMES, photometric="minisblack")
    (tmp_path / "folder").mkdir()
    for k in (2, 0, 1, 3):
        Image.fromarray(FRAMES[k]).save(tmp_path / "folder" / f"frame{k + 8}.png")  # 8, 9, 10, 11: not as text
    (tmp_path / "m.raw").write_bytes(FRAMES.tobytes())
    for path, raw in (("m.tif", None), ("folder", None), ("m.raw", "48x32x8")):
        assert np.array_equal(read(tmp_path / path, raw), FRAMES)


def test_sixteen_bits(tmp_path):
    deep = FRAMES.astype(np.uint16) * 16
    tifffile.imwrite(tmp_path / "m.tif", deep, photometric="minisblack")
    (tmp_path / "m.raw").write_bytes(deep.tobytes())
    assert np.array_equal(read(tmp_path / "m.tif"), deep)
    assert np.array_equal(read(tmp_path / "m.raw", "48x32x12"), deep)


def test_frames_of_a_folder_come_in_the_order_of_their_numbers(tmp_path):
    for k in (1, 2, 10):
        Image.fromarray(FRAMES[0] * 0 + k).save(tmp_path / f"²{k}.png")
    assert read(tmp_path)[:, 0, 0].tolist() == [
        1,
        *[2] * 8,
        10,
    ]  # the last one before stands for those that are missing


@pytest.mark.slow
def test_video(tmp_path):
    import av

    smooth = np.stack([np.add.outer(np.arange(32), np.arange(48)) * 2 + 10 * k for k in range(4)]).astype(np.uint8)
    with av.open(str(tmp_path / "m.avi"), "w") as file:
        stream = file.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuvj420p"
        for frame in smooth:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.stack([frame] * 3, -1), format="rgb24")))
        file.mux(stream.encode())
    assert np.abs(read(tmp_path / "m.avi").astype(int) - smooth).mean() < 3


def test_a_video_of_sixteen_bits_keeps_them(tmp_path):
    import av

    deep = np.random.default_rng(3).integers(0, 2**16, (3, 32, 48), dtype=np.uint16)
    with av.open(str(tmp_path / "m.mkv"), "w") as file:
        stream = file.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "gray16le"
        for frame in deep:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray16le")))
        file.mux(stream.encode())
    assert np.array_equal(read(tmp_path / "m.mkv"), deep)


def test_scale_is_the_files_own_or_asked_for(tmp_path):
    tifffile.imwrite(
        tmp_path / "m.tif", FRAMES, imagej=True, resolution=(0.5, 0.5), metadata={"unit": "um", "finterval": 1e-5}
    )
    found = with_scale(open_movie(tmp_path / "m.tif"), None, None)
    assert found.pixel == pytest.approx(2e-6)
    assert found.rate == pytest.approx(1e5)
    tifffile.imwrite(tmp_path / "n.tif", FRAMES, photometric="minisblack")
    with pytest.raises(DataError, match=r"never guessed: add --pixel '2.76 um' --frame-rate"):
        with_scale(open_movie(tmp_path / "n.tif"), None, None)


def test_a_coloured_movie_is_read_in_the_colour_of_its_lamp(tmp_path):
    tifffile.imwrite(tmp_path / "m.tif", np.stack([FRAMES, FRAMES // 4, FRAMES // 8], axis=-1), photometric="rgb")
    movie = open_movie(tmp_path / "m.tif")
    assert np.array_equal(np.array(list(movie.frames())), FRAMES)
    assert "red" in movie.notes[0]


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_the_mosaic_of_a_colour_camera_is_made_even(tmp_path, kind):
    """Of rendered movies 0 to 7 of 44 frames were read, those with radii 9 to 25 pixels too large."""
    j, i = np.indices((33, 48))
    light = np.random.default_rng(1).normal(150.0, 4.0, (3, 33, 48)) * (1 - 0.7 * (np.hypot(j - 16, i - 20) < 9))
    mosaic = np.where((i % 2 == 0) & (j % 2 == 0), 0.6, np.where(i % 2 + j % 2 == 2, 0.4, 1.0))
    tifffile.imwrite(tmp_path / "m.tif", (light * mosaic).astype(kind), photometric="minisblack")
    tifffile.imwrite(tmp_path / "n.tif", light.astype(kind), photometric="minisblack")
    movie, plain = open_movie(tmp_path / "m.tif"), open_movie(tmp_path / "n.tif")
    np.testing.assert_allclose(np.array(list(movie.frames())), light, atol=9)
    assert "pattern of 2 × 2" in movie.notes[0]
    assert np.array_equal(np.array(list(plain.frames())), light.astype(kind))
    assert not plain.notes


def damaged(folder, kind):
    path = folder / {"folder": "empty", "video": "m.mp4", "kind": "m.pdf"}.get(kind, "m.tif")
    if kind == "folder":
        path.mkdir()
    elif kind == "half":
        tifffile.imwrite(path, FRAMES, imagej=True)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind == "shapes":
        with tifffile.TiffWriter(path) as file:
            for k in range(3):
                file.write(FRAMES[k, : 32 - 4 * (k == 2)])
    else:
        path.write_bytes({"empty": b"", "cut": b"II*\0\x08\0\0\0\xff", "video": b"no movie" * 9, "kind": b"%PDF"}[kind])
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("empty", "the file is empty"),
        ("cut", "cannot be read"),
        ("half", "damaged or cut off: not all of its frames are there"),
        ("video", "cannot be read as a movie"),
        ("kind", "not a movie by its suffix"),
        ("folder", "holds no frame"),
        ("shapes", "frame 2 is 48 × 28, the first 48 × 32"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_message(tmp_path, kind, words):
    path = damaged(tmp_path, kind)
    with pytest.raises(DataError, match=words) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_scribbled_stack_is_read_or_refused_in_one_message(tmp_path):
    tifffile.imwrite(tmp_path / "whole.tif", FRAMES[:4], imagej=True, metadata={"unit": "um", "finterval": 1e-6})
    whole = np.frombuffer((tmp_path / "whole.tif").read_bytes(), np.uint8)
    refused = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        scribbled = whole.copy()
        scribbled[rng.integers(0, 400, rng.integers(1, 20))] = rng.integers(0, 256)
        (tmp_path / "m.tif").write_bytes(scribbled.tobytes())
        try:
            assert len(read(tmp_path / "m.tif"))
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 50
    assert not any("\n" in words for words in refused)


def test_a_stack_of_one_page_that_announces_many(tmp_path):
    """ImageJ's way beyond 4 GB, here with the high byte first."""
    deep = (FRAMES.astype(np.uint16) * 16).astype(">u2")
    words = "ImageJ=1.53\nimages=4\nframes=4\nunit=um\nfinterval=1e-6\n"
    tifffile.imwrite(
        tmp_path / "m.tif", deep[0], photometric="minisblack", description=words, metadata=None, byteorder=">"
    )
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        start = file.pages[0].dataoffsets[0]
    (tmp_path / "m.tif").write_bytes((tmp_path / "m.tif").read_bytes()[:start] + deep.tobytes())
    found = read(tmp_path / "m.tif")
    assert np.array_equal(found, deep)
    assert found.dtype.isnative


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_a_grey_video_is_written_without_loss(tmp_path, suffix):
    write_movie(tmp_path / f"m{suffix}", iter(FRAMES), 4, 1e-6, 1e5)
    assert np.array_equal(read(tmp_path / f"m{suffix}"), FRAMES)


@pytest.mark.parametrize("suffix", [".tif", ".avi"])
def test_a_movie_that_ends_in_an_error_leaves_the_earlier_one(tmp_path, suffix):
    def frames():
        yield from FRAMES[:2]
        raise OSError("the disk is full")

    path = tmp_path / f"m{suffix}"
    path.write_bytes(b"earlier")
    with pytest.raises(DataError, match="cannot be written: the disk is full"):
        write_movie(path, frames(), 4, 1e-6, 1e5)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {path.name: b"earlier"}


def test_a_video_that_is_cut_off_says_what_is_missing_and_which_frame_is_damaged(tmp_path):
    write_movie(tmp_path / "m.avi", iter(np.tile(FRAMES, (5, 1, 1))), 20, 1e-6, 1e5)
    whole = (tmp_path / "m.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) // 2])
    movie = open_movie(tmp_path / "cut.avi")
    for _ in range(2):  # a tracker runs through a movie twice
        there = len(list(movie.frames()))
    assert 5 < there < 15
    assert movie.damaged == {there - 1}
    assert movie.notes == [
        f"{tmp_path / 'cut.avi'}: the file is cut off: it says that it holds 20 frames, {there} are there"
    ]
    assert not open_movie(tmp_path / "m.avi").damaged


@pytest.mark.parametrize(
    ("name", "codec", "kind", "options", "told"),
    [
        ("m.avi", "mpeg4", "yuv420p", {}, "mpeg4"),
        ("m.avi", "mjpeg", "yuvj420p", {}, "mjpeg"),
        ("m.mp4", "libx264", "yuv420p", {"crf": "30"}, "h264"),
        ("m.mp4", "libx264", "gray", {"qp": "0"}, ""),
        ("m.mkv", "ffv1", "gray", {}, ""),
    ],
)
def test_a_video_that_has_lost_light_is_told(tmp_path, name, codec, kind, options, told):
    import av

    with av.open(str(tmp_path / name), "w") as file:
        stream = file.add_stream(codec, rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = 32, 48, kind
        for frame in FRAMES:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray").reformat(format=kind)))
        file.mux(stream.encode())
    words = "".join(open_movie(tmp_path / name).notes)
    assert f"compressed with loss ({told}): R_std" in words if told else not words


def test_an_interlaced_movie(tmp_path):
    import av

    with av.open(str(tmp_path / "m.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        stream.options = {"flags": "+ildct+ilme", "x264-params": "interlaced=1:tff=1"}
        for frame in FRAMES:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        file.mux(stream.encode())
    with pytest.raises(DataError, match="interlaced; save whole frames"):
        read(tmp_path / "m.mp4")


def test_raw_of_another_length(tmp_path):
    (tmp_path / "m.raw").write_bytes(FRAMES.tobytes()[:-1])
    with pytest.raises(DataError, match="not a whole number of frames"):
        open_movie(tmp_path / "m.raw", "48x32x8")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("3 out\n3 out", "c.txt:2: frame 3 was corrected"),
        ("x out", "c.txt:1: write FRAME"),
        ("4 1 2", "c.txt:1: '1 2'"),
    ],
)
def test_faults_of_corrections_name_the_line(tmp_path, text, words):
    (tmp_path / "c.txt").write_text(text)
    with pytest.raises(DataError, match=words):
        read_corrections(tmp_path / "c.txt")
