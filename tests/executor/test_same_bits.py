"""The numbers do not depend on where the work is done, nor on a worker that dies."""

import pytest
from run_files import add_to_pack, assert_same_results, configuration, make_campaign

from en4dvar.report.result import load_result
from en4dvar.results.pack import PACK, results_of
from en4dvar.runs.runner import run_campaign

EVERYWHERE = [
    ("serial", 2), ("threads", 2), ("processes", 2), ("dask", 2),
    *(pytest.param(kind, 1, marks=pytest.mark.slow) for kind in ("threads", "processes", "dask")),
]  # fmt: skip


def undisturbed(folder, sets, large):
    path = make_campaign(folder, sets, large=large)
    assert run_campaign(configuration(path, folder / "run", executor="serial")).exit_code == 0
    return path, folder / "run"


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """An undisturbed campaign of four data sets, one of large amplitude, in one process."""
    return undisturbed(tmp_path_factory.mktemp("quiet"), 4, large=2)


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """The same of two data sets, fewer than three workers: these share the members."""
    return undisturbed(tmp_path_factory.mktemp("few"), 2, large=1)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "workers"), EVERYWHERE)
def test_campaign_on_any_executor(quiet, tmp_path, kind, workers):
    path, run = quiet
    campaign = run_campaign(configuration(path, tmp_path / "run", executor=kind, workers=workers))
    assert campaign.exit_code == 0
    assert len(campaign) == 4
    assert_same_results(tmp_path / "run", run)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["threads", "processes", "dask"])
def test_members_on_workers_where_data_sets_are_few(few, tmp_path, kind):
    path, run = few
    config = configuration(path, tmp_path / "run", executor=kind, workers=3)
    assert run_campaign(config).exit_code == 0
    assert_same_results(tmp_path / "run", run)


@pytest.mark.parametrize(
    ("campaign", "workers", "kind"),
    [
        pytest.param("quiet", 2, "processes", id="data sets-processes", marks=pytest.mark.slow),
        pytest.param("few", 3, "processes", id="members-processes"),
        pytest.param("quiet", 2, "dask", id="data sets-dask", marks=pytest.mark.slow),
        pytest.param("few", 3, "dask", id="members-dask", marks=pytest.mark.slow),
    ],
)
@pytest.mark.fault("worker-killed")
def test_death_of_a_worker_changes_nothing(request, tmp_path, monkeypatch, kind, campaign, workers):
    _, run = request.getfixturevalue(campaign)
    sets = len(results_of(run / PACK))
    path = make_campaign(tmp_path, sets, "execution_models:DiesOnce", large=sets // 2)
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", str(tmp_path / "died"))
    done = run_campaign(configuration(path, tmp_path / "run", executor=kind, workers=workers))
    assert (tmp_path / "died").exists()
    assert done.failures == ()
    assert_same_results(tmp_path / "run", run)


@pytest.mark.slow
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
    for i in (0, 1, 3):
        add_to_pack(expected, f"set{i}", load_result(run / PACK / f"set{i}"))
    assert_same_results(tmp_path / "run", expected)
