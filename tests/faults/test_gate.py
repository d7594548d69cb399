"""What is no plain file, is far too large, or sends the library that decodes it in circles: one error, at once."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import time
import zipfile
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest
import tifffile
from click.testing import CliRunner
from PIL import Image
from rows import row
from run_files import configuration, make_campaign
from test_commands import TWIN
from toy_config import write_toy

from en4dvar.cli import main
from en4dvar.config.document import read_document
from en4dvar.inputs.members import read_members, read_square
from en4dvar.inputs.parts import read_contents
from en4dvar.model.programs.control import from_pest
from en4dvar.model.programs.languages import check_template
from en4dvar.plumbing.decoding import Allowed, decoded_whole
from en4dvar.plumbing.errors import DataError, En4dvarError, OutputError
from en4dvar.plumbing.user_file import load
from en4dvar.report.result import load_result
from en4dvar.results import netcdf
from en4dvar.results.checkpoint import read_checkpoint
from en4dvar.results.netcdf import read_sealed, seal_file
from en4dvar.runs.runner import run, run_campaign
from en4dvar_movie.choice import read_corrections
from en4dvar_movie.frames import open_movie

ROWS = "t,y\n0,1\n1,2\n"
READERS = {
    "table.csv": read_contents,
    "matlab.mat": read_contents,
    "sheet.xlsx": read_contents,
    "square.csv": read_square,
    "members.nc": lambda path: read_members(path, {"a": ("1", "")}),
    "members.csv": lambda path: read_members(path, {"a": ("1", "")}),
    "config.yaml": read_document,
    "case.pst": from_pest,
    "in.tpl": lambda path: check_template(path, ["a"]),
    "law.py": lambda path: load(f"{path}:Law", "law"),
    "posterior.nc": load_result,
    "state.checkpoint": lambda path: read_checkpoint(path, "", Allowed),
    "corrections.txt": read_corrections,
    "movie.tif": lambda path: list(open_movie(path).frames()),
    "movie.mp4": lambda path: list(open_movie(path).frames()),
    "movie.raw": lambda path: list(open_movie(path, "32x32x8").frames()),
    "frames/0.png": lambda path: list(open_movie(path.parent).frames()),
    "frames/0.tif": lambda path: list(open_movie(path.parent).frames()),
}


def refused(name: str, path: Path) -> str:
    """What a reader says of a file that it refuses at once, in little memory."""
    began, memory = time.monotonic(), psutil.Process().memory_info().rss
    with pytest.raises((En4dvarError, ValueError)) as told:
        READERS[name](path)
    assert time.monotonic() - began < 60  # of a busy machine; a pipe or a terabyte would take for ever
    assert psutil.Process().memory_info().rss - memory < 300e6
    assert path.name in str(told.value)
    return str(told.value)


@pytest.mark.fault("no-file")
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    assert "a pipe" in refused(name, path)


@pytest.mark.fault("no-file")
@pytest.mark.parametrize("name", ["table.csv", "matlab.mat", "sheet.xlsx", "config.yaml", "movie.tif", "frames/0.png"])
def test_a_device_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.symlink_to("/dev/zero")
    assert "a device" in refused(name, path)


@pytest.mark.fault("sparse")
@pytest.mark.parametrize("name", READERS)
def test_a_sparse_file_of_a_terabyte_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as file:
        file.write(b"MATLAB 5.0".ljust(126) + b"IM" if name.endswith(".mat") else b"")
        file.truncate(10**12)
    refused(name, path)


def test_a_manifest_of_a_terabyte_is_refused(tmp_path: Path) -> None:
    run(configuration(write_toy(tmp_path), tmp_path / "run", executor="serial"))
    for name in ("posterior.nc", "run.log"):
        os.truncate(tmp_path / "run" / name, 10**12)
    began = time.monotonic()
    done = CliRunner().invoke(main, ["export", str(tmp_path / "run")])
    assert done.exit_code == 2
    assert "not a complete result of en4dvar" in done.output
    assert time.monotonic() - began < 20


def _self_pointing(path: Path) -> None:
    """A TIFF whose directory of pages leads back to itself."""
    tifffile.imwrite(path, np.zeros((4, 32, 32), np.uint8), photometric="minisblack")
    content = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", content, 4)
    (tags,) = struct.unpack_from("<H", content, first)
    struct.pack_into("<I", content, first + 2 + 12 * tags, first)
    path.write_bytes(content)


def _large_page(path: Path) -> None:
    tifffile.imwrite(path, np.zeros((30_000, 30_000), np.uint8), photometric="minisblack", compression="zlib")


def _metadata(path: Path) -> None:
    words = "ImageJ=1.11a\nimages=2\n" + "x=1\n" * 5_000_000
    tifffile.imwrite(path, np.zeros((2, 32, 32), np.uint8), photometric="minisblack", description=words)


@pytest.mark.slow
@pytest.mark.fault("decoding")
@pytest.mark.parametrize("make", [_self_pointing, _large_page, _metadata])
def test_a_tiff_that_does_not_end(tmp_path: Path, make) -> None:
    """It is refused, or read within its limits; the process that reads it is not this one."""
    path = tmp_path / "m.tif"
    make(path)
    began, memory = time.process_time(), psutil.Process().memory_info().rss
    try:
        told = f"m.tif: {len(list(open_movie(path).frames()))} frames"
    except DataError as error:
        told = str(error)
    assert "m.tif" in told
    assert time.process_time() - began < 5
    assert psutil.Process().memory_info().rss - memory < 300e6


@pytest.mark.fault("decoding")
@pytest.mark.parametrize("size", [0, 40, 1000, 2500, 4000, 6000])
def test_a_cut_mp4_is_told(tmp_path: Path, size: int) -> None:
    import av

    path = tmp_path / "m.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for k in range(8):
            picture = np.random.default_rng(k).integers(0, 255, (64, 64, 3), dtype=np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())
    os.truncate(path, size)
    done = CliRunner().invoke(main, ["track", str(path), "--pixel", "1 um", "--frame-rate", "1 kHz"])
    assert done.exit_code == 2
    assert "m.mp4" in done.output
    assert "Aborted" not in done.output
    assert done.exception is None or isinstance(done.exception, SystemExit)


def _wide(path: Path, rows: int, column: str) -> None:
    """A workbook of so many rows with one cell each, far to the right."""
    from openpyxl import Workbook

    book = Workbook()
    book.save(path)
    cells = "".join(f'<row r="{k}"><c r="{column}{k}"><v>1</v></c></row>' for k in range(1, rows + 1))
    sheet = (
        '<?xml version="1.0"?><worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">'
        f"<sheetData>{cells}</sheetData></worksheet>"
    )
    with zipfile.ZipFile(path) as archive:
        parts = {part: archive.read(part) for part in archive.namelist()}
    parts["xl/worksheets/sheet1.xml"] = sheet.encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, content in parts.items():
            archive.writestr(part, content)


@pytest.mark.fault("decoding")
def test_a_workbook_that_is_wide_where_nothing_stands(tmp_path: Path) -> None:
    _wide(tmp_path / "s.xlsx", 60_000, "NTO")  # column 9999
    assert "cells in sheet 'Sheet', with blank ones" in refused("sheet.xlsx", tmp_path / "s.xlsx")


def misbehave(path: Path, how: str):
    """Decoders that take too much; they run in the child."""
    if how == "time":
        while True:
            pass
    if how == "memory":
        yield bytearray(10**10)
    if how == "crash":
        os.abort()
    if how == "print":
        os.write(1, b"not an answer")
        print("neither")
    yield how


@pytest.mark.slow
@pytest.mark.fault("decoding")
@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("time", "takes more than 1 s of processor time to be read"),
        ("memory", "takes more than 100 MB of memory to be read"),
        ("crash", "ends the process that reads it (signal SIGABRT)"),
    ],
)
def test_limits_of_decoding(tmp_path: Path, monkeypatch, how: str, told: str) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)
    (tmp_path / "x").touch()
    allowed = Allowed(seconds=1, memory=10**8)
    with pytest.raises(DataError) as error:
        decoded_whole(misbehave, tmp_path / "x", how, allowed=allowed)
    assert told in str(error.value)
    assert row("decoding").told(str(error.value))
    assert decoded_whole(misbehave, tmp_path / "x", "print", allowed=allowed) == "print"


def _foreign(path: Path, how: str, other: Path) -> None:
    """Numbers of a netCDF file now lie in another one."""
    with h5py.File(path, "r+") as file:
        group = file["posterior"]
        del group["k"]
        shape = (1, group["A"].shape[-1])
        if how == "external":
            group.create_dataset("k", shape, "u1", external=[(str(other), 0, shape[1])])
        elif how == "virtual":
            with h5py.File(other.with_suffix(".h5"), "w") as source:
                source["k"] = np.ones(shape)
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource(str(other.with_suffix(".h5")), "k", shape)
            group.create_virtual_dataset("k", layout)
        else:
            group["k"] = h5py.ExternalLink(str(other.with_suffix(".h5")), "/k")


@pytest.mark.fault("foreign-data")
@pytest.mark.parametrize("how", ["external", "virtual", "link"])
def test_a_result_with_numbers_in_another_file_is_refused(tmp_path: Path, how: str) -> None:
    run(configuration(write_toy(tmp_path), tmp_path / "run", executor="serial"))
    file, other = tmp_path / "run" / "posterior.nc", tmp_path / "secret.txt"
    other.write_text("nobody else's business, and long enough for all members\n" * 9)
    content = file.read_bytes()
    file.write_bytes(content[: content.rindex(b"\nen4dvar-result")])
    _foreign(file, how, other)
    seal_file(file)
    for words in (["export", str(file.parent)], ["report", str(file.parent)]):
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 2, done.output
        assert row("foreign-data").told(done.output)
    with pytest.raises(DataError, match="which is not opened"):
        read_members(file, {"k": ("1", "")})


def _resealed(file: Path, change) -> None:
    """With a change of what it holds, and a good seal."""
    content = file.read_bytes()
    file.write_bytes(content[: content.rindex(b"\nen4dvar-result")])
    with h5py.File(file, "r+") as held:
        change(held)
    seal_file(file)


@pytest.fixture(scope="module")
def twin(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("twin")
    (folder / "twin.yaml").write_text(TWIN)
    done = CliRunner().invoke(main, ["run", str(folder / "twin.yaml"), "--out", str(folder / "run"), "--no-report"])
    assert done.exit_code == 0
    return folder / "run"


@pytest.mark.parametrize("what", ["analysis_mean", "analysis_std", "units"])
@pytest.mark.fault("result-incomplete")
def test_a_series_with_a_good_seal_that_lacks_something(twin: Path, tmp_path: Path, what: str) -> None:
    shutil.copytree(twin, tmp_path / "run")
    _resealed(tmp_path / "run" / "twin.nc", lambda held: held.__delitem__(what))
    done = CliRunner().invoke(main, ["export", str(tmp_path / "run"), "--latex"])
    assert done.exit_code == 2, done.output
    assert "not a result of en4dvar" in done.output


@pytest.mark.slow
@pytest.mark.parametrize("how", ["crash", "time"])
@pytest.mark.fault("decoding")
def test_a_sealed_file_that_takes_its_library_down(twin: Path, tmp_path: Path, monkeypatch, how: str) -> None:
    """Unless this process has written it itself, another one reads it."""
    file = Path(shutil.copy(twin / "twin.nc", tmp_path))
    assert read_sealed(who_reads, file) == [os.getpid()]
    monkeypatch.setattr(netcdf, "WRITTEN", set())
    assert read_sealed(who_reads, file) != [os.getpid()]
    monkeypatch.setattr(netcdf, "Allowed", lambda *_: Allowed(seconds=1))
    with pytest.raises(OutputError) as error:
        read_sealed(misbehave, file, how)
    assert str(error.value).startswith(f"{file}: ")
    assert row("decoding").told(str(error.value))


def who_reads(path: Path):
    """The process that does."""
    yield os.getpid()


@pytest.fixture(scope="module")
def together(tmp_path_factory) -> Path:
    """A joint estimate and a population."""
    folder = tmp_path_factory.mktemp("together")
    run_campaign(configuration(make_campaign(folder, 3), folder / "run", executor="serial"))
    for kind, option in (("joint", "--share"), ("population", "--of")):
        words = [kind, str(folder / "run"), option, "k", "--out", str(folder / kind)]
        assert CliRunner().invoke(main, words).exit_code == 0
    return folder


@pytest.mark.parametrize(("kind", "what"), [("joint", "fit/band"), ("population", "posterior/k_mean")])
@pytest.mark.fault("result-incomplete")
@pytest.mark.slow
def test_an_estimate_of_several_with_a_good_seal_that_lacks_something(
    together: Path, tmp_path: Path, kind: str, what: str
) -> None:
    out = shutil.copytree(together / kind, tmp_path / "out")
    _resealed(out / f"{kind}.nc", lambda held: held.__delitem__(what))
    done = CliRunner().invoke(main, ["report", str(out)])
    assert done.exit_code == 2, done.output
    assert row("result-incomplete").told(done.output)


PST = """pcf
* parameter data
A {kind} factor 1.0 {low} 10.0 pg 1.0 0.0 1
* observation data
h1 3.5 10.0 og
* model command line
true
* model input/output
line.tpl in
line.ins out
"""


@pytest.mark.parametrize(
    ("text", "instructions", "told"),
    [
        (PST.format(kind="log", low="0"), "pif @\nl1 !h1!\n", "case.pst:3: a is log, but its lower bound 0 is"),
        (PST.format(kind="none", low="10"), "pif @\nl1 !h1!\n", "case.pst:3: parval1 of a is 1, outside of its bounds"),
        (PST.format(kind="none", low="0\0"), "pif @\nl1 !h1!\n", r"case.pst:3: '0\x00' where A has a number"),
        (
            PST.format(kind="none", low="0").replace("line.ins out", "line.ins"),
            "pif @\n",
            "case.pst:10: a line of",
        ),
        (PST.format(kind="none", low="0"), "pif ", "case.pst: no instruction file"),
        (PST.format(kind="none", low="0"), "pif \n", "case.pst: no instruction file"),
        (PST.format(kind="none", low="0").replace("line.tpl", "line\0.tpl"), "pif @\n", "a null byte in its name"),
    ],
)
def test_control_files_of_pest_that_mean_nothing(tmp_path: Path, text: str, instructions: str, told: str) -> None:
    (tmp_path / "case.pst").write_text(text)
    (tmp_path / "line.ins").write_text(instructions)
    (tmp_path / "line.tpl").write_text("ptf ~\n~a~\n")
    with pytest.raises(En4dvarError) as error:
        from_pest(tmp_path / "case.pst")
    assert told in str(error.value)


def test_a_frame_of_a_folder_that_is_too_large(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((9000, 9000), np.uint8)).save(tmp_path / "0.png")
    with pytest.raises(DataError, match=r"frames of 9000 × 9000 pixels; at most 64 million are read"):
        list(open_movie(tmp_path).frames())


@pytest.mark.slow
def test_the_child_ends_with_its_parent(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.zeros((2, 32, 32), np.uint8), photometric="minisblack")
    code = (
        "import os, sys, psutil; from en4dvar_movie.frames import open_movie\n"
        "list(open_movie(sys.argv[1]).frames()); print(*[p.pid for p in psutil.Process().children()], flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    import sys

    from run_files import environment

    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "m.tif")], capture_output=True, text=True, env=environment()
    )
    children = list(map(int, done.stdout.split()))
    assert len(children) == 2  # the one that decodes, and the guard
    end = time.monotonic() + 10
    while any(map(psutil.pid_exists, children)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(psutil.pid_exists, children))
