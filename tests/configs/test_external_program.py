"""The shipped external program recovers its truth, with the bits of the same function in Python."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import en4dvar
from en4dvar.assembly.build import build

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@pytest.mark.slow
def test_the_external_program_has_the_bits_of_its_function_and_finds_its_truth(tmp_path):
    path = CONFIGS / "external_program.yaml"
    found = en4dvar.run(path, overrides={"output.directory": str(tmp_path / "run"), "output.report": False})
    truth = {"A": 0.104, "c": 0.3, "k": 4.0}
    for name, value in truth.items():
        members = found.posterior[name].values
        assert abs(members.mean() - value) < 3 * members.std(), name
    assert found.warnings == ()
    displacement = runpy.run_path(str(CONFIGS / "programs" / "oscillator.py"))["displacement"]
    (problem,) = build(en4dvar.load_config(path))
    times = problem.observations.times
    (trajectory,) = problem.model.trajectories(problem.model.initial_state(truth)[None], times)
    np.testing.assert_array_equal(trajectory["x"], [displacement(truth, t) for t in times.tolist()])
