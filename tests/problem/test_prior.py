"""Transforms, random streams and second-order-exact sampling."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm, member_stream, own_seed, standard_normal

A, B, C = Parameter("a", "Pa"), Parameter("b", "m"), Parameter("c", "1")
TERMS = (PriorTerm.lognormal(A, 2e3, 0.5), PriorTerm.normal(B, 1e-4, 3e-6), PriorTerm.logit(C, (-1.0, 3.0), 0.5, 1.2))


@given(st.floats(1e-12, 1e12))
def test_lognormal_round_trip(theta):
    term = PriorTerm.lognormal(A, 1.0, 1.0)
    assert math.isclose(float(term.to_physical(term.from_physical(np.array(theta)))), theta, rel_tol=1e-13)


@given(st.floats(-15.0, 15.0), st.floats(-100.0, 100.0), st.floats(1e-3, 1e3))
def test_logit_round_trip_and_range(x, low, width):
    term = PriorTerm.logit(A, (low, low + width), low + width / 2, 1.0)
    theta = float(term.to_physical(np.array(x)))
    assert low <= theta <= low + width
    # resolution of θ next to a bound: |low| eps / (distance to the bound), in the transformed coordinate
    distance = width * math.exp(-abs(x)) / 2
    tolerance = 1e-14 + 4 * np.finfo(float).eps * (abs(low) + width) / distance
    if tolerance < 0.1:
        assert abs(float(term.from_physical(np.array(theta))) - x) < 2 * tolerance


@given(st.floats(-300.0, 300.0), st.floats(-100.0, 100.0), st.floats(1e-3, 1e3))
def test_what_is_far_out_lies_within_the_bounds_and_can_be_gone_back_to(x, low, width):
    term = PriorTerm.logit(A, (low, low + width), low + width / 2, 1.0)
    theta = term.to_physical(np.array(x))
    assert low < theta < low + width
    assert np.isfinite(term.from_physical(theta))


def test_logit_keeps_precision_at_a_zero_bound():
    term = PriorTerm.logit(A, (0.0, 2.0), 1.0, 1.0)
    assert float(term.to_physical(np.array(-40.0))) == pytest.approx(2 * math.exp(-40.0), rel=1e-13)


def test_constructors_speak_physical():
    assert Prior(TERMS).to_physical(Prior(TERMS).mean) == pytest.approx([2e3, 1e-4, 0.5], rel=1e-14)
    term = PriorTerm.lognormal_moments(A, mean=3.0, std=2.0)
    assert math.exp(term.mean + term.std**2 / 2) == pytest.approx(3.0)
    assert 3.0 * math.sqrt(math.expm1(term.std**2)) == pytest.approx(2.0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: PriorTerm.normal(A, 0.0, 0.0),
        lambda: PriorTerm.normal(A, math.nan, 1.0),
        lambda: PriorTerm.lognormal(A, -1.0, 1.0),
        lambda: PriorTerm.lognormal_moments(A, 1.0, -1.0),
        lambda: PriorTerm.logit(A, (0.0, 1.0), 1.0, 1.0),
        lambda: PriorTerm.logit(A, (0.0, math.inf), 1.0, 1.0),
        lambda: Prior((TERMS[0], TERMS[0])),
        lambda: Prior(TERMS).sample(3, 0, "exact"),
        lambda: Prior(TERMS).sample(1, 0, "random"),
    ],
)
def test_improper_priors_are_refused(build):
    with pytest.raises(ConfigError):
        build()


@pytest.mark.parametrize("theta", [0.0, -1.0])
def test_value_outside_the_transform_is_an_error_not_clipped(theta):
    with pytest.raises(ValueError, match="a: values must lie"):
        TERMS[0].from_physical(np.array(theta))


def test_overflow_is_infinite_not_clipped():
    assert np.isinf(TERMS[0].to_physical(np.array(800.0)))


def test_growing_the_ensemble_leaves_first_members():
    prior = Prior(TERMS)
    assert np.array_equal(prior.sample(50, 7, "random")[:20], prior.sample(20, 7, "random"))


def test_a_member_has_the_first_number_of_its_own_stream():
    of_each = [member_stream(7, "a", member).standard_normal() for member in range(300)]
    assert np.array_equal(standard_normal(7, "a", 300), of_each)


def test_a_data_set_has_a_seed_of_its_own():
    seeds = {own_seed(seed, f"set{i}") for seed in (0, 1, 2**63 - 1) for i in range(500)}
    assert len(seeds) == 1500
    assert max(seeds) < 2**48
    assert own_seed(1, "ge\u0301l") == own_seed(1, "g\u00e9l") != own_seed(1, "gel")


def test_adding_a_parameter_leaves_the_others_draws():
    full = Prior(TERMS).sample(20, 7, "random")
    assert np.array_equal(full[:, [0, 2]], Prior((TERMS[0], TERMS[2])).sample(20, 7, "random"))
    assert np.array_equal(full[:, [2, 1, 0]], Prior(TERMS[::-1]).sample(20, 7, "random"))


def test_adding_a_parameter_at_the_end_leaves_the_exact_members():
    difference = Prior(TERMS).sample(20, 7)[:, :2] - Prior(TERMS[:2]).sample(20, 7)
    assert np.abs(difference / Prior(TERMS).std[:2]).max() < 1e-13


def test_exact_sample_has_the_prior_moments():
    prior = Prior(TERMS)
    z = (prior.sample(16, 3) - prior.mean) / prior.std
    assert np.abs(z.mean(axis=0)).max() < 1e-13
    assert np.abs(np.cov(z.T) - np.eye(3)).max() < 1e-13


def test_exact_sample_is_close_to_its_draws_when_large():
    prior = Prior(TERMS)
    shift = (prior.sample(2000, 3) - prior.sample(2000, 3, "random")) / prior.std
    assert np.abs(shift).max() < 0.5
    assert np.abs(shift).max() > 0


def test_streams_are_standard_normal_and_independent():
    z = (Prior(TERMS).sample(4000, 11, "random") - Prior(TERMS).mean) / Prior(TERMS).std
    assert np.abs(z.mean(axis=0)).max() < 4 / math.sqrt(4000)
    assert np.abs(np.corrcoef(z.T) - np.eye(3)).max() < 4 / math.sqrt(4000)
    assert np.abs(z.var(axis=0) - 1).max() < 4 * math.sqrt(2 / 4000)
    assert np.abs(np.mean(z[1:] * z[:-1], axis=0)).max() < 4 / math.sqrt(4000)
    assert not np.array_equal(z, (Prior(TERMS).sample(4000, 12, "random") - Prior(TERMS).mean) / Prior(TERMS).std)


def test_log_density_is_the_normalised_gaussian():
    prior = Prior((PriorTerm.normal(A, 1.0, 2.0), PriorTerm.normal(B, -1.0, 0.5)))
    axis = np.linspace(-8, 8, 801)
    x = np.stack(np.meshgrid(1 + 2 * axis, -1 + 0.5 * axis), axis=-1)
    mass = np.exp(prior.log_density(x)).sum() * (axis[1] - axis[0]) ** 2 * 2.0 * 0.5
    assert mass == pytest.approx(1.0, abs=1e-10)
    assert prior.log_density(np.array([[1.0, -1.0], [3.0, -1.0]])).shape == (2,)
