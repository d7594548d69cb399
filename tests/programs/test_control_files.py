"""A control file of PEST becomes an estimate: its parameters, observations and weights."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

import en4dvar
from en4dvar.programs.control import from_pest

CONTROL = f"""pcf
* control data
restart estimation
3 4 1 0 1
1 1 single point
* parameter groups
pg relative 0.01 0.0 switch 2.0 parabolic
* parameter data
A log factor 1.0 0.1 10.0 pg 1.0 0.0 1
b none relative 0.0 -4.0 4.0 pg 1.0 0.0 1
c fixed factor 2.0 1.0 3.0 pg 1.0 0.0 1
* observation groups
og
* observation data
h1 3.5 10.0 og
h2 4.5 10.0 og
bad 99.0 0.0 og
h3 5.5 5.0 og
* model command line
{sys.executable} -S line.py
* model input/output
line.tpl run/line.in
line.ins line.out
"""
PROGRAM = """
a, b, c = (float(word) for word in open("run/line.in"))
open("line.out", "w").write("".join(f"{c + a * t + b} \\n" for t in (1, 2, 3, 3)))
"""


@pytest.fixture
def control(tmp_path):
    (tmp_path / "line.pst").write_text(CONTROL)
    (tmp_path / "line.tpl").write_text("ptf ~\n~        a           ~\n~      b             ~\n~ c  ~\n")
    (tmp_path / "line.ins").write_text("pif @\nl1 !h1!\nl1 !h2!\nl1 !h3!\nl1 !bad!\n")
    (tmp_path / "line.py").write_text(PROGRAM)
    return tmp_path / "line.pst"


def test_a_control_file_says_what_to_estimate_from_what(control):
    found = from_pest(control, ["line.py"])
    assert found["priors"] == {
        "a": {"prior": "lognormal", "median": 1.0, "log_std": math.log(100) / 4},
        "b": {"prior": "normal", "mean": 0.0, "std": 2.0},
        "c": 2.0,
    }
    np.testing.assert_array_equal(found["data"]["observations"], [3.5, 4.5, 5.5])
    np.testing.assert_allclose(found["error"], [0.1, 0.1, 0.2])
    result = en4dvar.estimate(**found, progress=False, assimilation={"members": 8})
    assert result.posterior["a"].mean() == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(
        result.dataset("posterior_predictive")["observations"].mean(("chain", "draw")), [3.5, 4.5, 5.5], atol=0.1
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pcf", "pst", "line.pst: the first line of a control file is pcf"),
        ("b none", "b tied", "line.pst:10: parameter b is tied; log, none and fixed are known"),
        ("-4.0", "low", "line.pst:10: 'low' where b has a number"),
        ("99.0 0.0", "99.0", "line.pst:17: 'og' where bad has a number"),
        ("* model command line", "* command", "line.pst: no section '* model command line'"),
        ("line.ins line.out", "", "line.pst: 0 instruction files; one is read"),
        ("line.tpl", "none.tpl", "none.tpl: No such file or directory"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_line(control, old, new, words):
    control.write_text(CONTROL.replace(old, new))
    with pytest.raises(en4dvar.ConfigError) as caught:
        from_pest(control)
    assert str(caught.value).endswith(words)
