"""Evidence that ``en4dvar compare`` samples from finished runs, against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from run_files import make_campaign

from en4dvar.ensemble.forecast import cost
from en4dvar.model.forward import ForwardModel
from en4dvar.runs.finished import finished, sampled_evidences
from en4dvar.runs.runner import run_campaign


@pytest.mark.slow
def test_a_cheap_model_is_sampled_and_another_says_so(tmp_path, monkeypatch):
    overrides = {"output.report": False, "output.directory": str(tmp_path / "run")}
    run = run_campaign(make_campaign(tmp_path, n=2), overrides=overrides).directory
    told: list[str] = []
    assert sampled_evidences(run, None, False, told.append) == {}
    assert "not cheap" in told[0]
    monkeypatch.setattr(ForwardModel, "cheap", True)
    found = sampled_evidences(run, None, False, told.append)
    assert len(told) == 1
    for one in finished([run], False, None)[1]:
        middle, width = one.white.mean(axis=0), 6 * one.white.std(axis=0)
        axes = [m + w * np.linspace(-1, 1, 81) for m, w in zip(middle, width, strict=True)]
        z = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        log = -cost(one.problem, one.problem.prior.from_white(z))
        cell = np.prod([axis[1] - axis[0] for axis in axes]) / (2 * np.pi)
        exact = log.max() + np.log(np.exp(log - log.max()).sum() * cell)
        assert abs(found[one.name] + one.problem.observations.log_normalisation() - exact) < 0.25
