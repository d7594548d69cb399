"""A field as the sum of its modes: closed form, Kuramoto and Sivashinsky's ring from a file, against least squares."""

from __future__ import annotations

import numpy as np
import pytest
from field_models import READ, TIMES, VALUES, Fragile, Line
from kuramoto import CELLS, Kuramoto, write_ring
from kuramoto import NU as TRUE_NU
from kuramoto import READ as CELLS_READ
from scipy.optimize import least_squares

import en4dvar
from en4dvar.config.varies import modes_of
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Batch, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import correlation_of_places
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.runs.runner import run_campaign
from en4dvar.schemes.settings import AssimilationSettings

CORRELATED = ("energy_std: 0.05", "energy_std: 0.05, correlation_time: 3")
STD, LEVEL = 0.3, np.array([4.0, 4.2])


def line(model: Line | None = None, **prior) -> InverseProblem:
    """Readings of cells and of the mean of three cells with an offset, which have no place."""
    model = model or Line()
    u, level = model.observables
    series = [
        Series(u, TIMES, VALUES, noise_of(np.full(6, STD)), places=Places.at_indices(READ)),
        Series(level, np.array([1.0, 2.0]), LEVEL, noise_of(np.full(2, STD))),
    ]
    modes = modes_of(FieldPrior(model.layout.fields[0], 1.0, "gaussian", 1.5, **prior))
    terms = (PriorTerm.normal(model.parameters[0], 1.0, 0.5), *(mode.term for mode in modes))
    effects = tuple(mode.perturbation for mode in modes)
    return InverseProblem(model, u, Observations.of_series(series), Prior(terms), perturbations=effects)


def test_a_linear_field_with_a_parameter_and_a_reading_of_no_place_is_the_closed_form():
    problem = line()
    C = correlation_of_places("gaussian", problem.perturbations[0].of.places, 1.5)
    H = np.zeros((8, 31))
    H[range(6), READ] = 1
    H[6:, :3], H[6:, 30] = 1 / 3, 1
    P = np.zeros((31, 31))
    P[:30, :30], P[30, 30] = C, 0.25
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + STD**2 * np.eye(8))
    prior = np.append(np.full(30, 2.0), 1.0)
    mean = prior + K @ (np.append(VALUES, LEVEL) - H @ prior)
    std = np.sqrt(np.diag(P - K @ H @ P))
    analysis = assimilate(problem, AssimilationSettings(members=40), 1)
    (field,) = analysis.fields
    assert np.max(np.abs(field.centre - mean[:30]) / std[:30]) < 2e-3  # 1e-6 of the variance is left out
    assert np.max(np.abs(field.std / std[:30] - 1)) < 2e-3
    assert np.max(np.abs(field.prior_std - 1)) < 2e-3
    assert analysis.posterior[:, 0].mean() == pytest.approx(mean[30], abs=1e-3 * std[30])
    assert analysis.posterior[:, 0].std(ddof=1) == pytest.approx(std[30], rel=1e-3)


def test_cells_of_members_that_fail_are_no_part_of_the_field():
    analysis = assimilate(line(Fragile()), AssimilationSettings(members=40, min_active_fraction=0.2), 1)
    (field,), lost = analysis.fields, np.array([reason != "" for reason in analysis.posterior_failures])
    assert 0 < lost.sum() < 30
    np.testing.assert_array_equal(np.isnan(field.members).any(axis=1), lost)
    assert field.std == pytest.approx(field.members[~lost].std(axis=0, ddof=1), rel=1e-9)


def test_modes_that_the_readings_do_not_tell_are_counted_in_one_warning():
    analysis = assimilate(line(), AssimilationSettings(members=40), 1)
    (said,) = (c for c in analysis.cautions if c.code == "not-informed")
    little = [
        name for name, dfs in zip(line().prior.names[1:], analysis.dfs_per_parameter[1:], strict=True) if dfs < 0.1
    ]
    assert said.parameters == tuple(little)
    assert len(little) > 3
    assert said.words.startswith(f"{len(little)} of {len(line().perturbations)} modes of the initial ")


