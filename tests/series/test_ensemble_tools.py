"""Inflation, rotation, update, localisation: what each must leave unchanged and what it must change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from en4dvar.ensemble.linalg import GRAM_LIMIT, Hessian, NearPrior, apply_weights, centre
from en4dvar.schemes.base import Evaluation, gauss_newton
from en4dvar.schemes.filters import ETKF, EnKF
from en4dvar.schemes.localisation import BlockLocalisation, distances, gaspari_cohn
from en4dvar.series.moments import BLOCK, MomentsRecorder
from en4dvar.series.sequential import Rotations, reflections, rotate
from en4dvar.series.settings import Inflation

RNG = np.random.default_rng


def test_multiplicative_inflation():
    anomalies = centre(RNG(0).standard_normal((6, 4)))[1]
    assert np.array_equal(Inflation(1.1).apply(anomalies, anomalies), 1.1 * anomalies)
    assert Inflation().apply(anomalies, anomalies) is anomalies


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_relaxation_moves_the_spread_between_posterior_and_prior(alpha):
    prior = RNG(0).standard_normal((6, 4))
    posterior = 0.4 * centre(prior)[1] * np.array([1.0, 0.5, 0.2, 0.0])
    relaxed = Inflation(rtps=alpha).apply(prior, posterior)
    before, after = prior.std(axis=0, ddof=1), posterior.std(axis=0, ddof=1)
    expected = (1 - alpha) * after + alpha * before
    assert relaxed.std(axis=0, ddof=1)[:3] == pytest.approx(expected[:3], rel=1e-13)
    assert np.array_equal(relaxed[:, 3], np.zeros(6))  # a variable without spread is given none
    anomalies = centre(prior)[1]
    assert Inflation(rtps=alpha).apply(prior, anomalies) == pytest.approx(anomalies)


@pytest.mark.parametrize("arguments", [(0.0,), (-1.0,), (1.0, -0.1), (1.0, 1.1)])
def test_inflation_refuses_nonsense(arguments):
    with pytest.raises(ValueError, match="must"):
        Inflation(*arguments)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_rotation_keeps_mean_and_covariance_and_mixes_members(number):
    anomalies = centre(RNG(0).standard_normal((9, 30)))[1]
    directions = RNG(1).standard_normal((number, 9))
    turned = rotate(anomalies, reflections(directions))
    assert np.max(np.abs(turned.sum(axis=0))) < 1e-13
    assert np.max(np.abs(turned.T @ turned - anomalies.T @ anomalies)) < 1e-12
    assert np.linalg.norm(turned - anomalies) > 0.1 * np.linalg.norm(anomalies)
    one_by_one = anomalies
    for v in directions - directions.mean(axis=1, keepdims=True):
        one_by_one = one_by_one - np.outer(2 * v / (v @ v), v @ one_by_one)
    assert turned == pytest.approx(one_by_one, abs=1e-13)


def test_rotations_reach_every_direction():
    """Repeated, they forget where they started: the mean of turned anomalies vanishes as 1/√(number)."""
    anomalies, rotations = centre(np.eye(8))[1], Rotations(0, 8)
    total, current = np.zeros((8, 8)), anomalies
    for cycle in range(4000):
        current = rotate(current, rotations.of_cycle(cycle, 8))
        total += current
    assert np.max(np.abs(total / 4000)) < 0.05 * np.max(np.abs(anomalies))


def test_a_cycle_has_its_own_rotation():
    """Whatever was drawn before; a lost member takes its own random numbers away and no others."""
    onward, anew = Rotations(3, 8), Rotations(3, 8)
    for cycle in range(130):
        factors = onward.of_cycle(cycle, 8)
    assert all(np.array_equal(a, b) for a, b in zip(factors, anew.of_cycle(129, 8), strict=True))
    assert not np.array_equal(factors[0], onward.of_cycle(128, 8)[0])
    fewer, whole = anew.of_cycle(129, 7)[1], factors[1]
    assert np.diff(fewer) == pytest.approx(np.diff(whole)[:, :6], abs=1e-14)  # up to their mean


@pytest.mark.parametrize("shape", [(5, 1), (6, 3), (40, 41), (9, 200)])
def test_moments_do_not_depend_on_the_blocks_they_are_taken_in(shape):
    ensembles = RNG(0).standard_normal((2 * BLOCK + 3, *shape))
    onward = MomentsRecorder(len(ensembles), shape[1])
    for cycle, ensemble in enumerate(ensembles):
        onward.put(cycle, ensemble, 2.0)
    whole = onward.moments()
    assert whole.mean == pytest.approx(ensembles.mean(axis=1), abs=1e-14)
    assert whole.std == pytest.approx(2 * ensembles.std(axis=1, ddof=1), rel=1e-13)
    single = MomentsRecorder(len(ensembles), shape[1])
    for cycle, ensemble in enumerate(ensembles[:9]):
        single.put(cycle, ensemble, 2.0)
        assert np.array_equal(single.moments().std[: cycle + 1], whole.std[: cycle + 1])
    resumed = MomentsRecorder(len(ensembles), shape[1], single.moments().until(9))
    for cycle in range(9, len(ensembles)):
        resumed.put(cycle, ensembles[cycle], 2.0)
    for a, b in ((resumed.moments().mean, whole.mean), (resumed.moments().std, whole.std)):
        assert np.array_equal(a, b)


def test_update():
    ensemble, rows = 5 + RNG(0).standard_normal((6, 150)), RNG(1).standard_normal((6, 6))
    mean, anomalies = centre(ensemble)
    expected = mean + rows @ anomalies
    assert apply_weights(ensemble, rows) == pytest.approx(expected, abs=1e-13)
    assert apply_weights(expected, rows[:2]).shape == (2, 150)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 2.9, 3.1, 1e3])
def test_both_decompositions_give_the_same_analysis(scale):
    """Below GRAM_LIMIT eigenvectors of SᵀS, above it the SVD of S; both against plain linear algebra."""
    s = scale * centre(RNG(0).standard_normal((10, 40)))[1].T
    hessian, g = Hessian.of(s), RNG(1).standard_normal(10)
    assert (np.linalg.norm(s.T @ s) / 9 <= GRAM_LIMIT) == (scale < 1.5)
    a = 9 * np.eye(10) + s.T @ s
    # a textbook solve loses eps · cond(A), most of it at the largest scale
    tolerance = 1e-13 * max(1.0, np.linalg.cond(a) / 100)
    assert hessian.solve(g) == pytest.approx(np.linalg.solve(a, g), rel=tolerance, abs=tolerance)
    t = hessian.transform
    assert t @ t == pytest.approx(9 * np.linalg.inv(a), abs=tolerance)
    singular = np.linalg.svd(s, compute_uv=False)
    assert hessian.singular_values[:9] == pytest.approx(singular[:9], rel=1e-12)
    assert hessian.singular_values[9] < 1e-6 * scale * 10


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("count", [2, 7, 40])
def test_decomposition_in_a_span_and_of_few_observations(count, scale):
    """S = s Uᵀ: from s, from the smaller Gram matrix or the SVD of S; against plain linear algebra."""
    basis = np.linalg.qr(RNG(0).standard_normal((12, 3)))[0]
    s = scale * RNG(1).standard_normal((count, 3))
    whole, a = s @ basis.T, 11 * np.eye(12) + basis @ s.T @ s @ basis.T
    g, tolerance = RNG(2).standard_normal((4, 12)), 1e-13 * max(1.0, np.linalg.cond(a) / 100)
    for hessian in (Hessian.of(s, basis), Hessian.of(whole)):
        assert hessian.solve(g) == pytest.approx(np.linalg.solve(a, g.T).T, rel=tolerance, abs=tolerance)
        assert hessian.norm(g[0]) == pytest.approx(np.sqrt(g[0] @ a @ g[0]), rel=1e-13)
        t = hessian.transform
        assert t @ t == pytest.approx(11 * np.linalg.inv(a), abs=tolerance)


@pytest.mark.parametrize("shape", [(16, 40), (40, 25), (40, 40)])
@pytest.mark.parametrize("bound", [0.0, 1e-3, 0.12, 0.13, 0.5, 0.999, 1.001, 50.0])
def test_root_near_the_prior_is_that_of_the_decomposition(shape, bound):
    """Up to (Σ λ⁴)^{1/4} = 1 of M = SᵀS/(N − 1) takes the series, beyond it the eigenvectors; both to rounding."""
    s = centre(RNG(0).standard_normal(shape).T)[1].T
    s *= np.sqrt(bound * (shape[1] - 1) / np.linalg.norm(s.T @ s @ s.T @ s) ** 0.5)
    near, exact, g = NearPrior.of(s), Hessian.of(s), RNG(1).standard_normal((3, shape[1]))
    assert isinstance(near, NearPrior) == (bound < 1)
    assert near.transform == pytest.approx(exact.transform, abs=1e-14)
    for rows in (g[0], g, RNG(2).standard_normal((shape[1], shape[1]))):
        assert near.solve(rows) == pytest.approx(exact.solve(rows), rel=1e-13, abs=1e-15)
    assert near.transform @ np.ones(shape[1]) == pytest.approx(np.ones(shape[1]), abs=1e-13)


def test_gaspari_cohn():
    """Values of eq. 4.10 at whole and half radii, smoothness at the joints, positive definiteness on a circle."""
    z = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, -0.5])
    value = gaspari_cohn(2.5 * z, 2.5)
    assert value == pytest.approx([1, 0.6848958333, 5 / 24, 0.0164930556, 0, 0, 0.6848958333], abs=1e-9)
    h = 1e-5
    for joint in (1.0, 2.0):
        left, here, right = gaspari_cohn(joint + h * np.array([-1, 0, 1]), 1.0)
        assert abs((right - here) - (here - left)) < 1e-8
    positions = np.arange(40.0)
    matrix = gaspari_cohn(distances(positions, positions, 40.0), 5.0)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12


def test_distances_on_line_and_circle():
    a, b = np.array([0.0, 9.0]), np.array([1.0, 8.0])
    assert distances(a, b).tolist() == [[1, 8], [8, 1]]
    assert distances(a, b, 10.0).tolist() == [[1, 2], [2, 1]]


def evaluation(n_members=6, p=12):
    spread = centre(RNG(0).standard_normal((n_members, p)))[1]
    return Evaluation(RNG(1).standard_normal(p), spread.T)


def test_without_taper_the_local_analysis_is_the_global_one():
    ensemble, e = RNG(2).standard_normal((6, 12)), evaluation()
    step = gauss_newton(np.zeros(6), e)
    expected = apply_weights(ensemble, step.direction + step.transform)
    for size in (1, 5, 12):
        blocks = [np.arange(i, min(i + size, 12)) for i in range(0, 12, size)]
        local = BlockLocalisation(blocks, np.ones((len(blocks), 12)))
        assert local.analysis(ETKF(), ensemble, e, None) == pytest.approx(expected, abs=1e-12)


def test_local_analysis_sees_what_is_near():
    positions = np.arange(12.0)
    ensemble, e = RNG(2).standard_normal((6, 12)), evaluation()
    local = BlockLocalisation.on_line(positions, positions, radius=1.5, period=12.0)
    analysed = local.analysis(ETKF(), ensemble, e, None)
    far = e.d.copy()
    far[3:10] += 100.0  # 3 or more away from variable 0, around the circle
    changed = local.analysis(ETKF(), ensemble, Evaluation(far, e.S), None)
    assert np.array_equal(changed[:, 0], analysed[:, 0])
    assert np.all(np.abs(changed[:, 1:11] - analysed[:, 1:11]).max(axis=0) > 1e-3)
    # by hand for one variable: error variances divided by the taper
    taper = gaspari_cohn(distances(positions[:1], positions, 12.0), 1.5)[0]
    root = np.sqrt(taper)
    step = gauss_newton(np.zeros(6), Evaluation(root * e.d, root[:, None] * e.S))
    by_hand = apply_weights(ensemble[:, :1], step.direction + step.transform)
    assert analysed[:, :1] == pytest.approx(by_hand, abs=1e-12)


@dataclass(frozen=True)
class Perturbing(ETKF):
    """The mean moves by innovations that are perturbed."""

    def advance(self, weights, evaluation, iteration, draw):
        perturbed = Evaluation(evaluation.d + draw("test")[0], evaluation.S)
        return gauss_newton(weights.w, perturbed)


def test_a_local_analysis_perturbs_each_observation_in_one_way():
    """A scheme that draws sees the numbers of its observations, the same ones in every block."""
    positions, draws = np.arange(12.0), RNG(3).standard_normal((6, 12))
    ensemble, e = RNG(2).standard_normal((6, 12)), evaluation()
    local = BlockLocalisation([np.arange(6), np.arange(6, 12)], (distances(np.array([2.0, 9.0]), positions) < 5) * 1.0)
    expected = local.analysis(ETKF(), ensemble, Evaluation(e.d + draws[0], e.S), None)
    assert local.analysis(Perturbing(), ensemble, e, lambda purpose: draws) == pytest.approx(expected, abs=1e-13)


def test_variables_without_position_or_observation_stay():
    positions = np.array([0.0, 1.0, np.nan, 50.0])
    local = BlockLocalisation.on_line(positions, np.array([0.0, 1.0]), radius=2.0, block_size=2)
    assert [block.tolist() for block in local.blocks] == [[0, 1], [3]]
    ensemble = RNG(2).standard_normal((6, 4))
    analysed = local.analysis(ETKF(), ensemble, evaluation(p=2), None)
    assert np.array_equal(analysed[:, 2:], ensemble[:, 2:])
    assert not np.allclose(analysed[:, :2], ensemble[:, :2])


def test_variables_without_a_place_see_the_mean_of_the_blocks():
    """By hand; what has no spread and where there is nothing to see stays to the bit."""
    positions, members = np.arange(12.0), RNG(2).standard_normal((6, 14))
    members[:, 13] = 0.1
    plain = BlockLocalisation.on_line(positions, positions, radius=1.5, period=12.0)
    local, e = plain.with_placeless(np.array([12, 13])), evaluation()
    assert (plain.without_place.tolist(), local.without_place.tolist()) == ([], [12, 13])
    analysed = local.analysis(ETKF(), members, e, None)
    assert np.array_equal(analysed[:, :12], plain.analysis(ETKF(), members, e, None)[:, :12])
    root = np.sqrt(plain.taper.mean(axis=0))
    step = gauss_newton(np.zeros(6), Evaluation(root * e.d, root[:, None] * e.S))
    wider = np.sqrt(5 / (np.sum(step.transform**2) - 1))
    by_hand = apply_weights(members[:, 12:], step.direction + wider * step.transform)
    assert analysed[:, 12:] == pytest.approx(by_hand, abs=1e-12)
    unseen = local.analysis(ETKF(), np.full((6, 14), 0.1), e, None)
    assert np.array_equal(unseen, np.full((6, 14), 0.1))


def test_chance_takes_no_spread_of_what_has_no_place():
    """Variables that have nothing to do with the observations keep their variance, on average of 4000 of them."""
    members, e = RNG(4).standard_normal((6, 4000)), evaluation()
    local = BlockLocalisation([np.empty(0, dtype=int)], np.ones((1, 12))).with_placeless(np.arange(4000))
    analysed = local.analysis(ETKF(), members, e, None)
    assert np.mean(np.var(analysed, axis=0)) == pytest.approx(np.mean(np.var(members, axis=0)), rel=0.03)
    alone = apply_weights(members, gauss_newton(np.zeros(6), e).weights.rows)
    assert np.mean(np.var(alone, axis=0)) < 0.5


def test_what_has_no_place_is_not_perturbed():
    """Beside a field that the stochastic EnKF analyses it has the symmetric root."""
    members, e, noise = RNG(2).standard_normal((6, 14)), evaluation(), RNG(3).standard_normal((6, 12))
    local = BlockLocalisation.on_line(np.arange(12.0), np.arange(12.0), 1.5).with_placeless(np.array([12, 13]))
    perturbed, root = (local.analysis(scheme, members, e, lambda purpose: noise) for scheme in (EnKF(), ETKF()))
    assert np.array_equal(perturbed[:, 12:], root[:, 12:])
    assert np.all(np.std(perturbed[:, :12] - root[:, :12], axis=0) > 0.01)


@pytest.mark.parametrize("periodic", [False, True])
def test_localisation_on_a_grid(periodic):
    """The taper between all cells, by hand; a grid of one row is the line."""
    where = np.arange(2, 14)  # the field lies behind two other variables
    local = BlockLocalisation.on_grid(where, (3, 4), 1.5, periodic)
    for a in range(12):
        for b in range(12):
            gap = np.abs(np.subtract(divmod(a, 4), divmod(b, 4)))
            if periodic:
                gap = np.minimum(gap, np.array([3, 4]) - gap)
            assert local.taper[a, b] == pytest.approx(float(gaspari_cohn(np.hypot(*gap), 1.5)), abs=1e-15)
    assert np.concatenate(local.blocks).tolist() == where.tolist()
    row, index = BlockLocalisation.on_grid(np.arange(6), (6,), 1.5, periodic), np.arange(6.0)
    line = BlockLocalisation.on_line(index, index, 1.5, 6.0 if periodic else None)
    assert np.array_equal(row.taper, line.taper)
