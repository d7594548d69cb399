"""Whether the comma of ``1,201``, or the point of ``1.201``, is that of decimals or separates thousands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from openpyxl import Workbook

from en4dvar.inputs.parts import Column, Contents, Layout, read_contents
from en4dvar.inputs.readers import read_series
from en4dvar.plumbing.errors import DataError

MIRROR = str.maketrans(".,", ",.")


def contents(folder: Path, text: str, decimal: Any = ".") -> Contents:
    (folder / "a.csv").write_text(text, encoding="utf-8")
    return read_contents(folder / "a.csv", Layout(decimal=decimal))


@pytest.mark.parametrize("german", [False, True])
@pytest.mark.parametrize(
    ("R", "numbers"),
    [
        (["998.2", "1,201", "1,001.5"], [998.2, 1201, 1001.5]),
        (["998.2", "1,201", "850"], [998.2, 1201, 850]),
        (["1.5", "1,201", "-"], [1.5, 1201, np.nan]),
        (["1.25e3", "1,201", "-1,300"], [1250, 1201, -1300]),
        (["1,003,200", "1,201", "3"], [1003200, 1201, 3]),
        (["998", "999", "1,000"], [998, 999, 1000]),
        (["1,201", "998", "1,350"], [1201, 998, 1350]),  # by the time beside it
        (["0,5", "1,201", "3"], [0.5, 1.201, 3]),  # whatever the time beside it says
    ],
)
def test_the_column_tells_or_else_the_table(tmp_path, R, numbers, german):
    text = "t;R\n" + "".join(f"{t};{r}\n" for t, r in zip(["0.5", "998.5", "1,000"], R, strict=True))
    text = text.translate(MIRROR) if german else text
    commas, points = (contents(tmp_path, text, sign).columns for sign in ",.")
    assert commas["R"].tolist() == pytest.approx(numbers, nan_ok=True)
    assert commas["t"].tolist() == [0.5, 998.5, 1000]
    for name in points:
        np.testing.assert_array_equal(points[name], commas[name])


@pytest.mark.parametrize("sign", ["'", "’", " ", "\u00a0", "\u2009", "\u202f"])
def test_apostrophes_and_blanks_separate_thousands_only(tmp_path, sign):
    text = f"t;R\n0;126{sign}000.5\n2{sign}000;1{sign}162{sign}000\n4{sign}000;-1{sign}500.125\n"
    for written, decimal in ((text, "."), (text.replace(".", ","), ","), (text.replace("-", "\u2212"), ".")):
        columns = contents(tmp_path, written, decimal).columns
        assert columns["t"].tolist() == [0, 2000, 4000]
        assert columns["R"].tolist() == [126000.5, 1162000, -1500.125]
    for wrong in (f"1{sign}00", f"0{sign}500", f"1{sign}2345", f"1'000{sign * 2}000"):
        assert "is not a number" in contents(tmp_path, f"t;R\n0;{wrong}\n1;5\n").others["R"]
    if sign != " ":
        between_blanks = contents(tmp_path, f"t R\n0 126{sign}000\n2{sign}000 162{sign}000\n")
        assert between_blanks.columns["R"].tolist() == [126000, 162000]


def test_quoted_numbers_between_commas(tmp_path):
    text = 't,R\n1.6,"1,201"\n3.2,"998.4"\n4.8,"1,100"\n'
    assert contents(tmp_path, text).columns["R"].tolist() == [1201, 998.4, 1100]
    (tmp_path / "a.csv").write_text(text.replace('"', ""))
    with pytest.raises(DataError, match=r"a\.csv:2: 3 cells, but the header names 2 columns; a comma or a blank"):
        read_series(tmp_path / "a.csv", Column("t", "us", "us"), Column("R", "um", "um"))


def test_numbers_alone_tell_it_only_where_several_have_no_sign(tmp_path):
    held = contents(tmp_path, "t;R\n1;102,345\n2;999\n3;98,123\n4;999\n5;-1\n6;0\n", ",")
    assert held.columns["R"].tolist() == [102.345, 999, 98.123, 999, -1, 0]
    assert held.unsure == {"R": "102,345"}
    fault = contents(tmp_path, "t;R\n1;102,345\n2;98,123\n").others["R"]
    assert fault.endswith("or data.decimal: ','; if the comma separates thousands, delete it")
    points = contents(tmp_path, "t,R\n1.600,102.345\n3.200,98.123\n")  # as most programs write numbers
    assert points.columns["R"].tolist() == [102.345, 98.123]
    assert not points.unsure


def test_both_signs_before_decimals(tmp_path):
    fault = contents(tmp_path, "t;R\n1;1.5\n2;1,5\n3;1,201\n", ",").others["R"]
    assert "a.csv:4: '1,201' in column 'R': decimals or thousands?" in fault
    mixed = "".join(f"{t};{t + 160}.123\n{t};{t + 160},3\n" for t in range(9))  # thousands would go up and down
    assert "a.csv:2: '160.123' in column 'R': decimals or thousands?" in contents(tmp_path, f"t;R\n{mixed}").others["R"]
    assert contents(tmp_path, "t;R\n1;1.5\n2;1,5\n3;1201\n", ",").columns["R"].tolist() == [1.5, 1.5, 1201]


def test_a_workbook_has_no_thousands_in_its_numbers(tmp_path):
    made = Workbook()
    for row in (["t", "R", "note"], [0.5, 1.201, "1.600,5"], [1.5, 102.345, "1.600"], [2.5, 998, "0,5"]):
        made.active.append(row)
    made.save(tmp_path / "a.xlsx")
    columns = read_contents(tmp_path / "a.xlsx", Layout(decimal=",")).columns
    assert columns["R"].tolist() == [1.201, 102.345, 998]
    assert columns["note"].tolist() == [1600.5, 1600, 0.5]


@pytest.mark.parametrize("german", [False, True])
def test_data_sets_of_one_table_have_one_decimal_sign(tmp_path, german):
    """The numbers of the first tell it of the second, which alone might be 1.201 and 1.3."""
    text = "t;gel;R\n0;a;998.2\n1;a;1,001.5\n2;a;1,003\n0;b;1,201\n1;b;1,300\n2;b;1,405\n"
    (tmp_path / "a.csv").write_text(text.translate(MIRROR) if german else text, encoding="utf-8")
    layout, columns = Layout(by="gel", decimal=","), (Column("t", "s", "s"), Column("R", "um", "um"))
    each = [read_series(tmp_path / "a.csv", *columns, layout, part=part).values.tolist() for part in "ab"]
    assert each == [[998.2, 1001.5, 1003], [1201, 1300, 1405]]


def test_exponents_of_fortran(tmp_path):
    columns = contents(tmp_path, "t R\n1.0D-06 2.5D+01\n2.0d-6 .3D2\n3.0E-06 1.0D0\n", ".").columns
    assert columns["t"].tolist() == [1e-6, 2e-6, 3e-6]
    assert columns["R"].tolist() == [25, 30, 1]
