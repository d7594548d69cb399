"""Each data set of a run has draws of its own, which depend on its name and the run's seed alone."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from run_files import configuration, make_campaign
from scipy.stats import chisquare
from toys import Vectorised

from en4dvar.priors.prior import own_seed
from en4dvar.report.result import load_result
from en4dvar.runs.rerun import rerun
from en4dvar.runs.runner import run, run_campaign

SETS, BINS, MEMBERS = 250, 7, 48
STRAIGHT = """\
name: straight
seed: 1
data:
  path: "data/*.csv"
  columns: {time: {name: t_s, unit: s}, y: {name: y_m, unit: m}}
  error: {y_std: 0.3 m}
model: {name: "toys:Vectorised"}
parameters:
  a: {prior: normal, mean: 1 m, std: 0.5 m}
  b: {prior: normal, mean: 0.5 m, std: 0.5 m}
"""


def prior_of(result):
    return np.array([result.prior[name].values[0] for name in ("A", "k")])


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    path = make_campaign(folder, 3)
    run_campaign(configuration(path, folder / "together"))
    return folder, path


def test_sets_of_a_campaign_differ_in_draws_and_agree_in_their_moments(campaign):
    folder, _ = campaign
    first, second, third = (prior_of(load_result(folder / f"together/datasets.pack/set{i}")) for i in range(3))
    for other in (second, third):
        assert np.abs(first - other).min() > 1e-9
        for what in (np.mean, np.std):
            np.testing.assert_allclose(what(np.log(first[1])), what(np.log(other[1])), rtol=1e-12)


def test_a_set_has_the_same_bits_alone_and_among_others(campaign):
    folder, path = campaign
    alone = folder / "alone.yaml"
    alone.write_text(path.read_text().replace("data/*.csv", "data/set1.csv"))
    run(configuration(alone, folder / "alone", executor="serial"))
    backwards = folder / "backwards.yaml"
    names = "[data/set2.csv, data/set1.csv]"
    backwards.write_text(path.read_text().replace("data/*.csv", names))
    run_campaign(configuration(backwards, folder / "backwards", executor="serial"))
    together = load_result(folder / "together/datasets.pack/set1")
    for other in (folder / "alone/posterior.nc", folder / "backwards/datasets.pack/set1"):
        found = load_result(other)
        for group in ("prior", "posterior", "iterations"):
            assert found.dataset(group).identical(together.dataset(group))
        assert found.attributes["seed"] == together.attributes["seed"] == own_seed(3, "set1")


def test_files_made_when_all_sets_had_one_seed_are_repeated_to_the_bit(campaign, monkeypatch):
    folder, path = campaign
    with monkeypatch.context() as before:
        before.setattr("en4dvar.runs.worklist.own_seed", lambda seed, name: seed)
        run_campaign(configuration(path, folder / "before"))
    first, second = (load_result(folder / f"before/datasets.pack/set{i}") for i in range(2))
    assert first.attributes["seed"] == 3
    np.testing.assert_array_equal(first.prior["k"], second.prior["k"])
    assert rerun(folder / "before").same


def write_straight(folder):
    """Experiments whose truths are drawn from the prior, all at the same times."""
    random, times = np.random.default_rng(3), np.linspace(0.2, 2.0, 9)
    truths = np.array([1.0, 0.5]) + 0.5 * random.standard_normal((SETS, 2))
    (folder / "data").mkdir()
    for i, truth in enumerate(truths):
        values = [Vectorised().curve(truth, t) for t in times] + 0.3 * random.standard_normal(9)
        rows = "".join(f"{t!r},{y!r}\n" for t, y in zip(times.tolist(), values.tolist(), strict=True))
        (folder / "data" / f"set{i:03d}.csv").write_text(f"t_s,y_m\n{rows}")
    path = folder / "straight.yaml"
    path.write_text(STRAIGHT)
    return path, truths


@pytest.mark.slow
def test_ranks_of_a_linear_campaign_are_uniform_with_one_seed(tmp_path):
    """With draws common to all sets the 48 draws' own histogram is what is found (p = 9e-4 for a)."""
    path, truths = write_straight(tmp_path)
    assert run_campaign(configuration(path, tmp_path / "run", checkpoint_every=60)).exit_code == 0
    with xr.open_datatree(tmp_path / "run" / "posterior.nc") as tree:
        for name, truth in zip(("a", "b"), truths.T, strict=True):
            ranks = np.sum(tree["posterior"][name].values[:, 0] < truth[:, None], axis=1)
            counts = np.histogram(ranks, bins=BINS, range=(-0.5, MEMBERS + 0.5))[0]
            assert chisquare(counts).pvalue > 0.01, (name, counts)
