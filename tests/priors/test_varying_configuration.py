"""``varies:`` in a configuration: knots, standard deviations, and what is refused with its place in the file."""

from __future__ import annotations

import netCDF4
import numpy as np
import pytest
import xarray as xr
import yaml
from run_files import assert_same_results, configuration, make_campaign
from toy_config import csv_text, write_toy

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.descent.preview import preview
from en4dvar.plumbing.caution import caution
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.figures import bands as varying_figure
from en4dvar.report.figures import stored_walks
from en4dvar.report.page import render_set
from en4dvar.report.result import load_result
from en4dvar.results.pack import PACK
from en4dvar.runs.checks import validate
from en4dvar.runs.engine import write_report
from en4dvar.runs.runner import run, run_campaign
from en4dvar.schemes.settings import AssimilationSettings

K = "k: {prior: lognormal, median: 3 N/m, log_std: 0.3}"


def varying(folder, varies="{every: 40 ms, std: 20 %}", prior=K, **options):
    return write_toy(folder, (K, prior[:-1] + f", varies: {varies}}}"), **options)


def walk_of(path, **overrides):
    (problem,) = build(load_config(path, overrides))
    (walk,) = problem.varying
    return problem, walk


def test_knots_and_standard_deviations(tmp_path):
    problem, walk = walk_of(varying(tmp_path))  # readings every 5 ms until 150 ms
    assert walk.knots == pytest.approx([0.04, 0.08, 0.12])
    assert problem.prior.names == ("A", "k", "k_change_1", "k_change_2", "k_change_3")
    assert problem.prior.std[2:] == pytest.approx([0.2] * 3)
    assert problem.constant.prior.names == ("A", "k")
    assert problem.constant.varying == ()
    assert problem.constant.model is problem.model.model
    _, walk = walk_of(varying(tmp_path, "{at: [10 ms, 0.05 s], std: 0.6 N/m}"))
    assert walk.knots == pytest.approx([0.01, 0.05])
    assert walk.changes[0].std == pytest.approx(0.2)  # of ln k, at the median
    _, walk = walk_of(varying(tmp_path, "{at: [10 ms], std: 0.6 N/m}", "k: {prior: normal, mean: 3 N/m, std: 1 N/m}"))
    assert walk.changes[0].std == pytest.approx(0.6)
    assert walk.changes[0].parameter.unit == "N/m"
    logit = "k: {prior: logit, lower: 1 N/m, upper: 5 N/m, median: 2 N/m, logit_std: 1}"
    _, walk = walk_of(varying(tmp_path, "{at: [10 ms], std: 10 %}", logit))
    h = 1e-6  # 0.2 N/m about the median
    slope = float(np.diff(walk.first.to_physical(walk.first.mean + np.array([-h, h])))[0]) / (2 * h)
    assert walk.changes[0].std * slope == pytest.approx(0.2)


def test_a_standard_deviation_that_is_estimated(tmp_path):
    path = varying(tmp_path, "{at: [40 ms, 80 ms], std: estimated}", data=halved())
    problem, walk = walk_of(path, **{"assimilation.members": 24})
    assert problem.prior.names == ("A", "k", "k_change_std", "k_change_1", "k_change_2")
    assert [(t.transform, t.shape) for t in walk.terms[:1]] == [("half-normal", (0.5,))]
    assert [(t.std, t.parameter.unit) for t in walk.changes] == [(1.0, "1")] * 2
    assert problem.constant.prior.names == ("A", "k")
    prior = "k: {prior: normal, mean: 3 N/m, std: 1 N/m}"
    _, of_normal = walk_of(varying(tmp_path, "{at: [40 ms], std: estimated}", prior))
    assert (of_normal.spread.shape, of_normal.spread.parameter.unit) == ((1.5,), "N/m")
    theta = {"k": np.array([2.0]), "k_change_std": np.array([0.5]), "k_change_1": np.array([1.0]),
             "k_change_2": np.array([-2.0])}  # fmt: skip
    np.testing.assert_allclose(walk.pieces(theta), [[2.0, 2.0 * np.exp(0.5), 2.0 * np.exp(-0.5)]], rtol=1e-14)


