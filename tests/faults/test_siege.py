"""The attacks of benchmarks/siege.py and the kills of benchmarks/kills.py, a few of each."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from kills import survive
from siege import ATTACKED, KINDS, Siege, besiege
from siege_commands import commands

from en4dvar.results.kinds import KINDS as KINDS_OF_RUNS

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


def test_the_code_of_this_tree_is_attacked(tmp_path):
    """Of a second working tree too, where another one is installed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(ATTACKED)}
    for package in ("en4dvar", "en4dvar_bubble"):
        words = [sys.executable, "-c", f"import {package}; print({package}.__file__)"]
        told = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
        assert Path(told.strip()).is_relative_to(Path(__file__).parents[2])


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
