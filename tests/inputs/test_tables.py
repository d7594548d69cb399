"""Tables of laboratories: no names, disorder, workbooks, MATLAB v7.3, matrices, and steps beside frames."""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from openpyxl import Workbook
from scipy.io import savemat

from en4dvar.inputs import parts
from en4dvar.inputs.implausible import step_doubts
from en4dvar.inputs.matfile import Variables, mat_variables
from en4dvar.inputs.parts import Column, Layout, parts_of, read_contents
from en4dvar.inputs.readers import Readings, read_series
from en4dvar.inputs.text_table import lines_of_workbook
from en4dvar.inputs.window import parse_instant
from en4dvar.plumbing.errors import DataError

TIME, RADIUS = Column("t", "us", "us"), Column("R", "um", "um")
FIRST, SECOND = Column("c1", "us", "us"), Column("c2", "um", "um")


def csv(tmp_path: Path, text: str, *columns: Column, **layout: Any) -> Readings:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    return read_series(tmp_path / "a.csv", *(columns or (TIME, RADIUS)), layout=Layout(**layout))


@pytest.mark.parametrize(
    ("text", "decimal"),
    [
        ("0,1\n1,2\n2,3\n", "."),
        ("Camera X\n0 1\n1 2\n2 3\n", "."),
        ("Camera;X\n\n0;1,0\n1,0;2\n2;3\n", ","),
        ("frame,size\n0,1\n1,2\n2,3\n", "."),
    ],
)
def test_columns_without_names_are_counted(tmp_path, text, decimal):
    series = csv(tmp_path, text, FIRST, SECOND, decimal=decimal)
    assert series.times.tolist() == [0, 1, 2]
    assert series.values.tolist() == [1, 2, 3]
    if text[0] == "0":
        assert list(read_contents(tmp_path / "a.csv").columns) == ["c1", "c2"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("Camera,X\nrate,2e6\n\nt,R\nus,um\n0,1\n1,2\n", ["t", "R"]),
        ("t,R\n0,1\n1,2\nend of film\n", ["t", "R"]),
        ("a b c\nt;R;note\n0;1;\n1;2;blurred\n", ["t", "R"]),
        ("t\tR\nus\tum\n\tbubble 3\n0\t1\n1\t2\n", ["t", "R"]),
        ("t\tR\nus\tum\nrun 2\t2 MPa, slow\n0\t1\n1\t2\n", ["t", "R"]),
        ("X,2026\nus,um\nt,R\n0,1\n1,2\n", ["t", "R"]),
    ],
)
def test_the_names_are_found_above_the_numbers(tmp_path, text, names):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    contents = read_contents(tmp_path / "a.csv")
    assert {*contents.columns, *contents.others} - {"note"} == {*names}


@pytest.mark.parametrize(
    ("since", "times"),
    [("start", [0, 1, 2, 3, 4, 5]), ("minimum", [2, 3, 4, 5]), ("top", [4, 5]), ("2.5 us", [3, 4, 5])],
)
def test_what_is_before_an_instant_is_left_out(tmp_path, since, times):
    (tmp_path / "a.csv").write_text("t,R,s\n" + "".join(f"{t},{R},{t + 1}\n" for t, R in enumerate([5, 4, 1, 4, 6, 3])))
    layout = Layout(since=parse_instant(since, "us"))
    series = read_series(tmp_path / "a.csv", TIME, RADIUS, layout, [Column("s", "um", "um")], fewest=2)
    assert series.times.tolist() == times
    assert series.values.tolist() == [5, 4, 1, 4, 6, 3][-len(times) :]
    assert series.errors["s"].tolist() == [t + 1 for t in times]


@pytest.mark.parametrize(
    ("since", "words"),
    [
        ("trough 2", "data.since asks for minimum 2, but only 1 minima"),
        ("4 us", "data.since leaves 2 of 6 readings; at least 3 are needed"),
    ],
)
def test_too_little_after_an_instant(tmp_path, since, words):
    text = "t,R\n" + "".join(f"{t},{R}\n" for t, R in enumerate([5, 4, 1, 4, 6, 3]))
    with pytest.raises(DataError, match=rf"a\.csv: {words}"):
        csv(tmp_path, text, since=parse_instant(since, "us"))


def test_rows_are_sorted_and_repeated_ones_averaged_where_it_is_said(tmp_path):
    text = "t,R,s\n2,5,1\n0,1,3\n1,2,3\n1,4,4\n3,7,1\n"
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    read = Layout(unsorted="sort", repeated="average")
    series = read_series(tmp_path / "a.csv", TIME, RADIUS, read, [Column("s", "um", "um")])
    assert series.times.tolist() == [0, 1, 2, 3]
    assert series.values.tolist() == [1, 3, 5, 7]
    assert series.errors["s"].tolist() == [3, 2.5, 1, 1]
    with pytest.raises(DataError, match=r"a\.csv:3: times must increase, but 0 us follows 2 us"):
        csv(tmp_path, text)
    with pytest.raises(DataError, match=r"a\.csv:5: .* 1 us follows 1 us; .* \(data\.repeated: average\)"):
        csv(tmp_path, text, unsorted="sort")
    with pytest.raises(DataError, match=r"a\.csv:3: .* 0 us follows 2 us"):
        csv(tmp_path, text, repeated="average")