@pytest.mark.parametrize(
    ("varies", "words"),
    [
        ("{std: 20 %}", r"14:\d+: parameters\.k\.varies: give either every .* or at"),
        ("{every: 40 ms, at: [10 ms], std: 20 %}", r"14:\d+: parameters\.k\.varies: give either every .* or at"),
        ("{every: 40 ms}", r"14:\d+: parameters\.k\.varies\.std: required, but not given"),
        ("{every: 0 ms, std: 20 %}", r"14:\d+: parameters\.k\.varies\.every: must be positive"),
        ("{every: 40, std: 20 %}", r"14:\d+: parameters\.k\.varies\.every: 40 has no unit"),
        ("{every: 200 ms, std: 20 %}", r"14:\d+: parameters\.k\.varies\.every: the last observation comes before"),
        ("{every: 1 ns, std: 20 %}", r"14:\d+: parameters\.k\.varies\.every: more than 1000 pieces"),
        ("{every: 10 ms, std: 20 %}", r"17:\d+: assimilation\.members: 8 are too few for 16 parameters"),
        ("{at: [10 ms, 10 ms], std: 20 %}", r"14:\d+: parameters\.k\.varies\.at: .* each later than the one before"),
        ("{at: [], std: 20 %}", r"14:\d+: parameters\.k\.varies\.at: give at least one knot"),
        ("{at: [-1 ms], std: 20 %}", r"14:\d+: parameters\.k\.varies\.at.*: must be positive"),
        ("{at: [1 s], std: 20 %}", r"14:\d+: parameters\.k\.varies\.at: all knots lie after the last observation"),
        ("{every: 40 ms, std: 0 %}", r"14:\d+: parameters\.k\.varies\.std: must be positive"),
        ("{evry: 40 ms, std: 20 %}", r"14:\d+: parameters\.k\.varies\.evry: unknown key 'evry'; did you mean 'every'"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, varies, words):
    with pytest.raises(ConfigError, match=rf"toy\.yaml:{words}"):
        build(load_config(varying(tmp_path, varies)))


def test_parameters_that_cannot_vary(tmp_path):
    path = write_toy(tmp_path, ("std: 1 %}", "std: 1 %, varies: {every: 40 ms, std: 1 %}}"))
    with pytest.raises(
        ConfigError, match=r"toy\.yaml:13:\d+: parameters\.A\.varies: A cannot vary: the state .* no field"
    ):
        load_config(path)
    path = write_toy(tmp_path, ("c: 0.02 N s/m", "c: 0.02 N s/m\n  t_s: {prior: normal, mean: 0 s, std: 1 ms, "
                                                 "varies: {every: 40 ms, std: 1 ms}}"))  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"toy\.yaml:16:\d+: parameters\.t_s\.varies: t_s cannot vary: it is no param"
    ):
        load_config(path)
    mean = "k: {prior: normal, mean: 0 N/m, std: 1 N/m}"
    with pytest.raises(ConfigError, match=r"toy\.yaml:14:\d+: parameters\.k\.varies\.std: relative to the mean"):
        build(load_config(varying(tmp_path, prior=mean)))


def with_error(folder, section):
    return write_toy(folder, ("assimilation:\n", f"model_error:\n  {section}\nassimilation:\n"))


def test_model_error(tmp_path):
    (problem,) = build(load_config(with_error(tmp_path, "v: {every: 60 ms, std: 1 mm/s}")))
    assert problem.prior.names == ("A", "k", "v_change_1", "v_change_2")
    assert problem.prior.std[2:] == pytest.approx([1e-3] * 2)
    assert problem.walks == ()
    assert problem.constant.prior.names == ("A", "k")
    (problem,) = build(load_config(with_error(tmp_path, "x: {at: [0.1 s], std: 2 %}")))
    assert [one.parameter.label for one in problem.prior.terms][-1] == "model error: change of ln x at 0.1 s"
    assert problem.prior.std[-1] == 0.02


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("y: {every: 60 ms, std: 1 mm}", r"17:3: model_error\.y: unknown field 'y' of the state"),
        ("k: {every: 60 ms, std: 1 %}", r"17:3: model_error\.k: k is a parameter: write varies behind its prior"),
        ("x: {std: 1 mm}", r"17:\d+: model_error\.x: give either every"),
        ("x: {every: 60 ms, std: 1 s}", r"17:\d+: model_error\.x\.std: "),
        ("x: {at: [1 s], std: 1 mm}", r"17:\d+: model_error\.x\.at: all knots lie after the last observation"),
    ],
)
def test_what_is_wrong_with_a_model_error(tmp_path, section, words):
    with pytest.raises(ConfigError, match=rf"toy\.yaml:{words}"):
        build(load_config(with_error(tmp_path, section)))


