"""The shipped design that asks for the law of a bubble: the twin's deciding experiment (docs/agarose_study.md)."""

from __future__ import annotations

from pathlib import Path

import pytest

from en4dvar.runs.design_run import run_design

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "acoustic_design.yaml"


@pytest.mark.slow
def test_readings_through_the_rebound_decide(tmp_path):
    """At 0.3 µm and through the rebound the law is found; as the paper measured it, it is not."""
    few = {"design.draws": 20, "design.simulated": 20, "design.inner": 60, "execution.executor": "serial"}
    knobs = {"until": {"key": "design.times.to", "values": ["36 us"]}}
    knobs |= {"error": {"key": "data.error.radius_std", "values": ["0.3 um"]}}
    found, _ = run_design(CONFIG, overrides={**few, "design.knobs": knobs}, out=tmp_path / "out")
    paper, deciding = (row.result.decision for row in found.rows)
    assert deciding.probability > 0.9
    assert paper.probability < 0.7