def test_so_many_modes_as_asked_for_and_factors():
    few = line(modes=5)
    assert len(few.perturbations) == 5
    shares = [np.sum(np.square(p.pattern)) for p in few.perturbations]
    assert shares == sorted(shares, reverse=True)
    relative = assimilate(line(relative=True), AssimilationSettings(members=40), 1)
    assert np.min(relative.fields[0].members) > 0
    assert relative.fields[0].centre[READ] == pytest.approx(relative.centre_predictions[:6], rel=1e-12)


def test_a_field_of_many_cells_is_not_told_by_modes():
    wide = FieldPrior(Field("u", 2001, coordinates=np.arange(2001.0)), 1.0, "gaussian", 3.0)
    with pytest.raises(ConfigError, match=r"assimilation.localisation: u has 2001 cells; more than 2000 need"):
        modes_of(wide)


def least_squares_of(folder, correlation_time: float) -> tuple[np.ndarray, np.ndarray]:
    """The minimum of J and the std there of (ν, 128 cells), the initial field by the root of its covariance."""
    model = Kuramoto()
    C = correlation_of_places("gaussian", model.layout.fields[0].coordinates[:, None], 5.0)
    values, vectors = np.linalg.eigh(C)
    keep = values > 1e-8
    root = 0.4 * vectors[:, keep] * np.sqrt(values[keep])
    when, energy = np.genfromtxt(folder / "energy.csv", delimiter=",", skip_header=1).T
    u = np.genfromtxt(folder / "u.csv", delimiter=",", skip_header=1)[:, 2].reshape(len(when), -1)
    lag = np.abs(np.subtract.outer(when, when))
    whiten = np.linalg.inv(np.linalg.cholesky(0.05**2 * np.exp(-lag / correlation_time)))
    base = model.initial_state({"nu": 1.0})

    def residuals(many):
        x = np.tile(base, (len(many), 1))
        x[:, CELLS] += 0.1 * many[:, 0]
        x[:, :CELLS] += many[:, 1:] @ root.T
        paths = model.trajectories(x, when)["u"]
        of_u = ((paths[:, :, CELLS_READ] - u) / 0.3).reshape(len(many), -1)
        return np.hstack([of_u, (np.mean(paths**2, axis=2) - energy) @ whiten.T, many])

    def jacobian(z):
        step = 1e-5 * np.eye(len(z))
        return ((residuals(z + step) - residuals(z - step)) / 2e-5).T

    start = np.append(
        (TRUE_NU - 1) / 0.1, np.linalg.lstsq(root, np.load(folder / "truth.npy") - base[:CELLS], rcond=None)[0]
    )
    best = least_squares(lambda z: residuals(z[None])[0], start, jacobian, xtol=1e-12)
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    full = np.zeros((1 + CELLS, len(start)))
    full[0, 0], full[1:, 1:] = 0.1, root
    return np.append(1.0, base[:CELLS]) + full @ best.x, np.sqrt(np.diag(full @ covariance @ full.T))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "correlation_time"),
    [
        ((), 1e-9),
        ((CORRELATED,), 3.0),
    ],
)
def test_the_ring_from_a_file_is_4d_var(tmp_path, changes, correlation_time):
    """128 cells, a parameter, readings of no place, a chaotic window, also with correlated errors; least squares
    started at the truth. A descent that ends by the default tolerance may have √(2·10⁻⁴ J) = 0.13 std to go, J = 80.
    """
    path, truth = write_ring(tmp_path, *changes, seed=1)
    np.save(tmp_path / "truth.npy", truth)
    overrides = {"output.directory": str(tmp_path / "run"), "assimilation.cost_tolerance": 1e-7}
    (result,) = run_campaign(path, overrides=overrides)
    mean, std = least_squares_of(tmp_path, correlation_time)
    fields, nu = result.dataset("fields"), result.posterior["nu"].values.ravel()
    assert nu.mean() == pytest.approx(mean[0], abs=0.02 * std[0])
    assert nu.std(ddof=1) == pytest.approx(std[0], rel=0.02)
    assert np.max(np.abs(fields["u_centre"].values - mean[1:]) / std[1:]) < 0.05
    assert np.max(np.abs(fields["u_std"].values / std[1:] - 1)) < 0.02
    z = (fields["u_mean"].values - truth) / fields["u_std"].values
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert 'id="d0-fields"' in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.long
def test_nine_of_ten_rings_end_at_the_minimum_of_the_truth(tmp_path):
    """To 0.1 posterior standard deviations in each cell and the viscosity."""
    reached = 0
    for seed in range(1, 11):
        (folder := tmp_path / str(seed)).mkdir()
        path, truth = write_ring(folder, seed=seed)
        np.save(folder / "truth.npy", truth)
        (result,) = run_campaign(path, overrides={"output.directory": str(folder / "run"), "output.report": False})
        mean, std = least_squares_of(folder, 1e-9)
        found = np.append(result.posterior["nu"].values.mean(), result.dataset("fields")["u_centre"].values)
        reached += np.max(np.abs(found - mean) / std) < 0.1
    assert reached >= 9


