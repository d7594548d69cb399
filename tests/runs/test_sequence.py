"""A sequence: a data file assimilated cycle by cycle, from YAML and from Python, its files, its faults, resumed."""

from __future__ import annotations

import sys
from copy import deepcopy
from pathlib import Path

import drift_series
import numpy as np
import pytest
import xarray as xr
import yaml
from drift_series import STD, TIMES, VALUES
from linear_drift import Drift

import en4dvar
from en4dvar.assembly.build import build_sequence
from en4dvar.config import load_sequence, load_twin
from en4dvar.data.noise import noise_of
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.priors.prior import PriorTerm
from en4dvar.runs.checks import validate
from en4dvar.runs.cycles import run_sequence
from en4dvar.runs.interrupt import Interrupted
from en4dvar.schemes.ienks import IEnKS
from en4dvar.series.problem import assimilate_series
from en4dvar.series.twin import conduct
from en4dvar_lorenz import Lorenz96
from en4dvar_lorenz.lorenz96 import Lorenz96Settings

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
folder = drift_series.folder
RATES = 0.2**2 / 0.5, 0.1**2 / 2  # variances of x and c in a unit of time
WALK = {"c": {"prior": "normal", "mean": 0.5, "std": 0.3, "varies": {"std": 0.1, "every": 2}}}
BASE = drift_series.BASE | {"parameters": WALK}


def written(folder, **changes):
    content = {**BASE, **changes}
    (folder / "drift.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return folder / "drift.yaml"


def kalman():
    """Filtered moments after each reading, and smoothed ones (Rauch–Tung–Striebel), written out."""
    used = np.isfinite(VALUES)
    mean, cov, found, ahead = np.array([0.0, 0.5]), np.diag([0.25, 0.09]), [], []
    for dt, y in zip(np.diff(TIMES[used], prepend=0.0), VALUES[used], strict=True):
        m = np.array([[1.0, dt], [0.0, 1.0]])
        mean, cov = m @ mean, m @ cov @ m.T + np.diag(RATES) * dt
        ahead.append((mean, cov, m))
        gain = cov[:, 0] / (cov[0, 0] + STD**2)
        mean, cov = mean + gain * (y - mean[0]), cov - np.outer(gain, cov[0])
        found.append((mean, cov))
    smoothed = [found[-1]]
    for (f, p), (g, q, m) in zip(found[-2::-1], ahead[:0:-1], strict=True):
        gain = p @ m.T @ np.linalg.inv(q)
        s, c = smoothed[0]
        smoothed.insert(0, (f + gain @ (s - g), p + gain @ (c - q) @ gain.T))
    return found, smoothed


def check(moments, expected):
    assert moments.mean == pytest.approx(np.array([m for m, _ in expected]), abs=1e-10)
    assert moments.std == pytest.approx(np.array([np.sqrt(np.diag(c)) for _, c in expected]), abs=1e-10)


@pytest.mark.parametrize("additive", ["drawn", "square-root"])
def test_a_file_with_a_gap_is_the_kalman_filter(folder, additive):
    result = run_sequence(written(folder, assimilation={"scheme": "etkf", "members": 8, "additive": additive}))
    check(result.run.analysis, kalman()[0])
    with xr.open_dataset("runs/drift/sequence.nc") as data:
        assert data["analysis_mean"].values == pytest.approx(result.run.analysis.mean)
        assert data["members"].shape == (1, 8, 2)
        assert np.cov(data["members"].values[0].T) == pytest.approx(kalman()[0][-1][1], abs=1e-10)
    assert "c,0." in Path("runs/drift/summary.csv").read_text()


@pytest.mark.parametrize("rho", [0.5, -0.8])
def test_two_series_with_correlated_errors_are_the_kalman_filter(folder, rho):
    """R is [[σ², ρσσ'], [ρσσ', σ'²]] where both are read, σ² where one is."""
    other = 0.25
    twice = {"x": (VALUES, STD), "again": (0.9 * VALUES[::-1], other)}
    for name, (values, _) in twice.items():
        rows = "".join(f"{t},{v}\n" for t, v in zip(TIMES, values, strict=True) if np.isfinite(v))
        Path(f"{name}.csv").write_text(f"t,x\n{rows}")
    columns = BASE["data"]["columns"]
    series = {
        name: {"path": f"{name}.csv", "columns": deepcopy(columns), "observable": "x", "error": {"x_std": std}}
        for name, (_, std) in twice.items()
    }
    data = {"name": "drift", "series": series, "correlation": {"x": {"again": rho}}}
    result = run_sequence(written(folder, data=data, assimilation={"scheme": "etkf", "members": 8}))
    r = np.array([[STD**2, rho * STD * other], [rho * STD * other, other**2]])
    mean, cov, expected = np.array([0.0, 0.5]), np.diag([0.25, 0.09]), []
    both = np.column_stack([values for values, _ in twice.values()])
    for dt, y in zip(np.diff(TIMES, prepend=0.0), both, strict=True):
        m = np.array([[1.0, dt], [0.0, 1.0]])
        mean, cov = m @ mean, m @ cov @ m.T + np.diag(RATES) * dt
        read = np.isfinite(y)
        h = np.array([[1.0, 0.0], [1.0, 0.0]])[read]
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r[np.ix_(read, read)])
        mean, cov = mean + gain @ (y[read] - h @ mean), cov - gain @ h @ cov
        expected.append((mean, cov))
    check(result.run.analysis, expected)


