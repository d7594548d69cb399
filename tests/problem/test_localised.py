"""A data set with a localised gain against formulas written out, and what becomes of members that fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from field_models import PLACES, READ, TIMES, VALUES, Fragile, Line, Many
from scipy.spatial.distance import cdist

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.diagnosis.honesty.advice import ADVICE, Case
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.joint.problem import sharing
from en4dvar.model.forward import Observable, StateField
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior, PriorTerm, member_stream
from en4dvar.problem import InverseProblem
from en4dvar.schemes.local_gain import ByCorrelation, Split
from en4dvar.schemes.localisation import gaspari_cohn
from en4dvar.schemes.settings import AssimilationSettings, Localisation

STD, SEED, N, RADIUS = 0.3, 4, 12, 3.0
NEAR = Localisation(RADIUS)


def line(model=None, weights=None, estimated=False, level=False) -> InverseProblem:
    model = model or Line()
    u, of_level = model.observables
    series = [Series(u, TIMES, VALUES, noise_of(np.full(6, STD)), weights, places=Places.at_indices(READ))]
    if level:
        series.append(Series(of_level, np.array([1.0, 2.0]), np.array([4.0, 4.2]), noise_of(np.full(2, STD))))
    field = FieldPrior(model.layout.fields[0], 1.0, "gaussian", 1.5)
    terms = (PriorTerm.normal(model.parameters[0], 1.0, 0.5),) if estimated else ()
    return InverseProblem(
        model, u, Observations.of_series(series), Prior(terms), {} if estimated else {"offset": 0.0}, fields=(field,)
    )


def settings(scheme="en4dvar", localisation: Localisation | None = NEAR, **more) -> AssimilationSettings:
    return AssimilationSettings(scheme=scheme, members=N, localisation=localisation, **more)


def prior_of(problem: InverseProblem) -> np.ndarray:
    """What is drawn (N, 30), centred."""
    drawn = np.array([problem.fields[0].draw(SEED, i) for i in range(N)])
    return drawn - drawn.mean(axis=0)


def errors(purpose: str, count: int) -> np.ndarray:
    z = np.array([member_stream(SEED, purpose, i).standard_normal(count) for i in range(N)])
    return STD * (z - z.mean(axis=0))


def gain(ensemble: np.ndarray, read: np.ndarray) -> np.ndarray:
    """(ρ∘P)Hᵀ[H(ρ∘P)Hᵀ + R]⁻¹ with every matrix written out."""
    H, places = np.eye(30)[read], PLACES[:, None]
    P = gaspari_cohn(cdist(places, places), RADIUS) * np.cov(ensemble.T)
    return P @ H.T @ np.linalg.inv(H @ P @ H.T + STD**2 * np.eye(len(read)))


def test_one_pass_is_the_update_of_the_schur_product():
    problem = line()
    before = prior_of(problem)
    found = assimilate(problem, settings("es-mda", mda_coefficients=(1.0,)), SEED)
    innovation = VALUES + errors("ES-MDA 0", 6) - (2.0 + before[:, READ])
    expected = 2.0 + before + innovation @ gain(before, READ).T
    (field,) = found.fields
    assert field.members == pytest.approx(expected, abs=1e-10)
    assert field.mean == pytest.approx(expected.mean(axis=0), abs=1e-10)
    assert field.std == pytest.approx(expected.std(axis=0, ddof=1), abs=1e-10)
    assert field.prior_mean == pytest.approx(np.full(30, 2.0), abs=1e-10)
    assert field.prior_std == pytest.approx(before.std(axis=0, ddof=1), abs=1e-10)
    assert found.posterior_predictions == pytest.approx(expected[:, READ], abs=1e-10)
    assert found.forward_runs == 2 * N + 2 + 1  # prior, two members again, posterior and its mean


def test_the_minimum_of_en4dvar_is_that_of_the_schur_product():
    problem = line()
    before = prior_of(problem)
    found = assimilate(problem, settings(epsilon=1.0), SEED)
    K = gain(before, READ)
    (field,) = found.fields
    centre = 2.0 + K @ (VALUES - 2.0)
    assert found.converged
    assert field.centre == pytest.approx(centre, abs=1e-10)
    spread = before + (errors("En4D-Var field", 6) - before[:, READ]) @ K.T
    assert field.members == pytest.approx(centre + spread, abs=1e-10)
    assert found.iterations[-1].dfs == pytest.approx(np.trace(K[READ]), abs=1e-10)
    assert found.iterations[-1].cost < found.iterations[0].cost


def test_readings_without_weight_are_left_out():
    weights = np.array([1.0, 1, 0, 1, 1, 1])
    found = assimilate(line(weights=weights), settings(epsilon=1.0), SEED)
    before, kept = prior_of(line()), weights > 0
    centre = 2.0 + gain(before, READ[kept]) @ (VALUES[kept] - 2.0)
    assert found.fields[0].centre == pytest.approx(centre, abs=1e-10)


def test_a_factor_is_that_of_the_logarithm():
    """Values of a relative field are those of the model times e to what is drawn."""
    problem = line()
    relative = replace(problem, fields=(replace(problem.fields[0], relative=True, std=0.2),))
    found = assimilate(relative, settings(), SEED)
    before = 0.2 * prior_of(problem)
    (field,) = found.fields
    assert field.prior_mean == pytest.approx((2 * np.exp(before)).mean(axis=0), rel=1e-12)
    assert np.all(field.members > 0)
    assert found.centre_predictions == pytest.approx(field.centre[READ], rel=1e-12)
    assert np.abs(found.centre_predictions - VALUES).max() < np.abs(2.0 - VALUES).max()


def test_a_parameter_with_a_place_beside_a_field():
    """Its covariances are tapered by its distance: far away it stays as it was."""
    near = Localisation(RADIUS, {"level": (0.5,), "offset": (0.5,)})
    far = Localisation(RADIUS, {"level": (0.5,), "offset": (100.0,)})
    found, kept = (assimilate(line(estimated=True, level=True), settings("es-mda", one), SEED) for one in (near, far))
    assert kept.posterior == pytest.approx(kept.prior, abs=1e-12)
    assert found.posterior.std() < 0.8 * found.prior.std()
    assert found.dfs_per_parameter[0] == pytest.approx(1 - found.posterior.var(ddof=1) / found.prior.var(ddof=1))


def test_without_a_place_all_readings_act_on_a_parameter():
    """Of es-mda by an untapered regression; of En4D-Var as a block of its own of B, written out here."""
    somewhere = Localisation(RADIUS, {"level": (0.5,)})
    problem = line(estimated=True, level=True)
    found = assimilate(problem, settings("es-mda", somewhere), SEED)
    assert found.posterior.std() < 0.8 * found.prior.std()

    found = assimilate(problem, settings("en4dvar", somewhere, epsilon=1.0), SEED)
    cells, offset = prior_of(problem), problem.prior.sample(N, SEED, "exact") - 1.0
    H = np.vstack([np.eye(30)[READ], np.tile(np.where(np.arange(30) < 3, 1 / 3, 0.0), (2, 1))])
    of_offset, places = np.array([0.0] * 6 + [1.0] * 2), np.append(PLACES[READ], [0.5, 0.5])[:, None]
    P = np.cov(cells.T)
    along = gaspari_cohn(cdist(PLACES[:, None], places), RADIUS) * (P @ H.T)
    within = gaspari_cohn(cdist(places, places), RADIUS) * (H @ P @ H.T)
    system = within + 0.5**2 * np.outer(of_offset, of_offset) + STD**2 * np.eye(8)
    values = np.append(VALUES, [4.0, 4.2])
    dual = np.linalg.solve(system, values - 2.0 - of_offset)
    (field,) = found.fields
    assert field.centre == pytest.approx(2.0 + along @ dual, abs=1e-9)
    assert found.centre == pytest.approx(1.0 + 0.25 * of_offset @ dual, abs=1e-9)
    seen = errors("En4D-Var field", 8) - cells @ H.T - offset * of_offset
    gained = np.linalg.solve(system, seen.T)
    spread = offset[:, 0] + 0.25 * of_offset @ gained
    assert found.posterior[:, 0] == pytest.approx(found.centre[0] + spread, abs=1e-9)
    assert field.members == pytest.approx(field.centre + cells + (along @ gained).T, abs=1e-9)


@pytest.mark.parametrize("scheme", ["en4dvar", "es-mda"])
def test_more_parameters_without_a_place_than_members_know(scheme):
    model = Many()
    series = Series(
        model.observables[0], np.ones(3), np.zeros(3), noise_of(np.ones(3)), places=Places.at_indices([0, 1, 2])
    )
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problem = InverseProblem(model, model.observables[0], Observations.of_series([series]), prior)
    with pytest.raises(ConfigError, match="2000 parameters have no place, as many as 12 members"):
        assimilate(problem, settings(scheme, Localisation(RADIUS, {"k": (0.0,)})), SEED)


def test_so_many_parameters_without_a_place_that_chance_explains_a_field():
    with pytest.raises(ConfigError, match=r"more than a quarter of the directions that 4 members .* scheme: en4dvar$"):
        assimilate(line(estimated=True), replace(settings("es-mda"), members=4), SEED)


def test_by_correlation_is_the_adaptive_gain_in_each_pass():
    problem = line(estimated=True)
    adaptive = Localisation(threshold=0.4)
    found = assimilate(problem, settings("es-mda", adaptive, mda_coefficients=(1.0,)), SEED)
    cells = prior_of(problem)
    before = np.column_stack([problem.prior.sample(N, SEED, "exact"), cells])
    Y = 2.0 + cells[:, READ]
    innovations = VALUES + errors("ES-MDA 0", 6) - Y
    update = ByCorrelation(0.4).update(Split(Y - Y.mean(axis=0)), np.full(6, STD**2), innovations)
    after = before + update(slice(0, 31), before - before.mean(axis=0))
    assert found.posterior == pytest.approx(after[:, :1], abs=1e-10)
    assert found.fields[0].members == pytest.approx(2.0 + after[:, 1:], abs=1e-10)


class WithoutOne(StateField):
    """No number at one cell that is read where the first cell is more than a kelvin above what it starts with."""

    def __call__(self, trajectory):
        u = np.array(super().__call__(trajectory), dtype=float)
        u[u[:, 0] > 3.0, READ[2]] = np.nan
        return u


class Gappy(Line):
    observables = (Observable("u", "K", WithoutOne("u")), Line.observables[1])


@pytest.mark.parametrize("scheme", ["es-mda", "en4dvar"])
def test_what_members_lack_is_that_of_the_cell_that_is_read(scheme):
    """The screening finds it among thirty cells, so that the analysis is that of the model without gaps."""
    more = {"epsilon": 1.0} if scheme == "en4dvar" else {}
    whole, gappy = (assimilate(line(model), settings(scheme, **more), SEED) for model in (Line(), Gappy()))
    assert gappy.fields[0].members == pytest.approx(whole.fields[0].members, abs=1e-9)
    assert gappy.posterior_predictions == pytest.approx(whole.posterior_predictions, abs=1e-9)
    assert not any(gappy.prior_failures)
    assert any(c.code == "readings-missing" for c in gappy.cautions) == (scheme == "es-mda")  # of the posterior
    assert not any(c.code == "readings-missing" for c in whole.cautions)


def test_members_that_fail_are_left_where_they_failed_and_told():
    found = assimilate(line(Fragile()), settings("es-mda"), SEED)
    lost = np.flatnonzero(prior_of(line())[:, 0] > 1)
    assert len(lost)
    assert [i for i, reason in enumerate(found.posterior_failures) if reason] == lost.tolist()
    assert "too hot" in found.posterior_failures[lost[0]]
    assert any(c.code == "members-lost" for c in found.cautions)
    alive = np.array([not reason for reason in found.posterior_failures])
    assert np.abs(found.posterior_predictions[alive].mean(axis=0) - VALUES).max() < 1
    (field,) = found.fields  # of survivors alone
    assert np.isnan(field.members[lost]).all()
    assert field.mean == pytest.approx(field.members[alive].mean(axis=0), rel=1e-12)
    assert field.std == pytest.approx(field.members[alive].std(axis=0, ddof=1), rel=1e-9)
    with pytest.raises(TooFewMembersError, match=r"failed in the prior forecast; at least 12 must survive.*too hot"):
        assimilate(line(Fragile()), settings("es-mda", min_active_fraction=1.0), SEED)


@pytest.mark.slow
def test_spread_of_2000_named_parameters_by_correlation():
    """100 members, 200 readings of a parameter each, that nothing names: within 10 % of the exact spread."""
    model, rng = Many(), np.random.default_rng(1)
    of = rng.permutation(2000)[:200]
    places = Places.at_indices(of)
    series = Series(
        model.observables[0], np.ones(200), rng.standard_normal(200), noise_of(np.full(200, 0.7)), places=places
    )
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problem = InverseProblem(model, model.observables[0], Observations.of_series([series]), prior)
    asked = AssimilationSettings("es-mda", members=100, localisation=Localisation())
    found = assimilate(problem, asked, 0)
    exact = np.ones(2000)
    exact[of] = 0.7 / np.sqrt(1 + 0.7**2)
    spread = found.posterior.std(axis=0, ddof=1)
    assert np.sqrt(np.mean(spread[of] ** 2)) == pytest.approx(exact[of[0]], rel=0.1)
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(np.sqrt(np.mean(exact**2)), rel=0.1)
    assert found.prior.mean(axis=0) == pytest.approx(np.zeros(2000), abs=1e-12)


def test_a_field_is_not_estimated_jointly():
    named = [replace(one, observations=replace(one.observations, name=name))
             for one, name in ((line(estimated=True), "a"), (line(estimated=True), "b"))]  # fmt: skip
    with pytest.raises(ConfigError, match="a: whole fields cannot be estimated jointly"):
        sharing(named, ["offset"])


def test_what_cannot_be_localised():
    with pytest.raises(ConfigError, match="needs a localised gain"):
        assimilate(line(), settings(localisation=None), SEED)
    with pytest.raises(ConfigError, match="is en4dvar or es-mda"):
        assimilate(line(), settings("etkf"), SEED)
    with pytest.raises(ConfigError, match="mda_form: scheme es-mda does not read it beside a localisation"):
        assimilate(line(), settings("es-mda", mda_form="square-root"), SEED)
    with pytest.raises(ConfigError, match="at least one parameter must be estimated"):
        assimilate(replace(line(), fields=()), settings(), SEED)


class Bent(Line):
    def step(self, x, t0, t1):
        return np.append(x[:30] + 0.05 * (t1 - t0) * x[:30] ** 2, x[30])


def test_what_is_advised_of_iterations_beside_a_localisation_is_read_there():
    """Beyond 30 of them it was to set refine: mcmc, which is refused."""
    found = assimilate(line(Bent()), settings(max_iterations=1), SEED)
    (told,) = (c for c in found.cautions if c.code == "not-converged")
    of_many = Case(replace(found, settings=settings(max_iterations=30)), told, frozenset({told.code}))
    advice = ADVICE["not-converged"](of_many)
    assert "refine" not in advice
    assert "set assimilation.max_iterations: 60" in advice
