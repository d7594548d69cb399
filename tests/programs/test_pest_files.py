"""PEST's templates and instructions, by the examples of its manual's rules."""

from __future__ import annotations

import pytest

from en4dvar.programs import pest
from en4dvar.programs.errors import ProgramError
from en4dvar.programs.model import CommandModel, CommandSettings

TEMPLATE = "ptf ~\nmodel input\n~   K1        ~ ~  s~\nlast ~k1~\n"


def test_each_space_holds_its_parameter_in_its_width():
    assert pest.parameters_of(TEMPLATE) == {"k1", "s"}
    lines = pest.filled(TEMPLATE, {"K1": 2 / 3, "s": 0.25}).splitlines()
    assert lines[0] == "model input"
    assert lines[1] == "0.66666666666667  0.25"[-22:] or len(lines[1]) == len("~   K1        ~ ~  s~")
    assert float(lines[1].split()[0]) == pytest.approx(2 / 3, rel=1e-12)
    assert lines[2] == "last 0.67" or float(lines[2].split()[1]) == pytest.approx(2 / 3, rel=0.01)


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [(0.1, 12, "0.1"), (1e-7, 5, "1e-07"), (1e-7, 4, "1e-7"), (-123456.789, 7, "-123457"), (1 / 3, 3, "0.3")],
)
def test_a_number_keeps_as_many_digits_as_fit(value, width, text):
    assert pest.fitted(value, width) == text


def test_a_number_that_does_not_fit_is_told():
    with pytest.raises(ProgramError, match="-1e-200 does not fit into 4 characters"):
        pest.fitted(-1e-200, 4)


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
        ("pif @\n@SCHLUMBERGER@\nl2 !dum! !ar1!\n&\nl1 t8 !ar2!\n", {"ar1": 1.21072, "ar2": 1.51313}),
    ],
)
def test_instructions_read_what_they_say(instructions, expected):
    assert pest.read(instructions, OUTPUT, "out") == expected
    assert pest.observations_of(instructions) == list(expected)


@pytest.mark.parametrize(
    ("instructions", "words"),
    [
        ("pif @\nl30 !a!\n", "out: has 7 lines, but line 30 is to be read"),
        ("pif @\n@depth@ !a!\n", "out: no 'depth' below line 0"),
        ("pif @\nl1 !a!\n", "out:1: 'SCHLUMBERGER' is not a number for a"),
        ("pif @\nl1 @depth@ !a!\n", "out:1: no 'depth' behind column 0"),
        ("pif @\nl3 [a]60:70\n", "out:3: 'nothing' is not a number for a"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_line(instructions, words):
    with pytest.raises(ProgramError) as caught:
        pest.read(instructions, OUTPUT, "out")
    assert str(caught.value) == words


def test_a_program_with_files_of_pest(tmp_path):
    (tmp_path / "in.dat.tpl").write_text("ptf ~\n~      a           ~\n~      B           ~\n")
    (tmp_path / "out.ins").write_text("pif @\nl1 !h1!\nl1 !h2!\n")
    given = {
        "command": "cp {input} {output}",
        "templates": "in.dat.tpl",
        "parameters": {"a": "1", "b": "m"},
        "outputs": {"h": {"instructions": "out.ins"}},
    }
    model = CommandModel(CommandSettings.model_validate(given, context={"base": tmp_path}))
    (path,) = model.trajectories([[0.125, -3.0]], [1.0, 2.0])
    assert path["h"].tolist() == [0.125, -3.0]