@pytest.mark.parametrize("more", [{"lag": 9}, {"lag": 9, "mda_weights": [1.0] * 9}, {"lag": 8, "shift": 3}], ids=str)
def test_a_file_is_smoothed_as_by_rauch_tung_and_striebel(folder, more):
    result = run_sequence(written(folder, assimilation={"scheme": "ienks", "members": 32, **more}))
    check(result.run.smoothed, kalman()[1])


def test_arrays_and_series_objects_give_the_same_bits(folder):
    whole = run_sequence(written(folder))
    asked = {key: BASE[key] for key in ("model_error", "assimilation")}
    of_arrays = en4dvar.estimate_sequence(
        Drift(), (TIMES, VALUES), BASE["parameters"], error=STD, initial_std={"x": 0.5}, seed=3, **asked
    )
    used = np.isfinite(VALUES)
    series = en4dvar.Series(Drift.observables[0], TIMES[used], VALUES[used], noise_of(np.full(used.sum(), STD)))
    model = Drift()
    prior = en4dvar.Prior((PriorTerm.normal(model.parameters[0], 0.5, 0.3),))
    problem = en4dvar.SeriesProblem.of_series(
        en4dvar.InitialEnsemble(model, {"x": 0.5}, prior),
        [series],
        build_sequence(load_sequence("drift.yaml")).settings,
        8,
    )
    by_hand = assimilate_series(problem, 3)
    for other in (of_arrays, by_hand):
        assert np.array_equal(other.run.analysis.mean, whole.run.analysis.mean)
        assert np.array_equal(other.run.ranks, whole.run.ranks)


def test_parameters_move_in_the_coordinate_of_their_prior(folder):
    """A lognormal rate stays positive where readings fall; its logarithm is what is Gaussian."""
    (folder / "drift.csv").write_text("t,x\n" + "".join(f"{t},{-2 * t}\n" for t in TIMES))
    changes = {
        "parameters": {"c": {"prior": "lognormal", "median": 0.5, "log_std": 0.5}},
        "sequence": {"initial_std": {"x": 0.5}, "members_every": 2},
    }
    result = run_sequence(written(folder, model_error=None, **changes))
    assert [k for k, _ in result.run.kept] == [1, 3, 5, 6]
    assert all((members[:, 1] > 0).all() for _, members in result.run.kept)
    assert result.warnings[0].startswith("innovations are")


