"""PEST's templates and instructions, by the examples of its manual's rules."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from en4dvar.model.programs import languages
from en4dvar.model.programs.languages import ProgramError
from en4dvar.model.programs.model import CommandModel, CommandSettings

PUBLIC = Path(__file__).parents[2].parent / "shared" / "reference" / "pest" / "pestpp" / "benchmarks"
TEMPLATE = "ptf ~\nmodel input\n~   K1        ~ ~  s~\nlast ~k1~\n"


def test_each_space_holds_its_parameter_in_its_width():
    assert languages.parameters_of(TEMPLATE) == {"k1", "s"}
    lines = languages.spaces_filled(TEMPLATE, {"K1": 2 / 3, "s": 0.25}).splitlines()
    assert lines[0] == "model input"
    assert lines[1] == "0.66666666666667  0.25"[-22:] or len(lines[1]) == len("~   K1        ~ ~  s~")
    assert float(lines[1].split()[0]) == pytest.approx(2 / 3, rel=1e-12)
    assert lines[2] == "last 0.67" or float(lines[2].split()[1]) == pytest.approx(2 / 3, rel=0.01)


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (0.1, 12, "0.1"),
        (np.float64(0.1), 20, "0.1"),
        (1e-7, 12, "1.0e-07"),
        (1e-7, 5, "1.e-7"),
        (1e-7, 4, "1e-7"),
        (-123456.789, 8, "-123457."),
        (-123456.789, 7, "-1.23e5"),
        (1e120, 8, "1.0e+120"),
        (123, 3, "123"),
        (math.inf, 5, "inf"),
        (1 / 3, 3, "0.3"),
        (0.00011723961, 6, "1.2e-4"),
        (-0.000735887, 8, "-7.36e-4"),
        (-0.0005, 6, "-5.e-4"),
    ],
)
def test_a_number_keeps_as_many_digits_as_fit(value, width, text):
    assert languages.fitted(value, width) == text


def test_a_number_that_does_not_fit_is_told():
    with pytest.raises(ProgramError, match="-1e-200 does not fit into 4 characters"):
        languages.fitted(-1e-200, 4)


OUTPUT = """SCHLUMBERGER ELECTRIC SOUNDING
spacing   apparent resistivity
  1.00       1.21072
  1.47       1.51313
  2.15       2.07536  9.5

