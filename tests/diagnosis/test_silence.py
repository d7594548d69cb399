"""No warning where there is nothing to warn of: the shipped quick start, and experiments that are as they say."""

from __future__ import annotations

from pathlib import Path

import pytest
from diagnosis.provoked import decay_experiments, linear_experiments, waved

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.settings import AssimilationSettings

QUICKSTART = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


def false_alarms(problems, **settings):
    """Words of the warnings of each experiment that has some."""
    ends = [assimilate(p, AssimilationSettings(**settings), seed) for seed, p in enumerate(problems)]
    graver = [[str(c) for c in a.cautions if c.severity != "note"] for a in ends]
    return [words for words in graver if words]


def test_the_quick_start_is_silent():
    config = load_config(QUICKSTART)
    (problem,) = build(config)
    assert assimilate(problem, config.assimilation, config.seed).cautions == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{}, {"sampling": "random"}, {"linearisation": "transform"}, {"scheme": "es-mda"}], ids=str
)
def test_linear_experiments_raise_no_false_alarm(settings):
    """By their quantiles misfit, overstated error and conflict together may cry once in 700 experiments."""
    assert len(false_alarms(linear_experiments(50, 77), **settings)) <= 1


def test_a_discrepancy_that_is_not_there_is_not_found():
    assert false_alarms([waved(0.0)]) == []


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"members": 24}, {"linearisation": "transform"}], ids=str)
def test_mildly_nonlinear_experiments_raise_few_false_alarms(settings):
    assert len(false_alarms(decay_experiments(60, 78), **settings)) <= 1
