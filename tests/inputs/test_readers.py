"""CSV and .mat files, good and bad."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from en4dvar.inputs.parts import Column, Layout, TimeStep, read_contents
from en4dvar.inputs.readers import BELOW, FAR, Readings, read_series
from en4dvar.plumbing.errors import DataError

TIME, RADIUS = Column("t", "us", "s"), Column("R", "um", "m")


def csv(tmp_path: Path, text: str) -> Readings:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    return read_series(path, TIME, RADIUS)


def mat(tmp_path: Path, time: Column | TimeStep = TIME, **fields: Any) -> Readings:
    savemat(tmp_path / "a.mat", fields)
    return read_series(tmp_path / "a.mat", time, RADIUS)


@pytest.mark.parametrize(
    "text",
    [
        "t,R\n0,1\n1,2\n2,3\n",
        "# by hand\n\nid; R ;t\nx;1;0\nx;2;1\n\n# pause\nx;3;2\n",
        "t\tR\n0\t1\n1\t2\n2\t3\n",
        "  t   R\n  0   1\n  1   2\n  2   3\n",
        "Camera X\nrate;2,5e5\nlens;10x\n\nt,R\nus,um\n[µs],-\n0,1\n1,2\n2,3\n",
        "\ufefft,R\r\n0,1\r\n0.5,nan\r\n0.6,\r\n1,2\r\n2,3\r\n",
        't,"R"\n"0","1"\n1,2\n2,3\n',
    ],
)
def test_csv_dialects(tmp_path: Path, text: str) -> None:
    series = csv(tmp_path, text)
    assert series.times.tolist() == [0.0, 1e-6, 2e-6]
    assert series.values.tolist() == [1e-6, 2e-6, 3e-6]


def test_no_number_of_0_or_below_is_a_reading_of_what_is_positive(tmp_path: Path) -> None:
    """Wherever it stands, with its error, which may be blank; zeros before the first reading are not told."""
    rows = "0,-1,\n1,0,\n2,5,1\n3,0,\n4,4,2\n5,-1,\n6,3,3\n7,2,4\n8,0,\n9,nan,\n"
    (tmp_path / "a.csv").write_text(f"t,R,s\n{rows}")
    radius = Column("R", "um", "m", positive=True)
    read = read_series(tmp_path / "a.csv", TIME, radius, errors=[Column("s", "um", "m")])
    np.testing.assert_allclose(read.times, [2e-6, 4e-6, 6e-6, 7e-6])
    np.testing.assert_allclose(read.errors["s"], [1e-6, 2e-6, 3e-6, 4e-6])
    assert read.left_out[BELOW] == pytest.approx([0, 3e-6, 5e-6, 8e-6])
    savemat(tmp_path / "a.mat", {"t": np.arange(6.0), "R": [0.0, 3, -1, 2, 1, 0]})
    read = read_series(tmp_path / "a.mat", TIME, radius)
    assert (read.times.size, len(read.left_out[BELOW])) == (3, 2)
    (tmp_path / "a.csv").write_text("t,R\n0,-1\n1,-1\n2,0\n3,-1\n")
    with pytest.raises(DataError, match=r"'R' holds no usable value .*not above zero"):
        read_series(tmp_path / "a.csv", TIME, radius)


def test_outliers_are_left_out_with_what_stands_beside_them(tmp_path: Path) -> None:
    t = np.arange(40.0)
    R = 100 - 0.05 * (t - 18) ** 2 + 0.3 * np.random.default_rng(2).standard_normal(40)
    R[[9, 27]] += [12, -9]
    rows = np.column_stack([t, R, 0.1 + 0.01 * t])
    (tmp_path / "a.csv").write_text("t,R,s\n" + "".join(f"{a:g},{b:.6g},{c:g}\n" for a, b, c in rows), encoding="utf-8")
    std = Column("s", "um", "m")
    whole, read = (
        read_series(tmp_path / "a.csv", TIME, RADIUS, Layout(outliers=what), [std]) for what in ("keep", "leave out")
    )
    assert (len(whole.times), whole.left_out) == (40, {})
    assert read.left_out[FAR] == pytest.approx([9e-6, 27e-6])
    np.testing.assert_allclose(read.times, 1e-6 * np.delete(t, [9, 27]))
    np.testing.assert_allclose(read.errors["s"], 1e-6 * np.delete(rows[:, 2], [9, 27]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,r\n0,1\n1,2\n2,3\n", "no column 'R'; the columns are: t, r"),
        ("t,R,R\n0,1,1\n", "more than one column 'R'"),
        (
            "0,1\n1,2\n2,3\n",
            "no line above the numbers names the columns: put one such as 't_us,R_um' there, or call them c1, c2",
        ),
        ("t,R\n0,1\n1,abc\n2,3\n", "a.csv:3: 'abc' in column 'R' is not a number"),
        (
            "t;R\n0;1\n1;2,5\n2;3\n",
            "a.csv:3: '2,5' in column 'R' is not a number; write a decimal point, or data.decimal: ','",
        ),
        ("t,R\n0,1\n1,2,5\n2,3\n", "a.csv:3: 3 cells, but the header names 2 columns"),
        ("t,R\n0,nan\n1,\n2,NA\n", "'R' holds no usable value"),
        ("t,R\n", "no data"),
        ("", "the file holds no data"),
        ("# only this\n", "the file holds no data"),
        (
            "t,R\n0,1\n# x\n2,2\n1,3\n",
            "a.csv:5: times must increase, but 1 us follows 2 us; correct it, or sort the rows",
        ),
        ("t,R\n0,1\n0,2\n1,3\n", "a.csv:3: times must increase, but 0 us follows 0 us; keep one of the two"),
        (
            "t,R\n1,1\n2,2\n3,3\n1,1\n",
            "a.csv:5: times must increase, but 1 us follows 3 us; correct it, or sort the rows",
        ),
        ("Camera,X\n\nt,S\n0,1\n", "no column 'R'; the columns are: t, S\n"),
        ("t,R\n0,1\nus,um\n1,2\n", "a.csv:3: 'um' in column 'R' is not a number"),
        ("t,R\n0,1\n1,2\n", "2 usable observations; at least 3"),
        ("t,R\n0,1\n1,inf\n2,3\n", "a.csv:3: inf in column 'R'; correct it, or leave it blank"),
    ],
)
def test_bad_csv(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError) as error:
        csv(tmp_path, text)
    assert message in f"{error.value}\n"
    assert str(tmp_path / "a.csv") in str(error.value)


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_number_that_is_infinite_in_the_unit_of_the_model_is_told_as_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,R\n0,1\n1,1e305\n2,3\n")
    with pytest.raises(DataError, match=r"a\.csv:3: 1e\+305 in column 'R'"):
        read_series(tmp_path / "a.csv", TIME, Column("R", "m", "um"))


@pytest.mark.parametrize(
    "text", ["t;R\n0;1,5\n,5;2,5\n1;3\n", "t\tR\n0,0\t1,5\n0.5\t2,5\n1,0\t3\n", 't,R\n"0","1,5"\n"0,5","2,5"\n1,3\n']
)
def test_decimal_commas_are_read_where_it_is_said(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    series = read_series(path, TIME, RADIUS, Layout(decimal=","))
    assert series.times.tolist() == [0.0, 0.5e-6, 1e-6]
    assert series.values.tolist() == [1.5e-6, 2.5e-6, 3e-6]
    path.write_text("t;R\n0;1.00,5\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"a\.csv:2: '1\.00,5' in column 'R' is not a number$"):
        read_series(path, TIME, RADIUS, Layout(decimal=","))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("asked", ["Größe [\u00b5m]", "Größe [\u03bcm]", "Gro\u0308ße [\u00b5m]", " Größe [\u00b5m] "])
def test_text_of_windows_and_names_that_look_alike(tmp_path: Path, encoding: str, asked: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("t;Größe [\u00b5m]\r\n0;1\r\n1;2\r\n2;3\r\n".encode(encoding))
    assert read_series(path, TIME, Column(asked, "um", "m")).values.tolist() == [1e-6, 2e-6, 3e-6]


def test_file_not_there(tmp_path: Path) -> None:
    (tmp_path / "bubble.csv").write_text("t,R\n")
    with pytest.raises(DataError, match=r"buble\.csv: no such file; the folder holds bubble\.csv"):
        read_series(tmp_path / "buble.csv", TIME, RADIUS)
    with pytest.raises(DataError, match="is a directory"):
        read_series(tmp_path, TIME, RADIUS)
    (tmp_path / "a.ods").write_text("")
    with pytest.raises(DataError, match=r"suffix '\.ods'; save the sheet as CSV"):
        read_series(tmp_path / "a.ods", TIME, RADIUS)
    for binary in (b"\xff\xfe\x00\xd8", b"\x89PNG\r\n\x1a\n\x00\x00", b"t,R\n\x00\x01\n", b"t,R\n\x81\n"):
        (tmp_path / "b.csv").write_bytes(binary)
        with pytest.raises(DataError, match="not a text file"):
            read_series(tmp_path / "b.csv", TIME, RADIUS)


@pytest.mark.parametrize("shape", [(1, -1), (-1, 1)])
def test_mat_layouts(tmp_path: Path, shape: tuple[int, int]) -> None:
    radius = np.array([0.0, np.nan, 0.0, 5.0, np.nan, 6.0, 7.0]).reshape(shape)
    time = np.arange(7.0).reshape(shape)
    series = mat(tmp_path, R=radius, t=time, Req=np.uint8(21), nothing=np.nan, note="text", pair=[1.0, 2.0])
    assert series.times.tolist() == [3e-6, 5e-6, 6e-6]
    assert series.values.tolist() == [5e-6, 6e-6, 7e-6]
    assert series.scalars == {"Req": 21.0}


def test_scalars_in_the_comments_of_a_table(tmp_path):
    head = "# Req = 21.79\n# en4dvar track = x\n# a = b: 3\n# deltat=-1.5e-6 \n# e = .\nt,R\n# late = 3\n"
    head = f"# h: 750\n% delay = 7.0 us\n# rate:2.7e5 1/s\n# G = 3 Pa; mu = 2\n# n = 4 bubbles\n{head}"
    (tmp_path / "a.csv").write_text(head + "1,2\n2,3\n3,1\n")
    series = read_series(tmp_path / "a.csv", Column("t", "us", "s"), Column("R", "um", "m"))
    assert series.scalars == {
        "h": 750, "delay_us": 7, "rate_1/s": 2.7e5, "Req": 21.79, "deltat": -1.5e-6, "late": 3,
    }  # fmt: skip
    assert read_contents(tmp_path / "a.csv").scalars == series.scalars


def test_mat_time_step(tmp_path: Path) -> None:
    radius = np.array([np.nan, 5.0, 6.0, 7.0])
    step = TimeStep(Column("deltat", "us", "s"))
    assert mat(tmp_path, step, R=radius, deltat=0.5).times.tolist() == [0.5e-6, 1e-6, 1.5e-6]
    assert mat(tmp_path, TimeStep(value=2e-6), R=radius).times.tolist() == [2e-6, 4e-6, 6e-6]
    with pytest.raises(DataError, match="no scalar 'deltat' for the time step; did you mean 'delta_t'"):
        mat(tmp_path, step, R=radius, delta_t=0.5)
    with pytest.raises(DataError, match="time step 0 is not positive"):
        mat(tmp_path, step, R=radius, deltat=0.0)


def test_a_blank_line_is_no_frame_of_a_constant_step_in_silence(tmp_path: Path) -> None:
    """It was passed over, and the collapse behind two of them was two frames too early."""

    def read(text: str) -> list[float]:
        (tmp_path / "a.csv").write_text(text)
        return read_series(tmp_path / "a.csv", TimeStep(value=2.0), Column("R", "m", "m")).times.tolist()

    with pytest.raises(DataError, match=r"a\.csv:5: a line without a reading .* write NaN in it"):
        read("R\n\n5\n6\n\n7\n8\n\n")
    assert read("R\n5\n6\nNaN\n7\n8\n\n\n") == [0.0, 2.0, 6.0, 8.0]
    assert read("R\n\n5\n\n6\n\n7\n") == [0.0, 2.0, 4.0]  # every other line, as some programs write
    assert read("R,n\n5,1\n# Req = 3\n# block 2, of 9 rows\n6,1\n#\n7,1\n") == [0.0, 2.0, 4.0]
    for left_out in ("# 6,1", "#b,1", "#;6"):  # a row, by a comment
        with pytest.raises(DataError, match=r"a\.csv:3: a line without a reading"):
            read(f"R,n\n5,1\n{left_out}\n7,1\n8,1\n")
    with pytest.raises(DataError, match=r"a\.csv:7: .* write NaN in it"):
        read("R\n\n5\n\n6\n\n\n\n7\n")
    assert read("R\n\n5\n\n6\n\nNaN\n\n7\n") == [0.0, 2.0, 6.0]


def test_bad_mat(tmp_path: Path) -> None:
    told = r"field 'R' is not in the file; the vectors are: Rnew, t; no vectors: image \(an array of 3 x 3\)"
    with pytest.raises(DataError, match=told):
        mat(tmp_path, Rnew=np.ones(4), t=np.arange(4.0), image=np.ones((3, 3)))
    for value, words in (
        (np.ones((2, 2)), "an array of 2 x 2"),
        ({"note": "by hand"}, "a struct"),
        (np.array([np.ones(3), np.ones(2)], dtype=object), "a cell array"),
        ("radius", "text"),
        (1j * np.ones(3), "complex"),
    ):
        with pytest.raises(
            DataError, match=f"field 'R' is {words}, not a row or column of real numbers; .* are: (R.1., R.2., )?t"
        ):
            mat(tmp_path, R=value, t=np.arange(4.0))
    with pytest.raises(DataError, match="'R' is empty"):
        mat(tmp_path, R=np.ones((0, 0)), t=np.ones((0, 0)))
    with pytest.raises(DataError, match="5 times but 4 values of 'R'"):
        mat(tmp_path, R=np.ones(4), t=np.arange(5.0))
    with pytest.raises(DataError, match="no usable value"):
        mat(tmp_path, R=np.full(4, np.nan), t=np.arange(4.0))
    (tmp_path / "text.mat").write_text("t,R\n0,1\n")
    with pytest.raises(DataError, match="not a MATLAB v5 file"):
        read_series(tmp_path / "text.mat", TIME, RADIUS)
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "hdf.mat").write_bytes(header + b"\x00" * 400 + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(DataError, match="cannot be read as a MATLAB file"):
        read_series(tmp_path / "hdf.mat", TIME, RADIUS)
    whole = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "cut.mat").write_bytes(whole[: len(whole) - 60])
    with pytest.raises(DataError, match="cannot be read as a MATLAB file"):
        read_series(tmp_path / "cut.mat", TIME, RADIUS)


def test_a_damaged_compressed_variable_is_told(tmp_path: Path) -> None:
    """Found by fuzzing: scipy's reader ends the process (SIGSEGV) at some of these."""
    path = tmp_path / "a.mat"
    savemat(path, {"t": np.arange(50.0), "R": 1 + np.arange(50.0) ** 2}, do_compression=True)
    good = path.read_bytes()
    assert len(read_series(path, TIME, RADIUS).times) == 50
    told = 0
    for at in range(144, len(good), 7):
        flipped = good[:at] + bytes([good[at] ^ 0x55]) + good[at + 1 :]
        for bad in (good[:at] + b"b" * 48 + good[at:], flipped, good[:at], b"MATRIX" + good[6:]):
            path.write_bytes(bad)
            with contextlib.suppress(DataError):
                read_series(path, TIME, RADIUS)
                continue
            told += 1
    assert told > 0.9 * 4 * len(range(144, len(good), 7))