def test_interrupted_and_resumed_to_the_same_bits(folder):
    scheme = {"scheme": "ienks", "members": 20, "lag": 2, "rotation": True, "inflation": 1.1}
    path = written(folder, assimilation=scheme, execution={"checkpoint_every": 0})
    quiet = run_sequence(path, overrides={"output.directory": "quiet"})

    def stop(cycle):
        if cycle == 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="are kept in"):
        run_sequence(path, on_cycle=stop)
    seen = []
    again = run_sequence(path, resume=True, on_cycle=seen.append)
    assert seen == [3, 4, 5]
    assert np.array_equal(again.run.members, quiet.run.members)
    with xr.open_dataset("quiet/sequence.nc") as a, xr.open_dataset("runs/drift/sequence.nc") as b:
        for name in a.data_vars:
            assert a[name].values.tobytes() == b[name].values.tobytes(), name


def with_error(key, value):
    return {"data": {**BASE["data"], "error": {"x_std": STD, key: value}}}


SCHEME = BASE["assimilation"]


@pytest.mark.parametrize(
    ("changes", "place", "message"),
    [
        (with_error("time_std", 0.1), "data.error.time_std", "not in a sequence"),
        (with_error("correlation_time", 1), "data.error.correlation_time", "not in a sequence"),
        ({"sequence": {"initial_std": {"y": 1}}}, "sequence.initial_std.y", "unknown key"),
        ({"sequence": {"initial_std": {"x": -1}}}, "sequence.initial_std.x", "must be positive"),
        ({"sequence": {"positive": ["y"]}}, "sequence.positive", "unknown field 'y'"),
        ({"sequence": {"initial_std": {"x": 1}, "positive": ["x"]}, "model_error": None}, "sequence.initial_std.x",
         "in %"),
        ({"sequence": {"members_every": -1}}, "sequence.members_every", "greater than or equal to 0"),
        ({"sequence": {"burn_in": 1}}, "sequence.burn_in", "unknown key"),
        ({"sequence": {}, "parameters": {"c": 1}, "model_error": None}, "sequence", "nothing is uncertain"),
        ({"model_error": {"x": {"std": 0.1, "at": [1]}}}, "model_error.x", "give every"),
        ({"model_error": {"x": {"std": "10 %", "every": 1}}}, "model_error.x.std", "initial_std in % as well"),
        ({"model_error": {"x": {"std": 0, "every": 1}}}, "model_error.x.std", "must be positive"),
        ({"model_error": {"z": {"std": 1, "every": 1}}}, "model_error.z", "unknown field"),
        ({"parameters": {"c": {**BASE["parameters"]["c"], "varies": {"std": 0.1, "at": [1]}}}}, "parameters.c.varies",
         "give every"),
        ({"parameters": {"c": {**BASE["parameters"]["c"], "varies": {"std": "estimated", "every": 1}}}}, "parameters.c",
         "does not estimate the std"),
        ({"parameters": {"c": {**BASE["parameters"]["c"], "mean": 0, "varies": {"std": "10 %", "every": 1}}}},
         "parameters.c.varies.std", "relative to the mean, which is zero"),
        ({"parameters": {"c": {**BASE["parameters"]["c"], "shared": "all"}}}, "parameters.c.shared",
         "a sequence estimates no data sets together"),
        ({"parameters": {"c": 1, "t_s": {"prior": "normal", "mean": 0, "std": 1}}}, "parameters.t_s", "time shift"),
        ({"model": {"name": "lorenz63", "steps": 3}}, "model.steps", "unknown key"),
        ({"assimilation": {**SCHEME, "additive": "root"}}, "assimilation.additive", "not one of drawn, square-root"),
        ({"assimilation": {**SCHEME, "scheme": "ienks", "additive": "square-root"}}, "assimilation.additive",
         "for filters"),
        ({"assimilation": {**SCHEME, "scheme": "etkf", "additive": "square-root", "smoother": {"method": "enks"}}},
         "assimilation.additive", "use enrts, or drawn"),
        ({"assimilation": {**SCHEME, "scheme": "ienks", "shift": 2}}, "assimilation", "only 1 long"),
        ({"assimilation": {**SCHEME, "scheme": "ienks", "shift": 0}}, "assimilation.shift", "greater than"),
        ({"assimilation": {**SCHEME, "scheme": "ienks", "lag": 3, "mda_weights": [1, 1]}}, "assimilation", "are 3"),
        ({"assimilation": {**SCHEME, "scheme": "ienks", "mda_weights": [0]}}, "assimilation.mda_weights", "than 0"),
        ({"assimilation": {**SCHEME, "mda_weights": [1, 1]}}, "assimilation.mda_weights", "a key of ienks"),
        ({"sequence": {"initial_std": {"x": 0.5}, "positive": "x"}}, "sequence.positive", "expected a list"),
        ({"assimilation": {**SCHEME, "localisation": {"radius": 2}}}, "assimilation.localisation", "data.places"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_one_located_message(folder, changes, place, message):
    path = written(folder, **changes)
    with pytest.raises(ConfigError, match=message) as error:
        validate(path)
    (fault,) = error.value.problems
    assert fault.path.startswith(place)
    assert fault.line > 0


def test_a_model_without_step_and_several_files(folder):
    (folder / "still.py").write_text(
        "import numpy as np\nfrom linear_drift import Drift\nfrom en4dvar import ForwardModel\n\n\n"
        "class Still(Drift):\n    step = ForwardModel.step\n    def trajectories(self, x, times):\n        return []\n"
    )
    plain = {"parameters": {"c": 1}}
    with pytest.raises(ConfigError, match="has no step"):
        validate(written(folder, model={"name": "./still.py:Still"}, **plain))
    (folder / "more.csv").write_text((folder / "drift.csv").read_text())
    with pytest.raises(ConfigError, match=r"data\.path: a sequence is one data set, but there are 2"):
        validate(written(folder, data={**BASE["data"], "path": "*.csv"}))
    sys.modules.pop("still", None)


def test_other_commands_say_what_it_is(folder):
    path = written(folder)
    with pytest.raises(ConfigError, match="sequence: it makes the file a sequence, for 'en4dvar run'"):
        en4dvar.load_config(path)
    with pytest.raises(ConfigError, match="it makes the file a twin experiment"):
        load_sequence(CONFIGS / "linear_etkf.yaml")
    with pytest.raises(DataError):
        run_sequence(written(folder, data={**BASE["data"], "path": "none.csv"}))


@pytest.mark.slow
def test_report_of_a_sequence(folder):
    result = run_sequence(written(folder, assimilation={"scheme": "ienks", "members": 20, "lag": 2},
                                  output={"report": True, "figures": True}))  # fmt: skip
    page = Path("runs/drift/report.html").read_text()
    assert {file.stem for file in Path("runs/drift/figures").glob("*.png")} == {
        "state", "parameters", "innovations", "ranks",
    }  # fmt: skip
    assert f"{result.run.forward_runs}</strong>" in page
    en4dvar.write_report("runs/drift", figures=True)
    assert Path("runs/drift/report.html").read_text() == page


def test_repeated_assimilation_in_a_twin():
    """Lorenz-63, a window of five: the smoother that assimilates each observation five times follows the truth."""
    changes = {"twin.cycles": 120, "twin.burn_in": 20, "assimilation.lag": 5, "twin.interval": 0.1}
    once = load_twin(CONFIGS / "lorenz63_ienks.yaml", changes)
    often = load_twin(CONFIGS / "lorenz63_ienks.yaml", {**changes, "assimilation.mda_weights": [1] * 5})
    assert often.experiment.sequential.scheme == IEnKS(5, mda_weights=(1,) * 5)
    scores = [conduct(c.experiment, 1).scores for c in (once, often)]
    for kind in ("analysis", "smoothed"):
        a, b = (score[kind].mean_rmse for score in scores)
        assert b < 1.15 * a < 1.0


def test_model_error_in_a_twin():
    """The truth errs as the members' model does: an ensemble that knows it has the spread of its errors."""
    changes = {"twin.cycles": 300, "twin.burn_in": 50, "model_error": {"x": {"std": 0.3, "every": 0.3}}}
    known = conduct((config := load_twin(CONFIGS / "linear_etkf.yaml", changes)).experiment, config.seed)
    score = known.scores["analysis"]
    assert score.mean_spread == pytest.approx(score.mean_rmse, rel=0.1)
    assert np.abs(np.nanmean(known.run.ranks) - 0.5) < 0.03


@pytest.mark.slow
def test_a_field_read_at_places_is_localised(folder):
    """Lorenz-96, every second variable, 15 members: with a taper filter and smoother follow it, without it is lost."""
    model = Lorenz96.from_settings(Lorenz96Settings())
    start = model.trajectories(model.initial_state({"F": 8.0})[None], np.array([20.0]))[0].states
    times, noise = 0.1 * np.arange(1, 81), np.random.default_rng(0)
    truth = model.trajectories(start, times)[0].states[:, :40]
    rows = [(t, c, x[c] + noise.standard_normal()) for t, x in zip(times, truth, strict=True) for c in range(0, 40, 2)]
    Path("field.csv").write_text("t,cell,x\n" + "".join(f"{t:.3f},{c},{x:.4f}\n" for t, c, x in rows))
    data = {**BASE["data"], "path": "field.csv", "places": {"column": "cell"}, "error": {"x_std": 1}}
    errors = []
    local = {"radius": 4, "periodic": True}
    for scheme in ({"scheme": "etkf"}, {"scheme": "ienks", "lag": 2}, {"scheme": "etkf", "localisation": None}):
        asked = {"members": 15, "inflation": 1.04, "localisation": local, **scheme}
        changes = {"model": {"name": "lorenz96"}, "parameters": None, "model_error": None, "data": data}
        path = written(folder, **changes, assimilation=asked, sequence={"initial_std": {"x": 4}})
        run = assimilate_series(build_sequence(load_sequence(path)), 0).run
        for moments in (run.analysis, run.smoothed) if "lag" in scheme else (run.analysis,):
            errors.append(np.sqrt(np.mean((moments.mean[50:, :40] - truth[50:]) ** 2)))
    filtered, analysed, smoothed, lost = errors
    assert smoothed < min(filtered, analysed)
    assert max(filtered, analysed) < 0.75
    assert lost > 2


@pytest.mark.slow
def test_the_bubble_in_time():
    """A_E2_002 (not shipped): without model error the end of the series is the posterior of all of it."""
    path = CONFIGS / "bubble_sequence.yaml"
    config = load_sequence(path)
    (file,) = config.data.series[0].data.path
    if not Path(file).is_file():
        pytest.skip("A_E2_002.mat is not here")
    plain = {"data.error.radius_std": "1 % of maximum", "model_error": {}, "sequence.positive": []}
    found = []
    for given in (config, load_sequence(path, plain)):
        result = assimilate_series(build_sequence(given), given.seed)
        where = result.problem.start.model.layout["mu"].start
        moments = result.run.analysis
        found.append((moments.mean[-1, where], moments.std[-1, where], np.sqrt(np.mean(result.normalised**2))))
    (erring, wide, size), (mu, narrow, _) = found
    assert mu == pytest.approx(0.0848, abs=0.004)  # of a long Markov chain on the same readings
    assert 3 * narrow < wide
    assert 0.8 < size < 1.2
    assert abs(erring - 0.118) < 3 * wide  # published: 0.118 ± 0.015
