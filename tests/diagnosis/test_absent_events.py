"""Members on whose path nothing happens of what was read are excluded by the reading, and not lost by the model."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.commands.run import _Warnings
from en4dvar.diagnosis.honesty.checks import loss
from en4dvar.ensemble.members import NOT_FINITE
from en4dvar.model.state import Parameter
from en4dvar.plumbing.caution import caution
from en4dvar.priors.prior import Prior, PriorTerm

PRIOR = Prior((PriorTerm.normal(Parameter("r", "m"), 0.0, 1.0),))
MEMBERS = np.linspace(-2, 2, 40)[:, None]
FAILURES = [NOT_FINITE] * 8 + [""] * 30 + ["step size too small"] * 2


def test_what_lacks_the_event_is_a_note_and_the_rest_is_lost():
    lost, absent = loss("prior forecast", FAILURES, PRIOR, MEMBERS, events=True)
    assert (lost.severity, absent.severity) == ("caution", "note")
    assert lost.words.startswith("2 of 40 members failed in the prior forecast: step size too small (2×); lost members")
    assert absent.words.startswith("8 of 40 members lack the event in the prior forecast; lost members have r below")
    assert absent.advice.startswith("no action is needed")


def test_a_member_without_readings_of_another_kind_is_lost():
    (lost,) = loss("prior forecast", FAILURES, PRIOR, MEMBERS)
    assert lost.severity == "serious"
    assert lost.words.startswith("10 of 40 members failed")


@pytest.mark.parametrize("joint", [True, False])
def test_the_terminal_counts_what_is_serious(joint):
    """Of five data sets that lose members two lose many."""
    warnings = _Warnings()
    warnings.joint = joint
    for i in range(5):
        lost = [caution("members-lost", "1 of 9", "caution"), caution("members-lost", "9 of 9", "serious")]
        warnings.add(f"set{i}", lost if i in (1, 3) else lost[:1])
    line = next(warnings.lines())
    assert line.startswith("warning: set1, set3: members-lost (the model failed for some members); ")
    for i in range(5, 9):
        warnings.add(f"set{i}", lost)
    assert next(warnings.lines()).startswith("warning: 6 of 9 data sets, worst set1, set3, set5: members-lost (")
