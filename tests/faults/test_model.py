"""A forward model that fails in every way it can: the members are lost with their reason, the run is not."""

import math
import re
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from faulty_models import STIFF, LosesAt
from run_files import configuration
from toy_config import write_toy

from en4dvar.executor import limits
from en4dvar.executor.limits import parse_bytes
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.runs.runner import run

LIMITS = {  # far more time than a batch needs on a busy machine
    "hangs": {"workers": 2, "time_limit": "2 s"},
    "hangs_in_compiled_code": {"workers": 2, "time_limit": "2 s"},
    "allocates": {"workers": 2, "memory_limit": "300 MB"},
}
REASONS = {
    "raises": "ArithmeticError: no such oscillation",
    "not_a_number": "non-finite state",
    "wrong_shape": "step returned shape (3,), expected (4,)",
    "hangs": "TimeLimitError: not done after 2 s",
    "hangs_in_compiled_code": "a worker process died, or was ended at its time limit of ",
    "allocates": "MemoryError: ",
}


@pytest.fixture(scope="module")
def raising(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raising")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EN4DVAR_TEST_FAULT", "raises")
        return run(configuration(faulty(folder), folder / "run", executor="serial"))


def faulty(folder):
    return write_toy(folder, ("toy_models:Oscillator", "faulty_models:Faulty"))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("raises", marks=pytest.mark.fault("model-raises")),
        pytest.param("not_a_number", marks=pytest.mark.fault("model-nan")),
        pytest.param("wrong_shape", marks=pytest.mark.fault("model-shape")),
        pytest.param("hangs", marks=pytest.mark.fault("model-hangs")),
        pytest.param("hangs_in_compiled_code", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("allocates", marks=pytest.mark.fault("model-memory")),
    ],
)
def test_only_the_faulty_members_are_lost(raising, tmp_path, monkeypatch, name):
    """Whatever a member does, the others are as they are where it raises an exception, and it is told why."""
    check_losses(raising, tmp_path, monkeypatch, name, LIMITS.get(name, {"executor": "serial"}))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("hangs", marks=pytest.mark.fault("model-hangs")),
        pytest.param("hangs_in_compiled_code", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("allocates", marks=pytest.mark.fault("model-memory")),
    ],
)
@pytest.mark.slow
def test_limits_on_dask(raising, tmp_path, monkeypatch, name):
    check_losses(raising, tmp_path, monkeypatch, name, {**LIMITS[name], "executor": "dask"})


def check_losses(raising, tmp_path, monkeypatch, name, execution):
    monkeypatch.setenv("EN4DVAR_TEST_FAULT", name)
    result = run(configuration(faulty(tmp_path), tmp_path / "run", **execution))
    reasons = result.sample_stats["prior_failure_reason"].values.ravel()
    stiff = result.prior["k"].values.ravel() > STIFF
    assert 0 < stiff.sum() < 4
    assert all(reason.startswith(REASONS[name]) for reason in reasons[stiff]), reasons
    assert not any(reasons[~stiff])
    assert result.sample_stats["active"].all()
    for key in ("A", "k"):
        assert np.array_equal(result.posterior[key], raising.posterior[key])


@pytest.mark.parametrize("thread", [False, True], ids=["main thread", "another thread"])
def test_a_time_limit_is_over_with_its_batch(monkeypatch, thread):
    """Batches that end just when their time is up: interrupted or not, but never what comes after them."""
    monkeypatch.setattr(limits, "_limits", limits.Limits(seconds=0.002))
    monkeypatch.setattr(limits, "_watch", lambda _: None)  # which would end this process
    reasons = set()

    def batches():
        for i in range(300):
            end = time.perf_counter() + 0.0018 + 1e-6 * i
            try:
                limits.within_time_limit(lambda end=end: busy_until(end))
            except limits.TimeLimitError as error:
                reasons.add(str(error))
            for _ in range(1000):
                pass
        with pytest.raises(limits.TimeLimitError) as interrupted:  # on a busy machine perhaps the only one
            limits.within_time_limit(lambda: busy_until(math.inf))
        reasons.add(str(interrupted.value))

    if thread:
        with ThreadPoolExecutor(1) as pool:
            pool.submit(batches).result()
    else:
        batches()
    assert reasons == {"not done after 0.002 s"}


def busy_until(end):
    while time.perf_counter() < end:
        pass


def test_a_limit_needs_a_process_to_end(tmp_path):
    path = faulty(tmp_path)
    with pytest.raises(ConfigError, match="ended at its limit; write executor: processes, not threads"):
        configuration(path, tmp_path / "run", executor="threads", time_limit="1 s")
    with pytest.raises(ConfigError, match=r"'2 pints' is not a size of memory; write e\.g\. 2 GB"):
        configuration(path, tmp_path / "run", memory_limit="2 pints")
    config = configuration(path, tmp_path / "run", memory_limit="2 GB", time_limit="1 min")
    assert (config.execution.limits.seconds, config.execution.limits.memory) == (60.0, 2 * 10**9)
    assert parse_bytes("1.5 GiB") == 3 << 29


def losing(tmp_path, at, share):
    """Every iteration forecasts the whole ensemble (transform variant)."""
    LosesAt.at, LosesAt.share, LosesAt.calls = at, share, 0
    path = write_toy(
        tmp_path,
        ("toy_models:Oscillator", "faulty_models:LosesAt"),
        ("members: 8", "linearisation: transform\n  members: 8"),
    )
    return run(configuration(path, tmp_path / f"run{at}_{share}", executor="serial"))


@pytest.fixture(scope="module")
def forecasts(tmp_path_factory):
    """Number of forecasts of the ensemble in an undisturbed run."""
    losing(tmp_path_factory.mktemp("count"), 0, 1.0)
    return LosesAt.calls


STAGES = {0.0: "prior forecast", 0.5: r"forecast of iteration \d", 1.0: "posterior forecast"}


@pytest.mark.parametrize("where", STAGES, ids=["first", "middle", "last"])
@pytest.mark.fault("all-lost")
def test_all_members_lost(tmp_path, forecasts, where):
    with pytest.raises(TooFewMembersError) as lost:
        losing(tmp_path, 1 + round(where * (forecasts - 1)), 1.0)
    assert re.fullmatch(
        rf"toy: 8 of 8 members failed in the {STAGES[where]}; at least 4 must survive. "
        r"Most frequent reasons: lost on purpose \(8×\)",
        str(lost.value),
    )
    assert lost.value.exit_code == 3


@pytest.mark.parametrize("where", STAGES, ids=["first", "middle", "last"])
@pytest.mark.fault("half-lost")
def test_half_of_the_members_lost(tmp_path, forecasts, where):
    result = losing(tmp_path, 1 + round(where * (forecasts - 1)), 0.5)
    stage = "iterations" if where == 0.5 else STAGES[where]
    assert any(w.startswith(f"4 of 8 members failed in the {stage}: lost on purpose (4×)") for w in result.warnings)
    active = result.sample_stats["active"].values.ravel()
    assert active.sum() == (4 if where == 1.0 else 8)
    assert result.posterior["k"].values.ravel()[active].mean() == pytest.approx(2.0, rel=0.01)  # of the data
