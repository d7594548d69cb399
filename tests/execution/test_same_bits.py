"""The numbers do not depend on where the work is done, nor on a worker that dies."""

import pytest
from run_files import assert_same_results, configuration, make_campaign

from en4dvar.runs.runner import run_campaign

WHERE = [(kind, n) for kind in ("serial", "threads", "processes", "dask") for n in (1, 2)]


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """An undisturbed campaign of four data sets, one of large amplitude, in one process."""
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, 4, large=2)
    assert run_campaign(configuration(path, folder / "run", executor="serial")).exit_code == 0
    return path, folder / "run"


@pytest.mark.parametrize(("kind", "workers"), WHERE[1:])
def test_campaign_on_any_executor(quiet, tmp_path, kind, workers):
    path, run = quiet
    campaign = run_campaign(configuration(path, tmp_path / "run", executor=kind, workers=workers))
    assert campaign.exit_code == 0
    assert len(campaign) == 4
    assert_same_results(tmp_path / "run", run)


@pytest.mark.parametrize("kind", ["threads", "processes", "dask"])
def test_members_on_workers_where_data_sets_are_few(quiet, tmp_path, kind):
    path, run = quiet
    config = configuration(path, tmp_path / "run", executor=kind, workers=5)
    assert run_campaign(config).exit_code == 0
    assert_same_results(tmp_path / "run", run)


@pytest.mark.parametrize("kind", ["processes", "dask"])
@pytest.mark.parametrize("workers", [2, 5], ids=["data sets", "members"])
@pytest.mark.fault("worker-killed")
def test_death_of_a_worker_changes_nothing(quiet, tmp_path, monkeypatch, kind, workers):
    _, run = quiet
    path = make_campaign(tmp_path, 4, "execution_models:DiesOnce", large=2)
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", str(tmp_path / "died"))
    campaign = run_campaign(configuration(path, tmp_path / "run", executor=kind, workers=workers))
    assert (tmp_path / "died").exists()
    assert campaign.failures == ()
    assert_same_results(tmp_path / "run", run)


@pytest.mark.parametrize("kind", ["processes", "dask"])
@pytest.mark.fault("worker-always")
def test_a_data_set_that_kills_every_worker_is_named_and_the_others_are_not_disturbed(quiet, tmp_path, kind):
    _, run = quiet
    path = make_campaign(tmp_path, 4, "execution_models:DiesAlways", large=2)
    campaign = run_campaign(configuration(path, tmp_path / "run", executor=kind, workers=2))
    assert [(o.name, o.exit_code) for o in campaign.failures] == [("set2", 1)]
    assert campaign.failures[0].failure == "WorkerLostError: a worker process died"
    assert campaign.exit_code == 1
    (tmp_path / "run" / "posterior.nc").unlink()
    expected = tmp_path / "expected"
    (expected / "datasets").mkdir(parents=True)
    for i in (0, 1, 3):
        (expected / "datasets" / f"set{i}.nc").write_bytes((run / "datasets" / f"set{i}.nc").read_bytes())
    assert_same_results(tmp_path / "run", expected)
