"""Processes read the data files themselves: at the same place, to the same words."""

import os
import pickle

import pytest
from run_files import configuration, make_campaign

from en4dvar.executor import ProcessesExecutor
from en4dvar.executor.base import CommonValue
from en4dvar.runs import worklist
from en4dvar.runs.runner import run_campaign


def test_names_of_files_mean_the_same_in_a_worker(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ProcessesExecutor(1) as executor:
        assert list(executor.map(os.getcwd, [()])) == [(0, str(tmp_path))]


def test_what_calls_share_is_made_once():
    shared = CommonValue(["one"])
    first, second = (pickle.loads(pickle.dumps(shared)) for _ in range(2))
    assert first.value == ["one"]
    assert first.value is second.value is not shared.value


@pytest.mark.slow
def test_what_a_worker_cannot_read_is_told_as_here(tmp_path, monkeypatch):
    path = make_campaign(tmp_path, 3)
    (tmp_path / "data" / "set1.csv").write_text("t_ms,x_um\n")
    here = run_campaign(configuration(path, tmp_path / "here"))
    monkeypatch.setattr(worklist, "build_one", None)  # nothing is read here any more
    there = run_campaign(configuration(path, tmp_path / "there", executor="processes", workers=2))
    assert [one.failure for one in there.outcomes] == [one.failure for one in here.outcomes]
    assert "set1.csv" in there.failures[0].failure
    assert [one.sha256 == "" for one in there.outcomes] == [False, True, False]
    assert [one.summary for one in there.outcomes] == [one.summary for one in here.outcomes]
