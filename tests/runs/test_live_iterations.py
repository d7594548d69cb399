"""Iterations are told while they run, wherever that is: the model waits until its first ones have been heard of."""

import re

import pytest
from run_files import assert_same_results, configuration, make_campaign
from worker_calls import counts

from en4dvar.diagnosis.analysis import Descents, StartRecord
from en4dvar.executor import choose_executor
from en4dvar.runs.runner import run_campaign


class Listener:
    """Lets the waiting models go on once the ``last`` iteration before is in the log, which came fast upon another.

    With ``of``, that of the data set of this name.
    """

    def __init__(self, out, flag, of=None, last=2):
        self.out, self.flag, self.of, self.last, self.heard = out, flag, of, last, []

    def __call__(self, name, record):
        lines = log(self.out)
        if isinstance(record, StartRecord):
            stage = "search for another minimum" if record.further else "start"
            assert any(f"{name}: {stage}, round {record.rounds:2d}  lowest J " in line for line in lines)
            self.flag.with_suffix(".start").touch()
            return
        if isinstance(record, Descents):
            assert any(f"{name}: {record.words}" in line for line in lines)
            return
        if not self.heard:
            assert any(f"{name}: iteration {record.iteration:2d}  J " in line for line in lines)
            if self.of in (name, None):  # a data set that does not wait may end before it sends its second message
                assert not any(f"{name}: converged" in line for line in lines)
        self.heard.append((name, record.iteration))
        if record.iteration == self.last and self.of in (name, None):
            self.flag.touch()


def log(out):
    return (out / "run.log").read_text().splitlines()


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    return undisturbed(tmp_path_factory.mktemp("campaign") / "quiet")


def undisturbed(folder, **how):
    folder.mkdir()
    run_campaign(configuration(make_campaign(folder, 3, **how), folder / "run", executor="serial"))
    return folder / "run"


def iterations(lines, name):
    return [int(found[1]) for line in lines if (found := re.search(rf" {name}: iteration +(\d+)  J ", line))]


@pytest.mark.parametrize(
    "kind", ["threads", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("processes", "dask"))]
)
def test_an_iteration_is_told_before_its_data_set_ends(quiet, tmp_path, monkeypatch, kind):
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", str(tmp_path / "heard"))
    path, out = make_campaign(tmp_path, 3, "execution_models:WaitsTwice"), tmp_path / "run"
    listener = Listener(out, tmp_path / "heard")
    campaign = run_campaign(configuration(path, out, executor=kind, workers=2), progress=listener)
    assert campaign.exit_code == 0
    assert not (tmp_path / "heard.unheard").exists()
    assert_same_results(out, quiet)
    for result in campaign:
        n = result.iterations.sizes["iteration"]
        assert [i for name, i in listener.heard if name == result.name] == list(range(n))
        assert iterations(log(out), result.name) == list(range(n))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["processes", "dask"])
@pytest.mark.fault("worker-killed")
def test_iterations_of_a_killed_worker_are_told_again(tmp_path, monkeypatch, kind):
    """It dies as soon as four of them have been heard here: by then none of them is on its way."""
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", str(tmp_path / "heard"))
    path, out = make_campaign(tmp_path, 3, "execution_models:WaitsAndDies", large=1), tmp_path / "run"
    listener = Listener(out, tmp_path / "heard", of="set1", last=3)
    campaign = run_campaign(configuration(path, out, executor=kind, workers=2), progress=listener)
    assert (tmp_path / "heard.died").exists()
    assert campaign.exit_code == 0
    assert not (tmp_path / "heard.unheard").exists()
    assert_same_results(out, undisturbed(tmp_path / "quiet", large=1))
    lines = log(out)
    (lost,) = (line for line in lines if "its worker was lost" in line)
    assert lost.endswith(" set1: its worker was lost; another one repeats it")
    for result in campaign:
        whole = list(range(result.iterations.sizes["iteration"]))
        told_before = [0, 1, 2, 3] if result.name == "set1" else []
        assert iterations(lines, result.name) == told_before + whole


@pytest.mark.parametrize("kind", ["serial", "threads", "processes", pytest.param("dask", marks=pytest.mark.slow)])
def test_what_calls_tell_comes_in_order_and_before_their_end(kind):
    """For any call; one that raises has told too."""
    seen = []
    with choose_executor(None, kind, 1 if kind == "serial" else 2) as executor:
        for i, value in executor.map(counts, [(3,), (0,), (5,)], lambda i, message: seen.append((i, message))):
            seen.append((i, repr(value)))
        assert sorted(executor.map(abs, [(-1,), (-2,)])) == [(0, 1), (1, 2)]  # no listener, nothing to tell
    assert [m for i, m in seen if i == 0] == [0, 1, 2, "3"]
    assert [m for i, m in seen if i == 1] == ["ValueError('nothing to count')"]
    assert [m for i, m in seen if i == 2] == [0, 1, 2, 3, 4, "5"]