@pytest.mark.slow
def test_a_run_with_a_model_error(tmp_path):
    path = with_error(tmp_path, "v: {at: [80 ms], std: 1 m/s}")
    out = tmp_path / "out"
    run(load_config(path, {"output.directory": str(out)}))
    result = load_result(out / "posterior.nc")
    assert "v_change_1" in result.posterior
    assert stored_walks(result) == ()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "What varies in time" in page
    assert "v of the state: the data " in page
    assert not (out / "varying.csv").exists()


BUBBLE = """\
name: bubble
model: {name: bubble, start: laser, law: neo-hookean-kelvin-voigt}
parameters:
  G: {prior: lognormal, median: 4 kPa, log_std: 0.3}
  mu: 0.06 Pa s
  R_eq: 35 um
  R_max: {prior: normal, mean: 250 um, std: 5 um, varies: {every: 10 us, std: 1 %}}
"""


def test_what_acts_at_the_start_alone_cannot_vary(tmp_path):
    (tmp_path / "b.yaml").write_text(BUBBLE)
    with pytest.raises(
        ConfigError, match=r"b\.yaml:7:\d+: parameters\.R_max\.varies: R_max cannot vary: .*start alone.* G, mu"
    ):
        load_config(tmp_path / "b.yaml")


def halved(n=31):
    """An oscillation whose stiffness falls from 2 to 1.2 N/m at 80 ms."""
    t, m, c = np.arange(n) * 5e-3, 2e-3, 0.02
    x, v, now, rows = 100.0, 0.0, 0.0, []
    for at in t:
        for end in sorted({0.08, at}) if now < 0.08 < at else [at]:
            k, a = (2.0 if end <= 0.08 else 1.2), c / (2 * m)
            w, dt = np.sqrt(k / m - a**2), end - now
            cosine, sine, decay = np.cos(w * dt), np.sin(w * dt) / w, np.exp(-a * dt)
            x, v = decay * (x * cosine + (v + a * x) * sine), decay * (v * cosine - (a * v + (a**2 + w**2) * x) * sine)
            now = end
        rows.append(f"{1e3 * at:.6g},{x:.9g}\n")
    return "t_ms,x_um\n" + "".join(rows)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with a stiffness that falls, and its directory."""
    folder = tmp_path_factory.mktemp("varying")
    path = varying(folder, "{at: [40 ms, 80 ms], std: 40 %}", data=halved())
    out = folder / "out"
    run(load_config(path, {"output.directory": str(out), "output.report": False, "assimilation.members": 24}))
    return out


def test_pieces_in_the_file(finished):
    result = load_result(finished / "posterior.nc")
    pieces = result.dataset("posterior")["k_pieces"]
    assert pieces.dims == ("chain", "draw", "k_piece")
    assert pieces["k_piece"].values == pytest.approx([0.0, 0.04, 0.08])
    assert pieces.attrs["units"] == "N/m"
    assert pieces.values[0, :, 0] == pytest.approx(result.posterior["k"].values[0])
    assert list(result.posterior.data_vars) == ["A", "k", "k_change_1", "k_change_2"]
    walked = result.posterior["k"] * np.exp(result.posterior["k_change_1"] + result.posterior["k_change_2"])
    assert pieces.values[0, :, 2] == pytest.approx(walked.values[0])
    off = pieces.mean(("chain", "draw")) - np.array([2.0, 2.0, 1.2])
    assert np.all(np.abs(off) < 2 * pieces.std(("chain", "draw")))
    # data without noise have residuals of a structure: no interval would stand
    (walk,) = stored_walks(result.with_attributes("/", warnings=""))
    assert walk.edges == pytest.approx([0.0, 0.04, 0.08, 0.15])
    assert np.all(np.diff(walk.posterior, axis=0) > 0)
    assert result.sample_stats.attrs["log_evidence_change"] > 3
    assert "Stiffness: the data speak for a change" in render_set(result, [])


def test_pieces_of_each_data_set_of_a_campaign_begin_at_knots_of_its_own(tmp_path):
    """The highest readings of two oscillations, 200 ms and 165 ms from their beginnings."""
    path = varying(tmp_path, "{at: maxima, std: 40 %}", data=csv_text(61))
    (tmp_path / "toy_2.csv").write_text(csv_text(61, k=3.0))
    few = {"members": 4, "max_iterations": 1, "what_if": False, "refine": "none"}
    few = {f"assimilation.{key}": value for key, value in few.items()} | {"output.report": False}
    run_campaign(load_config(path, {**few, "data.path": "toy*.csv", "output.directory": str(tmp_path / "out")}))
    with netCDF4.Dataset(tmp_path / "out" / "posterior.nc") as file:
        file.set_auto_mask(False)
        posterior = file["posterior"]
        assert posterior["k_piece"][:] == pytest.approx(np.array([[0.0, 0.2], [0.0, 0.165]]))
        assert posterior["k_pieces"].dimensions == ("dataset", "chain", "draw", "k_piece_number")


def test_pieces_of_what_is_not_to_be_trusted_have_no_interval(finished):
    warned = caution("at-bound", "piles up", parameters=("k",)).line
    result = load_result(finished / "posterior.nc").with_attributes("/", warnings=warned)
    (walk,) = stored_walks(result)
    assert np.isnan(walk.posterior[[0, 2]]).all()
    assert np.isfinite(walk.posterior[1]).all()
    assert len(varying_figure(result).rows) == 1
    assert "not to be trusted: at bound" in render_set(result, [])


@pytest.mark.slow
def test_pieces_in_the_report(finished):
    write_report(finished, figures=True)
    page = (finished / "report.html").read_text(encoding="utf-8")
    assert "What varies in time" in page
    assert (finished / "figures" / "varying.png").is_file()
    lines = (finished / "varying.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("dataset,parameter,time_unit,begin,end,unit,q05,q50,q95")
    assert len(lines) == 4


@pytest.mark.slow
def test_a_campaign_of_windows_of_different_length_with_any_executor(tmp_path):
    path = make_campaign(tmp_path, 2)
    text = path.read_text().replace(K, K[:-1] + ", varies: {every: 40 ms, std: 20 %}}")
    path.write_text(text)
    (tmp_path / "data" / "set0.csv").write_text(csv_text(20))  # two knots instead of three
    for kind in ("serial", "processes"):
        assert run_campaign(configuration(path, tmp_path / kind, executor=kind, workers=2)).exit_code == 0
        assert_same_results(tmp_path / kind, tmp_path / "serial")
    with xr.open_datatree(tmp_path / "serial" / "posterior.nc") as tree:
        posterior, centre = tree["posterior"], tree["sample_stats"]["centre"]
        lost = posterior["k_pieces"].isnull().any(("chain", "draw"))
        assert lost.values.tolist() == [[False] * 3 + [True], [False] * 4]
        assert posterior["k_change_3"].isel(dataset=0).isnull().all()
        for i in range(2):
            own = load_result(tmp_path / "serial" / PACK / f"set{i}").sample_stats["centre"]
            assert np.array_equal(centre.isel(dataset=i).sel(parameter=own["parameter"]), own)


def test_resolved_configuration_and_validate(tmp_path):
    path = varying(tmp_path)
    config = load_config(path)
    assert yaml.safe_load(config.resolved)["parameters"]["k"]["varies"] == {"every": "40 ms", "std": "20 %"}
    again = tmp_path / "again.yaml"
    again.write_text(config.resolved)
    assert walk_of(again)[1] == walk_of(path)[1]
    assert validate(path) is not None


def test_a_preview_counts_the_second_fit(tmp_path):
    problem, _ = walk_of(varying(tmp_path))
    varied, constant = (preview(p, AssimilationSettings(members=24), 1).runs for p in (problem, problem.constant))
    assert varied > 2 * constant
