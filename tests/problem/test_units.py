"""Units: exact factors, the grammar, and messages that say what to write."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import BaseModel, Field, ValidationError

from en4dvar.plumbing.units import Quantity, UnitError, as_unit, convert, parse_quantity, parse_unit


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.42 kPa", "Pa", 420.0),
        ("2.5 us", "s", 2.5e-6),
        ("2.5 µs", "s", 2.5e-6),
        ("2.5 μs", "s", 2.5e-6),
        ("1.4um", "m", 1.4e-6),
        ("1e-6 m", "m", 1e-6),
        ("-.5 K", "K", -0.5),
        ("0.1 Pa s", "Pa s", 0.1),
        ("1 cP", "Pa s", 1e-3),
        ("100 mPa·s", "Pa s", 0.1),
        ("1 g/cm^3", "kg/m^3", 1000.0),
        ("56 mN/m", "N/m", 0.056),
        ("0.6 W/(m K)", "W/(m K)", 0.6),
        ("0.6 W m⁻¹ K⁻¹", "W/(m K)", 0.6),
        ("1.587 1/us", "Hz", 1.587e6),
        ("5.28e-5 W/(m K^2)", "kg m/(s^3 K**2)", 5.28e-5),
        ("1 %", "1", 0.01),
        ("0.03", "1", 0.03),
        (3, "1", 3.0),
        ("1 d", "h", 24.0),
        ("2 week", "day", 14.0),
        ("0.1 1/yr", "1/d", 0.1 / 365.25),
        ("1 year", "d", 365.25),
        ("1 atm", "bar", 1.01325),
        ("1 psi", "Pa", 0.45359237 * 9.80665 / 0.0254**2),
        ("5 Pa s^0.6", "kg/(m s^1.4)", 5.0),
        ("5 kPa s**0.6", "Pa s^+0.6", 5000.0),
        ("4 kPa^0.5", "Pa^0.5", 4 * 10**1.5),
        ("2 ms^-0.5 ms^-0.5", "kHz", 2.0),
        ("2.7e5/s", "Hz", 2.7e5),
        ("270 / ms", "kHz", 270.0),
        ("4 um/px", "m", 4e-6),
        ("4um / pixel", "um", 4.0),
    ],
)
def test_quantity(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit) == value


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        ("1e-6", "m", "1e-6 has no unit; write e.g. '1e-6 m'"),
        (1.4, "m", "1.4 has no unit"),
        ("1 kpa", "Pa", "unknown unit 'kpa'; did you mean 'kPa'"),
        ("1 KPA", "Pa", "did you mean 'kPa'"),
        ("3 US", "s", "did you mean 'us'"),
        ("3 Um", "m", "did you mean 'um'"),
        ("1 mpa", "Pa", r"did you mean 'MPa' or 'mPa'\?"),
        ("1 mhz", "Hz", r"did you mean 'MHz' or 'mHz'\?"),
        ("3 uM", "s", "unknown unit 'uM'; it has to be one such as 's'"),
        ("3 pas", "Pa s", "unknown unit 'pas'; it has to be one such as 'Pa s'"),
        ("3 C", "m", "unknown unit 'C'; it has to be one such as 'm'"),
        ("2 sec", "s", "did you mean 's'"),
        ("2/mim", "1/s", r"unknown unit 'mim'; did you mean 'min'\?"),
        ("2 kg/(mm ss)", "kg/(m s^2)", "unknown unit 'ss'; it has to be one such as"),
        ("2 days", "d", "did you mean 'day'"),
        ("2 hours", "h", "did you mean 'h'"),
        ("2 months", "d", "did you mean 'd'"),
        ("20 degC", "K", "did you mean 'K'"),
        ("1 um", "Pa", "'um' cannot be converted to 'Pa'"),
        ("1 %", "Pa", "'%' cannot be converted to 'Pa'"),
        ("kPa", "Pa", "not a quantity"),
        ("4 kPa/px", "Pa", "unknown unit 'px'"),
        ("5/%", "1", "a unit"),
        ("3/1", "1", "unit"),
        ("nan Pa", "Pa", "not a quantity"),
        ("1.2.3 Pa", "Pa", "not a quantity"),
        (True, "1", "not a quantity"),
        (None, "1", "not a quantity"),
        ("1 W/m K", "W/(m K)", "ambiguous"),
        ("1 W/(m K", "W/(m K)", "unbalanced"),
        ("1 W/", "W", "a unit is missing"),
        ("1 $", "W", "cannot read unit"),
        ("1 Pa s^0.6", "Pa s^0.61", "cannot be converted to 'Pa s"),
        ("1 Pa s0.6", "Pa s^0.6", "cannot read unit"),
        ("1 Pa s^12.5", "Pa s", "no unit has the power 12.5"),
        ("1 Pa s^0.12345678", "Pa s", "no unit has the power 0.12345678"),
    ],
)
def test_refused(text: str, unit: str, message: str) -> None:
    with pytest.raises(UnitError, match="^.*" + message.replace("(", r"\(").replace("$", r"\$")):
        parse_quantity(text, unit)


def test_no_unit_is_asked_for_where_none_is_wanted() -> None:
    with pytest.raises(UnitError, match=r"'two' is not a quantity; write a number$"):
        parse_quantity("two", "1")


def test_convert_arrays_round_once() -> None:
    values = np.array([1.4, 194.55, 517.0])
    assert convert(values, "um", "m").tolist() == [1.4e-6, 194.55e-6, 517e-6]
    assert convert(1.5, "kPa", "Pa") == 1500.0
    assert parse_unit("m/s^2") == parse_unit("N/kg")


def test_pydantic_annotation() -> None:
    class Settings(BaseModel):
        pressure: Annotated[float, Quantity("Pa"), Field(gt=0)]

    assert Settings.model_validate({"pressure": "0.42 kPa"}).pressure == 420.0
    for bad, message in (("0.42", "has no unit"), ("-1 Pa", "greater than 0")):
        with pytest.raises(ValidationError, match=message):
            Settings.model_validate({"pressure": bad})


@pytest.mark.parametrize("text", ["mm44444444444444/m/m", "m99", "m-13", "(" * 50_000, "m " * 51, "kPa^" + "9" * 5000])
def test_units_that_would_take_for_ever_are_refused(text: str) -> None:
    """The first was found by fuzzing: the parser was raising 1/1000 to the power."""
    with pytest.raises(UnitError, match="cannot read unit"):
        parse_unit(text)


def test_a_multiple_is_a_unit() -> None:
    assert convert(2.0, "2.76*um", "m") == 5.52e-6
    assert convert(2.0, "1e-6 * m", "um") == 2.0
    assert convert(3.0, "1/(270*kHz)", "s") == pytest.approx(3 / 270e3, rel=1e-15)
    assert as_unit("+500 kfps", "Hz") == "500*kfps"
    assert as_unit("2.7e5/s", "Hz") == "2.7e5*(1/s)"
    assert as_unit("4 um/px", "m") == "4*um"
    with pytest.raises(UnitError, match=r"a multiple of a unit has a star: '250\*um'"):
        parse_unit("250 um")
    assert convert(1.0, f"1/({as_unit('5e5 1/s', 'Hz')})", "us") == 2.0
    huge = "9e29*(" * 9 + "m" + ")" * 9
    for wrong in ("0*um", "2.76um", "2.76 um", "-1*um", "1e99*um", "2*3*um*", "m 2*s", "m/2*s", huge):
        with pytest.raises(UnitError):
            convert(1.0, wrong, "m")
