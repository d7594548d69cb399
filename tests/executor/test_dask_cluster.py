"""A running dask scheduler given by its address: used, missing, lost."""

import pytest
from distributed import LocalCluster
from run_files import assert_same_results, configuration, make_campaign

import en4dvar
from en4dvar.executor import ExecutorError
from en4dvar.executor import dask as dask_executor
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.runner import run_campaign


@pytest.mark.slow
@pytest.mark.fault("scheduler-lost")
def test_lost_scheduler_is_one_clear_error_and_the_run_resumes(tmp_path):
    path, out = make_campaign(tmp_path, 4, "execution_models:Slow"), tmp_path / "run"
    run_campaign(configuration(path, tmp_path / "quiet", executor="serial"))
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, memory_limit=0, dashboard_address=":0")
    config = configuration(path, out, address=cluster.scheduler_address)
    with pytest.raises(ExecutorError) as lost:
        run_campaign(config, progress=lambda *_: cluster.close())
    address = cluster.scheduler_address
    assert str(lost.value).startswith(f"lost the connection to the dask scheduler {address}; ")
    assert "of 4 data sets are done and kept" in str(lost.value)
    assert str(lost.value).endswith("give resume=True to continue")
    assert lost.value.exit_code == 1
    assert run_campaign(configuration(path, out, executor="serial"), resume=True).exit_code == 0
    assert_same_results(out, tmp_path / "quiet")


def test_no_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_executor, "CONNECT_TIMEOUT", 1.0)
    path = make_campaign(tmp_path, 2)
    with pytest.raises(ExecutorError, match=r"dask scheduler tcp://127\.0\.0\.1:9: cannot be reached"):
        run_campaign(configuration(path, tmp_path / "run", address="tcp://127.0.0.1:9"))
    assert not (tmp_path / "run").exists()


def test_the_address_in_a_script_is_no_file(monkeypatch):
    monkeypatch.setattr(dask_executor, "CONNECT_TIMEOUT", 1.0)
    address = "tcp://127.0.0.1:9"
    with pytest.raises(ExecutorError, match=f"dask scheduler {address}: cannot be reached"):
        en4dvar.estimate(
            lambda p, t: p["a"] + 0 * t, ([1, 2], [1, 2]), {"a": {"prior": "normal", "mean": 0, "std": 2}}, error=1,
            execution={"executor": "dask", "address": address},
        )  # fmt: skip


def test_an_address_is_of_dask_only(tmp_path):
    path = make_campaign(tmp_path, 2)
    with pytest.raises(ConfigError, match="address is for a dask scheduler only"):
        configuration(path, tmp_path / "run", address="tcp://127.0.0.1:9", executor="threads")
    with pytest.raises(ConfigError, match="address"):
        configuration(path, tmp_path / "run", address="127.0.0.1")