heads: h1 = 3.25  h2 = 4.5d0
"""


@pytest.mark.parametrize(
    ("instructions", "expected"),
    [
        ("pif @\nl3 [ar1]11:20\nl1 [ar2]11:20\n", {"ar1": 1.21072, "ar2": 1.51313}),
        ("pif @\n@spacing@\nl1 w w !ar1!\nl2 (ar3)10:14 !x!\n", {"ar1": 1.21072, "ar3": 2.07536, "x": 9.5}),
        ("pif #\n#heads:# #h1 =# !h1! #h2 =# !h2!\n", {"h1": 3.25, "h2": 4.5}),
        ("pif @\n@SCHLUMBERGER@\nl2 !dum!\n& !ar1!\nl1 t8 !ar2!\n", {"ar1": 1.21072, "ar2": 1.51313}),
        ("pif @\n@heads@ (h1)14:15 !DUM! @=@ !h2!\n", {"h1": 3.25, "h2": 4.5}),
    ],
)
def test_instructions_read_what_they_say(instructions, expected):
    assert languages.read(instructions, OUTPUT, "out") == expected
    assert languages.observations_of(instructions) == list(expected)


@pytest.mark.parametrize(
    ("instructions", "output", "expected"),
    [
        ("pif @\nl1 (a)13:16\n", "   head:   123.456\n", 123.456),  # the whole of what lies in the columns
        ("pif @\nl1 (a)1:5\n", "1.5,2.5\n", 1.5),
        ("pif @\nl1 (a)5:7\n", "1.5,2.5\n", 2.5),
        ("pif @\nl1 @=@ !a! @%@\n", "WATER CONTENT (NO CORRECTION)=21.345634%\n", 21.345634),
        ("pif %\n%TIME STEP 10% %STRAIN%\nl1 %STRAIN =% !a!\n",
         "TIME STEP 10 (13 ITERATIONS REQUIRED) STRESS --->\nX = 1.05 STRESS = 4.3E+03\n"
         "TIME STEP 10 (BACK SUBSTITUTION) STRAIN --->\nX = 1.05 STRAIN = 2.56785E-03\n", 2.56785e-3),
        ("pif @\n@b@ @c@ @d@ !a!\n", "b c 1\nb d 2\nb c d 3\n", 3.0),
        ("pif @\nl1 @,@ @,@ !a!\n", "1,2,-1.5-101,4\n", -1.5e-101),  # Fortran leaves out the E of three digits
        ("pif @\nl1 !dum! !a!\n", "x|2.5D+1|y\n", 25.0),
    ],
)  # fmt: skip
def test_instructions_as_the_manual_of_pestpp_has_them(instructions, output, expected):
    assert languages.read(instructions, output, "out", delimiters="|") == {"a": expected}


@pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no {PUBLIC}")
def test_instructions_of_pestpps_benchmarks():
    """An output in the layout of ``tplins_test_1``, with the values that stand in its archive, ``out1.dat.obf``."""
    expected = {"h02_09": 7.92106, "h01_10": 1.234567, "h01_09": 9.876543, "h01_01": 1.0, "h01_02": 1.2, "h01_03": 1.4}
    expected |= {"h01_04": 1.6, "h01_05": 1.8, "h01_06": 2.0, "h01_07": 2.2, "h01_08": 2.4, "h02_01": 1236.567}
    expected |= {"h02_02": 8495.123, "h02_03": -900.999, "h02_04": 2.2, "h02_05": 2.6, "h02_06": 3.0, "h02_07": 3.4}
    expected |= {"h02_08": 3.8, "h02_10": 4.123, "dummy_obs": 5.5}
    lines = [
        ",".join("abcdefgh") + ",7.92106,9", "primary", "", " primary  1.234567 a   secondary  ".ljust(44) + "9.876543",
        "", "", "", " 1.0 and nan of secondary 1.2 1.4 1.6 1.8 2.0 2.2".ljust(106) + "2.400 # 9.9",
        "1236.5678495.123-900.999 2.2 2.6 3.0 3.4 3.8 4.0", "4.123x", "dummy_obs 5.5",
    ]  # fmt: skip
    instructions = (PUBLIC / "tplins_test_1" / "template" / "out1.dat.ins").read_text()
    assert languages.read(instructions, "\n".join(lines) + "\n", "out1.dat") == expected


@pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no {PUBLIC}")
@pytest.mark.parametrize(("name", "between"), [("out1.dat.ins", ", "), ("out2.dat.ins", ","), ("out3.dat.ins", "|")])
def test_secondary_markers_of_pestpps_benchmarks(name, between):
    """Lines that hold the first of the markers alone, or some of them, are passed over."""
    rows = [["1.0", "2.0", "3.0", "4.0"], ["32.0", "5.0", "6.0", "7.0"]]
    head = "time, of\n\ntime,SEEPAGE_FLUX1, of\n\ntime,SEEPAGE_FLUX1,SEEPAGE_FLUX2, of\n\n" if name[3] == "1" else ""
    text = head + "time,SEEPAGE_FLUX1,SEEPAGE_FLUX2,SEEPAGE_FLUX3\n" + "\n".join(between.join(row) for row in rows)
    instructions = (PUBLIC / "secondary_marker_test" / "template" / name).read_text()
    found = languages.read(instructions, text, name, delimiters="|")
    first = 0 if name[3] == "3" else 1  # the instructions of the third begin with the time
    assert found == {f"obs{i + 1}_{j + 1}": float(rows[j][first + i]) for i in range(3) for j in range(2)}


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("l1 X !a!", "x.ins:2: 'X' is no instruction of PEST"),
        ("l1 dum !a!", "x.ins:2: 'dum' is no instruction of PEST"),
        ("l1\n\nl-1 !a!", "x.ins:4: a line of instructions begins with a marker or l1, l2, …; not with 'l-1'"),
        ("!a!", "x.ins:2: a line of instructions begins with a marker or l1, l2, …; not with '!a!'"),
        ("l1 [a]9:4", "x.ins:2: the columns of [a]9:4 do not increase"),
        ("l1 [a]0:4", "x.ins:2: '[a]0:4' is no instruction of PEST"),
        ("l1 @depth !a!", "x.ins:2: '@depth !a!' is no instruction of PEST"),
        ("l1 !a! w !A!", "x.ins:2: a is read twice"),
    ],
)
def test_what_is_no_instruction_is_told_with_its_line(lines, words):
    with pytest.raises(ProgramError) as caught:
        languages.parsed(f"pif @\n{lines}\n", "x.ins")
    assert str(caught.value) == words


@pytest.mark.parametrize("first", ["ptf", "ptf ", "ptf ~~", "ptf a"])
def test_a_template_without_a_delimiter_is_told(first):
    with pytest.raises(ProgramError, match="the first line names"):
        languages.parameters_of(f"{first}\n~ a ~\n")
    with pytest.raises(ProgramError, match="line 3: one ~ without another"):
        languages.parameters_of("ptf ~\n~ a ~\n~ b\n")


@pytest.mark.parametrize(
    ("instructions", "words"),
    [
        ("pif @\nl30 !a!\n", "out: has 7 lines, but line 30 is to be read"),
        ("pif @\n@depth@ !a!\n", "out: no 'depth' below line 0"),
        ("pif @\nl1 !a!\n", "out:1: 'SCHLUMBERGER' is not a number for a"),
        ("pif @\nl1 @depth@ !a!\n", "out:1: no 'depth' behind column 0"),
        ("pif @\nl3 [a]60:70\n", "out:3: 'nothing' is not a number for a"),
        ("pif @\nl3 (a)1:2\n", "out:3: 'nothing' is not a number for a"),
        ("pif @\n@heads@ @depth@ !a!\n", "out: no 'heads' below line 7"),
        ("pif @\n@heads@ !dum! @depth@ !a!\n", "out:7: no 'depth' behind column 6"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_line(instructions, words):
    with pytest.raises(ProgramError) as caught:
        languages.read(instructions, OUTPUT, "out")
    assert str(caught.value) == words


def test_what_is_no_number_is_lost_alone():
    found = languages.read("pif @\nl1 !a! !b!\nl1 !c! [d]8:10\n", "1.5 ****\nNaN 2.5\n", "out")
    np.testing.assert_array_equal([found[name] for name in "abcd"], [1.5, math.nan, math.nan, math.nan])


def test_a_program_with_files_of_pest(tmp_path):
    (tmp_path / "in.dat.tpl").write_text("ptf ~\n~      a           ~\n~      B           ~\n")
    (tmp_path / "out.ins").write_text("pif @\nl1 !h1!\nl1 !h2!\n")
    given = {
        "command": "cp {input} {output}",
        "templates": "in.dat.tpl",
        "parameters": {"A": "1", "b": "m"},
        "outputs": {"h": {"instructions": "out.ins"}},
    }
    model = CommandModel(CommandSettings.model_validate(given, context={"base": tmp_path}))
    (path,) = model.trajectories([[0.125, -3.0]], [1.0, 2.0])
    assert path["h"].tolist() == [0.125, -3.0]


def test_several_instruction_files_scale_offset_and_combinations(tmp_path):
    (tmp_path / "in.dat.tpl").write_text("ptf ~\n~      hk:i-0         ~\n~      b           ~\n")
    (tmp_path / "one.ins").write_text("pif @\nl1 !h1!\n")
    (tmp_path / "two.ins").write_text("pif @\nl2 !h2!\n")
    given = {
        "command": "mkdir out; cp in.dat out/a; cp in.dat out/b",
        "shell": True,
        "templates": "in.dat.tpl",
        "parameters": {"hk_i_0": {"scale": -2, "offset": 10}, "b": "m"},
        "outputs": {
            "h": {
                "instructions": {"out/a": "one.ins", "out/b": "two.ins"},
                "observations": ["h2", "h1"],
                "combinations": [{"hk_i_0": 2, "b": 1}, {"log10(b)": -1}],
            }
        },
    }
    model = CommandModel(CommandSettings.model_validate(given, context={"base": tmp_path}))
    good, bad = model.trajectories([[4.0, 100.0], [4.0, -1.0]], [1.0, 2.0, 3.0, 4.0])
    assert good["h"].tolist() == [100.0, 2.0, 108.0, -2.0]
    assert "log10(b): -1 has no logarithm" in bad.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"instructions": {"a": "one.ins", "b": "one.ins"}}, "two of the instructions read 'h1'"),
        ({"observations": ["h7"]}, "the instructions read no 'h7'"),
        ({"combinations": [{"log10(c)": 1}]}, "combinations: 'log10(c)' is no parameter"),
        ({"combinations": [{}]}, "combinations"),
    ],
)
def test_outputs_that_do_not_fit_the_instructions(tmp_path, change, words):
    (tmp_path / "one.ins").write_text("pif @\nl1 !h1!\n")
    output = {"instructions": "one.ins"} | change
    given = {"command": "ls", "parameters": {"a": "1"}, "outputs": {"h": output}}
    with pytest.raises(ValueError, match=re.escape(words)):
        CommandSettings.model_validate(given, context={"base": tmp_path})