def book(path: Path, **sheets: list[list[Any]]) -> Path:
    made = Workbook()
    made.remove(made.active)
    for name, rows in sheets.items():
        sheet = made.create_sheet(name)
        for row in rows:
            sheet.append(row)
    made.save(path)
    return path


ROWS = [["t", "R"], ["us", "um"], [0, 1.5], [1, 2], [2, None], [3, 1 / 3]]


def test_sheets_and_ranges(tmp_path):
    path = book(tmp_path / "a.xlsx", film=[["by hand"], [], *ROWS], empty=[[]])
    series = read_series(path, TIME, RADIUS)  # the only sheet with anything in it
    assert series.values.tolist() == [1.5, 2, 1 / 3]
    path = book(tmp_path / "b.xlsx", film=ROWS, other=[[None, "x", *row] for row in ROWS])
    for asked in ("film", "film!A1:B6", "'other'!$C$1:$D$6", "other!C1:D6"):
        assert read_series(path, TIME, RADIUS, Layout(sheet=asked)).times.tolist() == [0, 1, 3]
    with pytest.raises(DataError, match=r"b\.xlsx: 2 sheets hold something; say which \(data\.sheet\): film, other"):
        read_series(path, TIME, RADIUS)
    with pytest.raises(DataError, match=r"no sheet 'flim'; did you mean 'film'"):
        read_series(path, TIME, RADIUS, Layout(sheet="flim"))
    with pytest.raises(DataError, match=r"b\.xlsx: no column 'R'; the columns are: x"):
        read_series(path, TIME, RADIUS, Layout(sheet="other!B1:C6"))


def test_bubbles_of_a_sheet(tmp_path):
    rows = [["gel", "t", "R"], *[[name, k, k + i] for i, name in enumerate("ab") for k in range(3)]]
    path, by = book(tmp_path / "a.xlsx", film=rows), Layout(by="gel")
    assert parts_of(path, RADIUS, by, "t") == ("a", "b")
    assert read_series(path, TIME, RADIUS, by, part="b").values.tolist() == [1, 2, 3]
    path = book(tmp_path / "b.xlsx", film=[["t", "R_1", "R_2"], [0, 1, 2], [1, 2, 3], [2, 3, 4]])
    several = Column("R_*", "um", "um")
    assert parts_of(path, several) == ("R_1", "R_2")
    assert read_series(path, TIME, several, part="R_2").values.tolist() == [2, 3, 4]
    path = tmp_path / "c.csv"
    path.write_text("t,R_1 [um],R_2 [um],R_1 [px]\n0,1,2,3\n1,2,3,4\n2,3,4,5\n")
    assert parts_of(path, Column("R_* [um]", "um", "um")) == ("R_1 [um]", "R_2 [um]")
    assert read_series(path, TIME, Column("R_* [um]", "um", "um"), part="R_2 [um]").values.tolist() == [2, 3, 4]


def test_a_further_format_of_variables_is_read_in_every_way(tmp_path, monkeypatch):
    def archive(path):
        with np.load(path) as held:
            return Variables({name: np.atleast_1d(held[name]) for name in held.files})

    monkeypatch.setitem(parts.VARIABLES, "npz", archive)
    path, layout, several = tmp_path / "a.npz", Layout(format="npz"), Column("R_*", "um", "um")
    np.savez(path, t=np.arange(3.0), R_1=np.arange(1.0, 4), R_2=np.arange(2.0, 5), gel=7.0)
    contents = read_contents(path, layout)
    assert (list(contents.columns), contents.scalars) == (["t", "R_1", "R_2"], {"gel": 7.0})
    assert parts_of(path, several, layout) == ("R_1", "R_2")
    assert read_series(path, TIME, several, layout, part="R_2").values.tolist() == [2, 3, 4]
    assert parts_of(path, Column("R_1", "um", "um"), layout) == ()


def test_bad_cells_and_formulas_are_told_with_their_place(tmp_path):
    path = book(tmp_path / "a.xlsx", film=[*ROWS, [4, "#DIV/0!"]])
    with pytest.raises(DataError, match=r"a\.xlsx:7: '#DIV/0!' in column 'R' is not a number"):
        read_series(path, TIME, RADIUS)
    path = book(tmp_path / "a.xlsx", film=[*ROWS, [4, "=B3+1"]])
    with pytest.raises(DataError, match=r"a\.xlsx:7: cell B7 holds a formula without a stored value"):
        read_series(path, TIME, RADIUS)