class Canal(ForwardModel):
    """Heads along a soil that carries rain to both ends, by its ln T: each tells of all cells."""

    parameters = ()
    layout = StateLayout(
        tuple(Field(name, 60, coordinates=np.arange(60.0), coordinate_unit="m") for name in ("ln_T", "head"))
    )
    observables = (Observable("head", "1", StateField("head")),)
    time_unit = "1"

    def initial_state(self, theta):
        return np.zeros(120)

    def trajectories(self, x, times):
        resistance = np.exp(-x[:, :60])
        heads, lost = (np.cumsum(rain * resistance, axis=1) for rain in (1, 0.02 * (np.arange(60) + 0.5)))
        states = np.hstack([x[:, :60], lost[:, -1:] / heads[:, -1:] * heads - lost])
        return Batch(np.broadcast_to(times, (len(x), 1)), states[:, None], self.layout)


def test_readings_that_are_not_local_are_advised_less_localisation():
    """Localised it stops far from the readings, after fewer iterations than are allowed; without, nothing is wrong."""
    model, cells, rng = Canal(), np.arange(4, 60, 8), np.random.default_rng(0)
    covariance = correlation_of_places("gaussian", np.arange(60.0)[:, None], 8.0) + 1e-9 * np.eye(60)
    truth = np.linalg.cholesky(covariance) @ rng.standard_normal(60)
    heads = model.trajectories(np.append(truth, np.zeros(60))[None], np.ones(1)).states[0, 0, 60:]
    std = 0.01 * heads.max()
    read = np.ones(len(cells)), heads[cells] + std * rng.standard_normal(len(cells))

    def estimated(**keys):
        return en4dvar.estimate(
            model, {"head": read}, {}, error={"head": std}, series={"head": {"places": cells}},
            initial_state={"ln_T": {"std": 1, "kernel": "gaussian", "length": "8 m"}},
            assimilation={"members": 40, **keys},
        )  # fmt: skip

    advice = {c.code: c.advice for c in estimated(localisation={"radius": "8 m"}).cautions}
    assert advice["misfit"].startswith("settle the warning not-converged first")
    assert "larger assimilation.localisation.radius (it is 8 m), or leave localisation out" in advice["not-converged"]
    whole = estimated()
    assert not {"misfit", "not-converged"} & {c.code for c in whole.cautions}
    assert np.sqrt(np.mean((whole.dataset("fields")["ln_T_mean"].values - truth) ** 2)) < 0.3
