"""The attacks of benchmarks/siege.py and the kills of benchmarks/kills.py, a few of each."""

import os

import pytest
from kills import survive
from siege import ATTACKED, KINDS, Siege, besiege
from siege_commands import commands

from en4dvar.runs.engine import KINDS as KINDS_OF_RUNS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="forks of POSIX")]
CONTINUED = [*KINDS_OF_RUNS, "run, chain", "sweep", "study"]


@pytest.fixture(scope="module")
def siege(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(ATTACKED))
        made = Siege(tmp_path_factory.mktemp("siege") / "base")
        made.base.mkdir()
        made.prepare()
        yield made
        made.children.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.fault("result-incomplete")
def test_an_attack_holds(siege, kind):
    for number in range(3):
        outcome, fault = besiege(siege, kind, 3, number)
        assert outcome != "findings", fault


@pytest.mark.long
@pytest.mark.parametrize("name", CONTINUED)
@pytest.mark.fault("kill")
@pytest.mark.fault("kill-commands")
def test_a_command_that_is_killed_ends_in_the_same_bits(siege, name):
    _, killed, whole, fault = survive(siege, name, commands(siege.base)[name], 3, 1)
    assert not fault
    assert killed >= 3
    assert whole