def rewritten(path: Path, change: Any) -> Path:
    """The workbook with ``change`` made to the XML of its sheet."""
    out = path.with_name("b.xlsx")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for part in old.infolist():
            content = old.read(part)
            new.writestr(part.filename, change(content) if "sheet1" in part.filename else content)
    return out


def test_workbooks_of_strangers(tmp_path):
    path = book(tmp_path / "a.xlsx", film=ROWS)
    entities = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    with pytest.raises(DataError, match=r"b\.xlsx: xl/worksheets/sheet1\.xml declares entities"):
        read_series(rewritten(path, lambda xml: entities + xml), TIME, RADIUS)
    with pytest.raises(DataError, match=r"b\.xlsx: \d+ parts that unpack to 258 MiB"):
        read_series(rewritten(path, lambda xml: xml + b" " * (258 << 20)), TIME, RADIUS)
    with pytest.raises(DataError, match=r"b\.xlsx: cannot be read as a workbook"):
        read_series(rewritten(path, lambda xml: xml[:200]), TIME, RADIUS)
    (tmp_path / "c.xlsx").write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"c\.xlsx: cannot be read as a workbook"):
        read_series(tmp_path / "c.xlsx", TIME, RADIUS)


def hdf(path: Path, fill: Any) -> Path:
    """A file of version 7.3 as MATLAB writes it; ``fill`` puts variables into it."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    path.write_bytes(head + path.read_bytes()[128:])
    return path


def put(group: Any, name: str, values: Any, kind: str = "double", **options: Any) -> Any:
    values = np.asarray(values, dtype=options.pop("dtype", float))
    made = group.create_dataset(name, data=values.T, **options)
    made.attrs["MATLAB_class"] = np.bytes_(kind)
    return made


def laboratory(file: Any) -> None:
    put(file, "t", np.arange(4.0)[None], compression="gzip", shuffle=True)
    put(file, "M", np.arange(8.0).reshape(4, 2))
    put(file, "dt", [[0.5]])
    put(file, "note", [[65, 66]], "char", dtype="u2")
    put(file, "none", [0, 0], dtype="u8").attrs["MATLAB_empty"] = 1
    hidden = file.create_group("#refs#")
    radii = [put(hidden, f"r{k}", 9.0 - np.arange(4)[:, None] - k).ref for k in range(3)]
    rest = [put(hidden, f"q{k}", [[2.0 + k]]).ref for k in range(3)]
    array = file.create_group("expts")
    array.attrs["MATLAB_class"] = np.bytes_("struct")
    for name, references in (("R", radii), ("Req", rest)):
        array.create_dataset(name, data=np.array(references, dtype=object)[:, None], dtype=h5py.ref_dtype)
    film = file.create_group("film")
    film.attrs["MATLAB_class"] = np.bytes_("struct")
    put(film, "R", np.arange(4.0)[:, None])
    cells = file.create_dataset("C", data=np.array(radii, dtype=object)[:, None], dtype=h5py.ref_dtype)
    cells.attrs["MATLAB_class"] = np.bytes_("cell")


def test_matlab_73_holds_what_version_5_does(tmp_path):
    """The same content by scipy as version 5: the same names and numbers."""
    new = mat_variables(hdf(tmp_path / "new.mat", laboratory))
    array = np.empty(3, dtype=[("R", object), ("Req", object)])
    cells = np.empty(3, dtype=object)
    for k in range(3):
        array[k] = (9.0 - np.arange(4) - k, 2.0 + k)
        cells[k] = 9.0 - np.arange(4) - k
    content = {"t": np.arange(4.0), "M": np.arange(8.0).reshape(4, 2), "dt": 0.5, "note": "AB", "none": np.ones((0, 0))}
    savemat(tmp_path / "old.mat", {**content, "expts": array, "film": {"R": np.arange(4.0)}, "C": cells})
    old = mat_variables(tmp_path / "old.mat")
    assert new.scalars == old.scalars
    assert new.others == old.others
    for one, other in ((new.vectors, old.vectors), (new.matrices, old.matrices)):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one)
    expts = Column("expts.R", "um", "um")
    assert parts_of(tmp_path / "new.mat", expts) == ("1", "2", "3")
    series = read_series(tmp_path / "new.mat", TIME, expts, part="2")
    assert series.values.tolist() == [8, 7, 6, 5]
    assert series.scalars["expts.Req"] == 3.0


def test_matlab_73_of_strangers(tmp_path):
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["R"] = np.arange(4.0)
    raw = tmp_path / "raw.bin"
    raw.write_bytes(np.arange(4.0).tobytes())

    def linked(file: Any) -> None:
        put(file, "t", np.arange(4.0)[None])
        file["R"] = h5py.ExternalLink(str(secret), "/R")

    with pytest.raises(DataError, match=r"field 'R' is a link, which is not followed"):
        read_series(hdf(tmp_path / "a.mat", linked), TIME, RADIUS)

    def elsewhere(file: Any) -> None:
        file.create_dataset("R", (4,), "f8", external=[(str(raw), 0, 32)])

    with pytest.raises(DataError, match=r"a\.mat: the numbers of R are in another file"):
        mat_variables(hdf(tmp_path / "a.mat", elsewhere))

    def virtual(file: Any) -> None:
        layout = h5py.VirtualLayout((4,), "f8")
        layout[:] = h5py.VirtualSource(str(secret), "R", (4,))
        file.create_virtual_dataset("R", layout)

    with pytest.raises(DataError, match=r"a\.mat: the numbers of R are in another file"):
        mat_variables(hdf(tmp_path / "a.mat", virtual))
    with pytest.raises(DataError, match=r"a\.mat: more than \d+ numbers in vectors"):
        mat_variables(hdf(tmp_path / "a.mat", lambda f: f.create_dataset("R", (1 << 40,), "f8", chunks=(1024,))))
    with pytest.raises(DataError, match=r"a\.mat: R is packed by a filter"):
        mat_variables(hdf(tmp_path / "a.mat", lambda f: f.create_dataset("R", (64,), "f8", compression="lzf")))

    def circle(file: Any) -> None:
        group = file.create_group("a")
        group["b"] = group

    assert mat_variables(hdf(tmp_path / "a.mat", circle)).vectors == {}
    whole = hdf(tmp_path / "a.mat", laboratory).read_bytes()
    (tmp_path / "a.mat").write_bytes(whole[:2000])
    with pytest.raises(DataError, match=r"a\.mat: cannot be read as a MATLAB file"):
        mat_variables(tmp_path / "a.mat")


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    """By what decodes, which a child does elsewhere."""
    path = book(tmp_path / "a.xlsx", film=ROWS)
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(DataError, match=r"a\.xlsx: .*pip install openpyxl"):
        list(lines_of_workbook(path, ""))


def test_columns_and_rows_of_matrices(tmp_path):
    radii = np.arange(20.0).reshape(4, 5) + 1
    savemat(tmp_path / "a.mat", {"M": np.column_stack([np.arange(4.0), radii]), "T": radii.T, "t": np.arange(4.0)})
    path = tmp_path / "a.mat"
    time = Column("M(:,1)", "us", "us")
    assert read_series(path, time, Column("M(:,3)", "um", "um")).values.tolist() == radii[:, 1].tolist()
    assert parts_of(path, Column("M(:,*)", "um", "um"), time="M(:,1)") == tuple(f"M(:,{k})" for k in range(2, 7))
    rows = Column("T(*,:)", "um", "um")
    assert parts_of(path, rows) == tuple(f"T({k},:)" for k in range(1, 6))
    assert read_series(path, TIME, rows, part="T(5,:)").values.tolist() == radii[:, 4].tolist()
    with pytest.raises(
        DataError,
        match=r"field 'M\(:,9\)' is not in the file; .* columns of a matrix are M\(:,1\), M\(:,2\), …, rows M\(1,:\)",
    ):
        read_series(path, time, Column("M(:,9)", "um", "um"))


STEP = 1.4


@pytest.mark.parametrize(
    ("times", "scalars", "rate", "words"),
    [
        (STEP * np.arange(20), {}, None, ""),
        (np.round(STEP * np.arange(20), 1), {}, None, ""),
        (STEP * np.delete(np.arange(20.0), [3, 4, 9]), {"fps": 1e6 / STEP, "dt": STEP * 1e-6}, 1 / STEP, ""),
        (np.cumsum(np.random.default_rng(0).exponential(size=20)), {}, None, ""),  # no film
        (STEP * np.arange(0, 40, 2), {}, 1 / STEP, ""),  # every second frame
        (STEP * np.r_[0:7, 7.5, 8:20], {}, None, "2 of 19 steps .* frames of 1.4 us, the first from 8.4 to 10.5 us"),
        (STEP * np.arange(20), {"deltat": 3.7037e-6}, None, "the times are 1.4 us apart, but deltat .* is 3.7037e-06"),
        (STEP * np.arange(20), {"FrameRate": 27.0}, None, "but FrameRate of the file is 27"),
        (STEP * np.arange(20), {}, 0.27, "at the given rate one takes 3.704 us"),
    ],
)
def test_steps_beside_frames(times, scalars, rate, words):
    found = step_doubts(times, "us", "us", scalars, rate)
    assert len(found) == bool(words)
    if words:
        assert re.search(words, found[0].words)
