"""Every configuration that ships runs; those on measured data where the workshop folder ``../shared/data`` is
present.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import en4dvar
from en4dvar.results.together import load_joint
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import join
from en4dvar_diffusion.synthetic import truth

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"


def run(name, out, **overrides):
    return en4dvar.run(ROOT / "configs" / f"{name}.yaml", overrides={"output.directory": str(out), **overrides})


def on_file(name, file, out):
    path = DATA / file
    if not path.exists():
        pytest.skip(f"measured data not present: {path}")
    return run(name, out, **{"data.path": [str(path)]})


def mean_and_std(result, name):
    values = result.posterior[name].values
    return float(values.mean()), float(values.std(ddof=1))


def test_quickstart_recovers_the_synthetic_gel(tmp_path):
    result = run("quickstart", tmp_path)
    scores = result.sample_stats.attrs
    assert scores["converged"] == 1
    assert scores["n_active"] == 48
    assert scores["nrmse"] > 0.94
    truth = {"G": 420.0, "alpha": 0.029, "mu": 0.086, "R0": 0.43e-6, "t_s": 0.25e-6}
    for name, value in truth.items():
        mean, std = mean_and_std(result, name)
        assert abs(mean - value) < 2.5 * std, name
    for file in ("posterior.nc", "report.html", "summary.csv", "config.yaml", "config.resolved.yaml", "run.log"):
        assert (tmp_path / file).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shell", "shell_heard"])
def test_the_coating_of_a_microbubble(name, tmp_path):
    """Filmed, or heard by a hydrophone of which neither sensitivity nor distance are known."""
    result = run(name, tmp_path, **{"output.report": False, "assimilation.what_if": False})
    assert not any(c.spoils for c in result.cautions)
    truth = {"chi": 0.7, "kappa_s": 6e-9, "sigma_0": 12e-3, "R0": 2.1e-6}
    for parameter, value in truth.items():
        mean, std = mean_and_std(result, parameter)
        assert abs(mean - value) < 2.5 * std, parameter
    assert mean_and_std(result, "kappa_s")[1] < 0.04 * truth["kappa_s"]


def test_a_known_gel_calibrates_the_pulse(tmp_path):
    """Each knot within its interval, and three to ten times better known than before."""
    result = run("pulse_in_gel", tmp_path, **{"output.report": False, "assimilation.what_if": False})
    assert not any(c.spoils for c in result.cautions)
    for number, value in enumerate((-0.12, -0.23, -0.17, -0.01, 0.16, 0.14, -0.02, -0.13), 1):
        mean, std = mean_and_std(result, f"pulse_knot_{number}")
        assert abs(mean - value) < 2.5 * std, number
        assert std < 0.15 / 3, number


@pytest.mark.slow
def test_predator_and_prey_observed_together(tmp_path):
    """Within half of a standard deviation of Carpenter's posterior of the same data, and of spreads like his."""
    result = run("predator_prey", tmp_path, **{"output.report": False})
    assert [axis.name for axis in result.axes] == ["ln_prey", "ln_predator"]
    assert not any(c.spoils for c in result.cautions)
    his = {"alpha": (0.55, 0.06), "beta": (0.028, 0.004), "gamma": (0.80, 0.09), "delta": (0.024, 0.004),
           "prey_0": (33.9, 2.9), "predator_0": (5.9, 0.5)}  # fmt: skip
    for name, (value, spread) in his.items():
        mean, std = mean_and_std(result, name)
        assert abs(mean - value) < 0.5 * spread, name
        assert 0.7 < std / spread < 1.4, name


@pytest.mark.slow
def test_a_field_from_heads(tmp_path):
    """Few members and iterations; docs/fields.md tells of the whole run."""
    few = {"output.report": False, "assimilation.members": 15, "assimilation.max_iterations": 3}
    result = run("diffusion_field", tmp_path, **few)
    fields, exact = result.dataset("fields"), truth()
    error = np.sqrt(np.mean((fields["ln_T_mean"].values - exact) ** 2))
    assert error < 0.8 * np.sqrt(np.mean(exact**2))
    assert np.sqrt(np.mean(fields["ln_T_std"].values ** 2)) > 0.8 * error


@pytest.mark.slow
def test_laser_bubbles_calibrate_the_pulse_of_driven_ones(tmp_path):
    """Two of each: the pulse of -26 MPa, stated as -24 ± 2.4 MPa; docs/joint.md has all."""
    quick = {"output.report": False, "assimilation.what_if": False, "assimilation.refine": "none"}
    runs = []
    for name, kind in (("combined_laser", "laser"), ("combined_acoustic", "acoustic")):
        files = [str(ROOT / f"configs/data/{name}/{kind}_0{i}.csv") for i in (1, 2)]
        run_dir = {"output.directory": str(tmp_path / name), "data.path": files}
        runs.append(run_campaign(ROOT / "configs" / f"{name}.yaml", overrides={**quick, **run_dir}).directory)
    found, _ = join(runs, [], tmp_path / "both")
    assert found.shared == ("G", "alpha", "mu", "p_A")
    assert not [c for c in found.cautions if c.severity == "serious"]
    amplitude = found.group("posterior")["p_A"].values
    assert abs(amplitude.mean() + 26e6) < min(0.8e6, 2.5 * amplitude.std())
    alone = load_joint(runs[1] / "joint.nc").group("posterior")["p_A"].values
    assert amplitude.std() < 0.7 * alone.std()  # the laser bubbles tell


@pytest.mark.slow
def test_laser_with_a_viscosity_that_is_halved(tmp_path):
    result = run("laser_varying", tmp_path, **{"output.report": False})
    assert result.sample_stats.attrs["n_active"] == 48
    assert result.sample_stats.attrs["log_evidence_change"] > 5
    pieces = result.dataset("posterior")["mu_pieces"]
    mean, std = pieces.mean(("chain", "draw")).values, pieces.std(("chain", "draw")).values
    assert np.all(np.abs(mean - np.array([0.06, 0.03, 0.03])) < 2.5 * std)
    assert mean[1] + 3 * std[1] < mean[0]


@pytest.mark.slow
def test_soft_polyacrylamide(tmp_path):
    """A least-squares fit of the same model (polytropic gas, saturated vapour): G 1.9 kPa, μ 0.084 Pa s, NRMSE
    0.957.
    """
    result = on_file("polyacrylamide_soft", "A_E2_002.mat", tmp_path)
    scores = result.sample_stats.attrs
    assert scores["converged"] == 1
    assert scores["n_active"] == 48
    assert scores["nrmse"] >= 0.95
    G, G_std = mean_and_std(result, "G")
    mu, _ = mean_and_std(result, "mu")
    assert abs(G - 1.9e3) < G_std
    assert mu == pytest.approx(0.0845, rel=0.03)


@pytest.mark.slow
def test_stiff_polyacrylamide(tmp_path):
    result = on_file("polyacrylamide_estrada", "PA1_exp2_RofTdata_0.mat", tmp_path)
    scores = result.sample_stats.attrs
    assert scores["n_active"] == 48
    assert scores["converged"] == 1
    assert scores["nrmse"] > 0.95
