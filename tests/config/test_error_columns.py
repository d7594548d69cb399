"""Errors of readings from columns of the data file."""

from __future__ import annotations

import numpy as np
import pytest

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.config.quantities import Spread, parse_error_std
from en4dvar.plumbing.errors import ConfigError, DataError

ROWS = [(0, 100, 2, 0.1), (5, 80, 1, 0.2), (10, "", "", ""), (15, 60, 4, 0.3), (20, 50, 3, 0.1)]
CONFIG = """
name: columns
seed: 1
data:
  path: d.csv
  columns: {{time: {{name: t, unit: us}}, radius: {{name: R, unit: um}}}}
  window: {{from: 5 us}}
  error: {error}
model: {{name: bubble, law: neo-hookean-kelvin-voigt, start: laser}}
parameters:
  G: {{prior: lognormal, median: 2 kPa, log_std: 0.5}}
  mu: 0.1 Pa s
  R_eq: 20 um
  R_max: 100 um
"""


def problem(folder, error, rows=ROWS):
    (folder / "d.csv").write_text("t,R,s,j\n" + "\n".join(",".join(map(str, row)) for row in rows))
    (folder / "c.yaml").write_text(CONFIG.format(error=error))
    return build(load_config(folder / "c.yaml"))[0]


def test_each_reading_has_its_own_error_in_the_unit_of_its_column(tmp_path):
    noise = problem(tmp_path, "{radius_std: {column: s}, time_std: {column: j, unit: ns}}").observations.noise
    np.testing.assert_allclose(noise.std, [1e-6, 4e-6, 3e-6])
    np.testing.assert_allclose(noise.time_std, [2e-10, 3e-10, 1e-10])


@pytest.mark.parametrize(
    ("error", "unit"), [("1.4 mm", "mm"), ("1 % of maximum", ""), ("{column: s, unit: nm}", "nm"), ("{column: s}", "")]
)
def test_the_unit_of_the_error_as_it_is_stated_is_that_of_the_advice(tmp_path, error, unit):
    assert problem(tmp_path, f"{{radius_std: {error}}}").observations.error_unit == unit


@pytest.mark.parametrize("std", ["5 % of minimum", "13 um of maximum", "5 % of first", "of maximum"])
def test_an_error_that_is_no_share_says_how_one_is_written(std):
    with pytest.raises(ValueError, match=f"'{std}' is no share; write a number in % of maximum, as '5 % of maximum'"):
        parse_error_std(std, "um")


@pytest.mark.parametrize("std", ["5 %", " 5%", "x %"])
@pytest.mark.parametrize(("unit", "own"), [("1", "a plain number"), ("um", "a quantity in um")])
def test_a_share_says_of_what(std, unit, own):
    with pytest.raises(ValueError, match=f"does not say of what; write '{std.strip()} of maximum' or {own}"):
        parse_error_std(std, unit)
    assert parse_error_std("5 % of maximum", unit) == Spread(0.05, relative=True)
    assert parse_error_std("5 %", "%").value == 5  # in the observable's own unit


@pytest.mark.parametrize(
    ("error", "where"),
    [
        ("5 %", "error.y_std"),
        ({"y_std": "5 %"}, "error.y_std"),
        ({"y_std": 0.1, "model_std": "5 %"}, "error.model_std"),
        ({"y_std": 0.1, "time_std": "5 %"}, "error.time_std"),
        ({"y_std": 0.1, "shared": ["5 %"]}, "error.shared"),
        ({"y_std": 0.1, "discrepancy": {"amplitude": {"median": "5 %"}}}, "error.discrepancy.amplitude.median"),
    ],
)
def test_of_an_observable_without_unit_too(error, where):
    """``5 %`` is the number 0.05, but as an error it is hardly meant so: beside readings of 50 it is a tenth of a %."""
    priors = {"k": {"prior": "lognormal", "median": "20 %", "log_std": "50 %"}}
    with pytest.raises(ConfigError, match=f"{where}: '5 %' is a share, but does not say of what"):
        en4dvar.estimate(lambda p, t: 50 * np.exp(-p["k"] * t), ([1, 2, 3], [40.0, 32, 26]), priors, error=error)


def test_what_the_model_misses_is_added_in_squares(tmp_path):
    noise = problem(tmp_path, "{radius_std: {column: s}, model_std: 5 % of maximum}").observations.noise
    np.testing.assert_allclose(noise.std, np.hypot([1e-6, 4e-6, 3e-6], 0.05 * 80e-6))
    for wrong in ("{radius_std: 1 um, model_std: {column: s}}", "{radius_std: 1 um, model_std: -1 um}"):
        with pytest.raises(ConfigError, match=r"c.yaml:8:.*error.model_std"):
            problem(tmp_path, wrong)


@pytest.mark.parametrize(("value", "words"), [("", "is blank"), (0, "is 0, not positive"), (-1, "is -1, not positive")])
def test_an_error_that_is_none_is_refused(tmp_path, value, words):
    with pytest.raises(DataError, match=f"reading 5 in column 's' {words}"):
        problem(tmp_path, "{radius_std: {column: s}}", [*ROWS[:4], (20, 50, value, 0.1)])


def test_a_column_that_is_missing_and_a_unit_of_another_kind_are_told(tmp_path):
    with pytest.raises(DataError, match="no column 'std'"):
        problem(tmp_path, "{radius_std: {column: std}}")
    with pytest.raises(ConfigError, match=r"c.yaml:8:.*us"):
        problem(tmp_path, "{radius_std: {column: s, unit: us}}")
