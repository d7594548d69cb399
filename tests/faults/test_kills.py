"""SIGKILL: what is left can always be resumed, to the same bits."""

import pytest
from killing import survive


@pytest.mark.slow
@pytest.mark.fault("kill")
def test_killed_at_some_file_operations():
    """Checkpoints, netCDF, lists of files: a write half done, a rename not done, a folder not made."""
    found = survive(400, share=0.03, seed=39)
    assert found["operations"] > 60
    assert found["kills"] >= 3


@pytest.mark.fault("kill-force")
@pytest.mark.slow
def test_killed_while_an_earlier_run_is_replaced():
    found = survive(400, share=0.03, seed=39, force=True)
    assert found["operations"] > 90
    assert found["kills"] >= 3


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.fault("kill")
def test_killed_while_the_report_is_written():
    found = survive(300, sets=1, report=True, share=0.12, seed=3)
    assert any("png" in name or "pdf" in name for name in found["at"].values())
    assert found["kills"] >= 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "executor", ["threads", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("serial", "processes"))]
)
@pytest.mark.fault("kill")
def test_killed_at_random(executor):
    """During forecasts, mostly: that is where the time goes."""
    assert survive(300, sets=4, executor=executor, kills=10, seed=1)["kills"] >= 10


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.fault("kill")
def test_killed_at_every_file_operation(force):
    found = survive(900, share=1.0, seed=1, force=force)
    assert found["kills"] == found["operations"] > 60
