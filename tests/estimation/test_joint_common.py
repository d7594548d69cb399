"""Constants of medium and camera in a joint estimate: one value in all data sets, unless they are said to be apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import configuration, make_campaign
from scipy.stats import chi2
from toy_config import csv_text
from toys import Vectorised, make_observations

from en4dvar.cli import main
from en4dvar.estimation.joint import estimate_jointly, sharing
from en4dvar.estimation.joint.agreement import Statement, agreement
from en4dvar.estimation.joint.problem import JointProblem
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem, common_to
from en4dvar.report.together import write_joint
from en4dvar.results.netcdf import read_groups, to_bytes
from en4dvar.results.together import load_joint, save_joint
from en4dvar.runs.runner import run_campaign
from en4dvar.schemes.settings import AssimilationSettings

A, B, D = Parameter("a", "m"), Parameter("b", "m"), Parameter("d", "m", common=True)
TERMS = (PriorTerm.normal(A, 0.6, 0.9), PriorTerm.normal(B, 0.2, 0.5), PriorTerm.normal(D, 0.0, 0.4))
SETS, STD = 6, 0.1


class Shifted(Vectorised):
    """y = a + d + b cos(t + 1/3): the data never tell a from d."""

    def __init__(self, parameters=(A, B, D)):
        super().__init__()
        self.parameters = parameters

    def initial_state(self, theta):
        values = np.array([theta["a"] + theta["d"], theta["b"]])
        return np.concatenate([[self.curve(values, 0.0), self.rate(values, 0.0)], values])


def campaign(terms=TERMS):
    """Data sets of one a = 1 and d = 0.3, each with b = 0.4."""
    model, problems = Shifted(tuple(term.parameter for term in terms)), []
    for e in range(SETS):
        times = np.linspace(0.1, 2.5, 6)
        values = 1.3 + 0.4 * np.cos(times + 1 / 3) + STD * np.random.default_rng(e).standard_normal(6)
        data = make_observations(times, values, std=STD, name=f"set {e}")
        problems.append(InverseProblem(model, model.observables[0], data, Prior(terms)))
    return problems


def exact_std(common):
    """Of a, by the normal equations of (a, b of each, d of all or of each) in units of the prior."""
    column = np.cos(np.linspace(0.1, 2.5, 6) + 1 / 3)
    rows = np.zeros((SETS, 6, 1 + 2 * SETS))
    for e in range(SETS):
        rows[e, :, 0], rows[e, :, 1 + e], rows[e, :, 1 + SETS + (0 if common else e)] = 0.9, 0.5 * column, 0.4
    H = rows.reshape(-1, 1 + 2 * SETS) / STD
    return 0.9 * np.sqrt(np.linalg.inv(np.eye(1 + 2 * SETS) + H.T @ H)[0, 0])


@pytest.mark.parametrize("apart", [(), ("d",)])
def test_what_is_common_does_not_average_out(apart):
    problems, settings = campaign(), AssimilationSettings(what_if=False, emulator="off", refine="none")
    joint = sharing(problems, ["a"], apart)
    assert [name for name, _ in joint.shared] == ["a"] if apart else ["a", "d"]
    found = estimate_jointly(joint, settings, seed=3)
    assert found.shared[:, 0].std(ddof=1) == pytest.approx(exact_std(not apart), rel=1e-6)
    assert exact_std(True) > 2 * exact_std(False)
    assert not found.cautions


def test_common_is_what_is_declared_so_and_has_one_prior():
    problems = campaign()
    assert common_to(problems, ["a"]) == common_to(problems, []) == ("d",)
    assert common_to(problems, ["d"]) == common_to(problems[:1], ["a"]) == ()
    for other in (replace(TERMS[2], std=0.5), replace(TERMS[2], parameter=replace(D, common=False))):
        assert common_to([*problems[:-1], *campaign((*TERMS[:2], other))[-1:]], ["a"]) == ()
    without = campaign(TERMS[:2])[-1]  # which has no d at all
    joint = sharing([*problems[:-1], without], ["a"])
    assert joint.groups[0] == {"a": "", "d": ""}
    assert joint.groups[-1] == {"a": ""}


def test_what_can_not_be_apart_is_named():
    with pytest.raises(ConfigError, match=r"^dd: apart, but not shared unless it is asked for; did you mean 'd'"):
        sharing(campaign(), ["a"], ["dd"])


def test_that_values_differ_is_as_improbable_with_a_quantity_that_nobody_learns_of():
    """Readings that know of s alone, and the same with five directions of the prior beside it."""
    joint = sharing(campaign(), ["a"], ["d"])
    precision, deviances = 100 * np.eye(1), np.full(SETS, 4.0)
    wide = np.zeros((6, 6))
    wide[0, 0] = 100
    alone = [Statement(precision, 10 * np.ones(1), np.array([0]))] * SETS
    beside = [Statement(wide, 10 * np.eye(6)[0], np.array([0]))] * SETS
    chance = agreement(joint, alone, range(SETS), deviances).chance
    assert chance == pytest.approx(chi2.sf(24, 5), rel=0.1)
    assert agreement(joint, beside, range(SETS), deviances).chance == pytest.approx(chance)


@pytest.fixture(scope="module")
def oscillators(tmp_path_factory):
    """Three of one spring, whose readings have one unknown scale."""
    folder = tmp_path_factory.mktemp("oscillators")
    path = make_campaign(folder, n=3)
    scale = "  reading_scale: {prior: lognormal, median: 1, log_std: 0.05}\n  A: {"
    path.write_text(path.read_text().replace("  A: {", scale))
    for i in range(3):
        (folder / "data" / f"set{i}.csv").write_text(csv_text(k=2.4, nth=i))
    return path


def told(run, *options):
    out = run.parent / "_".join(["joint", *options[1::2]])
    result = CliRunner().invoke(main, ["joint", str(run), *options, "--out", str(out)])
    assert result.exit_code == 0, result.output
    return load_joint(out / "joint.nc").shared, result.output, (out / "joint.html").read_text()


def test_the_terminal_and_the_page_say_what_is_shared_unasked(oscillators, tmp_path):
    run_campaign(configuration(oscillators, tmp_path / "run"))
    shared, output, page = told(tmp_path / "run", "--share", "k")
    assert shared == ("k", "reading_scale")
    assert "(unless --apart NAME): reading_scale\n" in output
    assert "one value in all data sets by default: reading_scale" in page
    shared, output, page = told(tmp_path / "run", "--share", "k", "--apart", "reading_scale")
    assert shared == ("k",)
    assert "medium and" not in output + page
    shared, _, page = told(tmp_path / "run", "--share", "k", "--share", "reading_scale")
    assert shared == ("k", "reading_scale")
    assert "in all data sets by default" not in page


def test_a_file_of_an_earlier_version_has_a_page(oscillators, tmp_path):
    run_campaign(configuration(oscillators, tmp_path / "run"))
    told(tmp_path / "run", "--share", "k", "--apart", "reading_scale")
    folder = tmp_path / "joint_k_reading_scale"
    groups = read_groups(folder / "joint.nc")
    del groups["/"].attrs["common"]
    to_bytes(groups).write(folder / "joint.nc")
    assert "in all data sets by default" not in write_joint(folder).read_text()


def test_a_configuration_says_so_too(oscillators, tmp_path):
    text = oscillators.read_text()
    for shared, found in (("", ("k", "reading_scale")), (", shared: none", ("k",))):
        changed = text.replace("log_std: 0.3}", "log_std: 0.3, shared: all}").replace("0.05}", f"0.05{shared}}}")
        oscillators.write_text(changed)
        run = tmp_path / f"run{len(shared)}"
        run_campaign(configuration(oscillators, run))
        assert load_joint(run / "joint.nc").shared == found
    oscillators.write_text(text)


def test_groups_whose_names_differ_in_signs_alone_are_kept_apart(tmp_path):
    problems, settings = campaign(), AssimilationSettings(what_if=False, emulator="off", refine="none")
    groups = tuple({"a": "", "b": ("gel 1", "gel-1")[e % 2]} for e in range(SETS))
    found = estimate_jointly(JointProblem(tuple(problems), groups), settings, 3)
    save_joint(tmp_path / "joint.nc", found, [np.zeros((3, 3))] * SETS, {})
    stored = load_joint(tmp_path / "joint.nc")
    assert stored.shared == ("a", "b_gel_1", "b_gel_1_2")
    for j, name in enumerate(stored.shared):
        np.testing.assert_array_equal(stored.group("posterior")[name].values[0], found.shared[:, j])
