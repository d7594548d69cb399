"""What a parameter, a field and a pulse refuse where they are declared."""

from __future__ import annotations

import re

import pytest

from en4dvar import ConfigError, Field, Parameter
from en4dvar_bubble import histotripsy


@pytest.mark.parametrize(
    ("declare", "words"),
    [
        (lambda: Parameter("a", "1", bounds=(2.0, 1.0)), "parameter a: bounds (2.0, 1.0): the first must be below"),
        (lambda: Parameter("a", "zorg"), "parameter a: "),
        (lambda: Field("x", -1), "field x: a size of -1"),
    ],
)
def test_what_cannot_be_is_refused(declare, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        declare()


def test_a_number_of_a_pulse_has_bounds():
    with pytest.raises(ConfigError, match=r"exponent of the pulse must lie in \[1, inf\] 1, not 0\.5"):
        histotripsy(exponent=0.5)
