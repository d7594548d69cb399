"""Populations side by side: what is common cancels as in linear Gaussian hierarchies that are solved whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from test_common_and_odd import HYPER, OF_A, OF_B, OF_D, STD, Shifted, likely, members
from toys import Vectorised, make_problem

from en4dvar.estimation.population.campaign import population_of
from en4dvar.estimation.population.contrast import Centre, drawn_together, knowing, line, without_pull
from en4dvar.priors.prior import Prior

DRAWS, SEEDS = 20_000, 4
SHARED = ("rho", "scale", "camera")
COMMON = [(0, 1), (1, 0, 2), (0, 1)]  # of each gel, in an order of its own; what the second alone has is a camera
TRUTHS, STDS = (1.0, 1.6, 3.1), (0.1, 0.2, 0.15)


def system(seed=3):
    """Rows of y = A u + noise over u = (ν of three gels, θ): bubbles feel θ by slopes that differ, and ν is free."""
    rng = np.random.default_rng(seed)
    theta, systems = rng.standard_normal(len(SHARED)), []
    for k, (common, std) in enumerate(zip(COMMON, STDS, strict=True)):
        A = np.zeros((6, 3 + len(SHARED)))
        A[:, k] = 1.0
        A[:, [3 + j for j in common]] = np.array([0.5, 0.8 + 0.2 * k, 0.3])[list(common)]
        A[:, 3] += 0.3 * rng.standard_normal(6)
        y = A @ np.concatenate([TRUTHS, theta]) + std * rng.standard_normal(6)
        systems.append((A / std, y / std))
    return systems


def posterior(systems, where):
    """Mean and covariance of the unknowns ``where``, the prior of θ being N(0, I) and that of ν flat."""
    A, y = (np.concatenate(part) for part in zip(*systems, strict=True))
    A = A[:, where]
    C = np.linalg.inv(A.T @ A + np.diag([0.0 if j < 3 else 1.0 for j in where]))
    return C @ A.T @ y, C


def centres(systems, seed=5):
    """What each gel says by itself, as draws."""
    rng, found = np.random.default_rng(seed), []
    for k, (one, common) in enumerate(zip(systems, COMMON, strict=True)):
        mean, C = posterior([one], [k, *(3 + j for j in common)])
        u = rng.multivariate_normal(mean, C, DRAWS)
        found.append(Centre(u[:, 0], u[:, 1:], tuple(SHARED[j] for j in common)))
    return found


def test_populations_that_share_quantities_are_those_of_all_data_at_once():
    systems = system()
    x = drawn_together(centres(systems), 1)
    mean, C = posterior(systems, list(range(6)))
    std = np.sqrt(np.diag(C)[:3])
    assert np.abs(x.mean(axis=0) - mean[:3]).max() < 0.05 * std.max()
    np.testing.assert_allclose(np.cov(x.T), C[:3, :3], atol=0.04 * std.max() ** 2)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        exact = np.sqrt(C[i, i] + C[j, j] - 2 * C[i, j])
        assert (x[:, i] - x[:, j]).std() == pytest.approx(exact, rel=0.04)
    apart = np.hypot(std[0], std[2])  # were nothing common
    assert (x[:, 0] - x[:, 2]).std() < 0.7 * apart


def test_quantities_of_their_own_do_not_cancel():
    alone = [replace(c, common=tuple((k, name) for name in c.common)) for k, c in enumerate(centres(system()))]
    x = drawn_together(alone, 1)
    for k, centre in enumerate(alone):
        assert x[:, k].mean() == pytest.approx(centre.x.mean(), abs=0.03 * centre.x.std())
        assert x[:, k].std() == pytest.approx(centre.x.std(), rel=0.03)
    assert np.abs(np.corrcoef(x.T) - np.eye(3)).max() < 0.03


def test_the_pull_of_a_hyperprior_is_taken_away_where_the_data_can():
    """N(1, 0.5²) times the hyperprior N(0, 0.8²) is what is drawn."""
    precision = 0.5**-2 + 0.8**-2
    x = norm(0.5**-2 / precision, precision**-0.5).rvs(DRAWS, random_state=np.random.default_rng(2))
    nothing = np.empty((DRAWS, 0))
    freed = without_pull(0, x[:, None], nothing, (), 0.8, DRAWS, 1)
    assert not freed.pulled
    assert freed.x.mean() == pytest.approx(1.0, abs=0.03)
    assert freed.x.std() == pytest.approx(0.5, rel=0.05)
    silent = 0.8 * np.random.default_rng(2).standard_normal(DRAWS)
    assert without_pull(0, silent[:, None], nothing, (), 0.8, 400, 1).pulled


def test_a_calibrating_gel_narrows_the_others_as_all_data_at_once_do():
    """The first gel is known to 0.05, and what it tells of ρ and of the scale is told to the two others."""
    systems, value, std = system(), 1.02, 0.05
    of_known = np.zeros((1, 3 + len(SHARED)))
    of_known[0, 0] = 1 / std
    all_data = [*systems, (of_known, np.array([value / std]))]
    gels = centres(systems)
    both = knowing(np.column_stack([gels[0].x, gels[0].theta]), 0, value, std, 1)
    x = drawn_together([Centre(both[:, 0], both[:, 1:], gels[0].common), *gels[1:]], 1)
    mean, C = posterior(all_data, list(range(6)))
    without = np.sqrt(np.diag(posterior(systems, list(range(6)))[1]))
    exact = np.sqrt(np.diag(C))
    assert np.abs((x.mean(axis=0) - mean[:3]) / exact[:3]).max() < 0.05
    np.testing.assert_allclose(x.std(axis=0), exact[:3], rtol=0.05)
    assert np.all(exact[:3] < 0.75 * without[:3])  # else nothing would have been calibrated


class Steeper(Shifted):
    """The same with three times the slope of d."""

    def initial_state(self, theta):
        return super().initial_state({**theta, "d": 3 * theta["d"]})


def gel(model, slope, truths, seed):
    """Data sets with b = 0.4, and d = 0.3 in all."""
    problems = []
    for s, a in enumerate(truths):
        one = make_problem(Vectorised(), (a + slope * 0.3, 0.4), std=STD, seed=seed + s, k=6 + s % 3)
        observations = replace(one.observations, name=f"set{s}")
        problems.append(replace(one, model=model, observations=observations, prior=Prior((OF_A, OF_B, OF_D))))
    return problems


def level(problems):
    """Mean and variance of m = ν + slope · d, of which alone the data tell: its prior is flat, τ is integrated out."""
    m, tau = np.linspace(-4, 6, 801), np.geomspace(1e-3, 3, 121)
    log = -0.5 * (tau / (0.9 * HYPER.spread)) ** 2 + np.zeros((len(m), 1))
    for best, variance in likely(problems).T:
        log = log + norm(best, np.sqrt(variance + tau**2)).logpdf(m[:, None])
    weights = np.exp(log - log.max()) * np.gradient(tau)
    weights = weights.sum(axis=1) / weights.sum()
    return weights @ m, weights @ m**2 - (weights @ m) ** 2


@pytest.fixture(scope="module")
def gels():
    """Two gels of one camera, whose moduli feel it by 0.5 d and by 1.5 d; of each its draws, of several seeds."""
    rng = np.random.default_rng(8)
    problems = [
        gel(Shifted(), 0.5, 1.0 + 0.2 * rng.standard_normal(8), 400),
        gel(Steeper(), 1.5, 0.4 + 0.2 * rng.standard_normal(6), 500),
    ]
    found = [[population_of(p, members(p), ["a"], seed, hyper=HYPER) for p in problems] for seed in range(SEEDS)]
    return problems, found


def medians(found, seed, known=()):
    """Draws (M, 2) of both medians; of the first what is ``known``."""
    each = [
        without_pull(0, f.posterior.nu, f.theta, f.common, HYPER.mean_std, f.size, seed, of_it)
        for f, of_it in zip(found, (known, ()), strict=True)
    ]
    return OF_A.mean + OF_A.std * drawn_together(each, seed)


@pytest.mark.slow
def test_two_gels_of_one_camera_whose_moduli_feel_it_differently(gels):
    """ν_A − ν_B = m_A − m_B − (slope_A − slope_B) d, where the data leave d to its prior.

    Of one seed the slopes are read from some 200 draws of each data set, whose noise tells of d what no data say.
    """
    (of_a, var_a), (of_b, var_b) = map(level, gels[0])
    std = np.sqrt(var_a + var_b + (1.0 * OF_D.std) ** 2)
    apart = np.hypot(*(np.sqrt(v + (s * OF_D.std) ** 2) for v, s in ((var_a, 0.5), (var_b, 1.5))))
    drawn = np.array([x[:, 0] - x[:, 1] for x in (medians(f, seed) for seed, f in enumerate(gels[1]))])
    assert drawn.mean() == pytest.approx(of_a - of_b, abs=0.15 * std)
    assert drawn.std(axis=1).mean() == pytest.approx(std, rel=0.08)
    assert std < 0.85 * apart


@pytest.mark.slow
def test_a_gel_of_known_modulus_calibrates_the_camera(gels):
    """m_A = ν_A + 0.5 d tells d where ν_A is known, and ν_B = m_B − 1.5 d narrows; all in closed form but for the τ."""
    (of_a, var_a), (of_b, var_b) = map(level, gels[0])
    value, error = 1.0, 0.05
    told = (var_a + error**2) / 0.5**2
    of_d = 1 / (OF_D.std**-2 + 1 / told)
    mean, std = of_b - 1.5 * of_d / told * (of_a - value) / 0.5, np.sqrt(var_b + 1.5**2 * of_d)
    known = [(0, (value - OF_A.mean) / OF_A.std, error / OF_A.std)]
    drawn = np.array([medians(f, seed, known)[:, 1] for seed, f in enumerate(gels[1])])
    assert drawn.mean() == pytest.approx(mean, abs=0.15 * std)
    assert drawn.std(axis=1).mean() == pytest.approx(std, rel=0.08)
    before = np.array([medians(f, seed)[:, 1] for seed, f in enumerate(gels[1])])
    assert before.std(axis=1).mean() == pytest.approx(np.sqrt(var_b + (1.5 * OF_D.std) ** 2), rel=0.08)
    assert drawn.std() < 0.8 * before.std()


def test_a_line_through_populations():
    """Generalised least squares, whose exact covariance is (XᵀC⁻¹X)⁻¹; what leaves the line widens it."""
    rng, numbers = np.random.default_rng(1), np.array([5.0, 7.5, 10.0, 12.5])
    C = np.diag([0.1, 0.2, 0.1, 0.15]) ** 2 + 0.3**2
    draws = rng.multivariate_normal(np.zeros(4), C, DRAWS)
    draws -= draws.mean(axis=0)
    design = np.stack([np.ones(4), numbers], axis=1)
    exact = np.linalg.inv(design.T @ np.linalg.solve(C, design))
    straight = line(1.0 + 0.2 * numbers + draws, numbers)
    assert straight.slope.mean() == pytest.approx(0.2, abs=1e-9)
    assert straight.slope.std() == pytest.approx(np.sqrt(exact[1, 1]), rel=0.03)
    assert straight.level.std() == pytest.approx(np.sqrt(exact[0, 0]), rel=0.03)
    assert straight.misfit == pytest.approx(0.0, abs=1e-12)
    bent = line(0.2 * numbers + [0.5, -0.5, -0.5, 0.5] + draws, numbers)
    assert bent.chance < 1e-3
    assert bent.slope.std() == pytest.approx(np.sqrt(bent.misfit / 2) * straight.slope.std(), rel=1e-6)
    with pytest.raises(ValueError, match="two different numbers"):
        line(draws, np.full(4, 5.0))
