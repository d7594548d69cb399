"""Modes that draws show by themselves: groups with nothing between them."""

import numpy as np
import pytest

from en4dvar import estimate
from en4dvar.descent.minima import Minimum
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling.modes import belonging, separated

PRIOR = Prior(tuple(PriorTerm.normal(Parameter(name, "m"), 0.0, 1.0) for name in "ab"))


def test_needles_between_two_minima_do_not_join_them():
    """Draws of five, of weights from 5 to 40 %, and light ones everywhere; minima of the first and the fourth."""
    random = np.random.default_rng(1)
    at, counts = np.array([-1.0, -0.4, 0.1, 0.5, 1.2]), [120, 60, 15, 75, 30]
    needle = np.append(np.repeat(np.arange(5), counts), np.full(300, -1))
    x = np.column_stack([at[needle] + 0.01 * random.standard_normal(600), random.standard_normal(600)])
    x[needle < 0, 0] = random.uniform(-2, 2, 300)
    shares = np.where(needle < 0, 1e-5, 1.0) / (300 + 300e-5)
    minima = [Minimum(np.array([at[i], 0.0]), np.diag([1e-4, 1.0]), float(i), (i,)) for i in (0, 3)]
    mode = belonging(PRIOR, minima, x, shares)
    own = [np.unique(mode[needle == i]) for i in range(5)]
    assert [len(numbers) for numbers in own] == [1] * 5
    assert [int(own[i][0]) for i in (0, 3)] == [0, 1]
    assert sorted(int(own[i][0]) for i in (1, 2, 4)) == [2, 3, 4]


SHAPES = {
    "Gaussian": lambda random, z: z,
    "uniform": lambda random, z: random.random(z.shape),
    "heavy tails": lambda random, z: z / np.sqrt(random.chisquare(2, (len(z), 1)) / 2),
    "skew": lambda random, z: np.exp(2 * z),
    "banana": lambda random, z: np.column_stack([z[:, 0], 5 * z[:, 0] ** 2 + 0.01 * z[:, 1]]),
    "ring": lambda random, z: z / np.linalg.norm(z, axis=1)[:, None],
    "one point as often as not": lambda random, z: np.where(random.random((len(z), 1)) < 0.5, z, z[:1] + 9),
}


@pytest.mark.parametrize("count", [60, 1000])
@pytest.mark.parametrize("shape", SHAPES)
def test_draws_of_one_mode_are_one_group(shape, count):
    """Of unequal weights; a walker that never moved is one draw."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        x = SHAPES[shape](random, random.standard_normal((count, 2)))
        weights = random.exponential(size=count) ** 2
        assert len(separated(x, weights / weights.sum())) == 1


@pytest.mark.parametrize("shape", ["Gaussian", "uniform"])
def test_a_gap_of_chance_is_as_rare_of_many_draws_and_coordinates(shape):
    """Of 3000 spaces in a set of equal weights one in 10 000 sets may show one."""
    for seed in range(400):
        random = np.random.default_rng(seed)
        x = SHAPES[shape](random, random.standard_normal((600, 5)))
        assert len(separated(x, np.full(600, 1 / 600))) == 1


def test_a_walker_that_creeps_in_a_tail_is_no_mode():
    """One of four leaves for 50 steps, of a chain of which 100 are worth a draw."""
    random = np.random.default_rng(2)
    x = random.standard_normal((4000, 2))
    x[1000:1050] = np.array([30.0, 0.0]) + 1e-3 * np.cumsum(random.standard_normal((50, 2)), axis=0)
    minima, equal = [Minimum(np.zeros(2), np.eye(2), 0.0, (0,))], np.full(4000, 1 / 4000)
    assert belonging(PRIOR, minima, x, equal).any()
    assert not belonging(PRIOR, minima, x, equal, 100.0).any()


@pytest.mark.slow
def test_modes_that_no_descent_ended_in_are_told(monkeypatch):
    """sin 3x is known to 3 %: needles all over the prior, of which one is known."""
    monkeypatch.setattr("en4dvar.estimation.assimilate.that_count", lambda minima, prior: minima[:1])
    monkeypatch.setattr("en4dvar.estimation.stages.in_doubt", lambda *_: True)
    prior = {name: {"prior": "normal", "mean": 0.0, "std": std} for name, std in (("x", 1.5), ("z", 1.0))}
    curve = lambda p, t: np.where(t < 9, p["z"], np.sin(3 * p["x"]) + 0.15 * p["x"])  # noqa: E731
    t = np.arange(18.0)
    result = estimate(curve, (t, np.where(t < 9, 0.3, 0.2)), prior, error=0.1, cheap=True, seed=0, progress=False)
    (told,) = (c for c in result.cautions if c.code == "several-modes")
    assert told.parameters == ("x",)
    modes = result.dataset("sample_stats")
    assert modes["mode_weight"].values.sum() == pytest.approx(1)
    assert modes["mode_descents"].values[0] > 0
    assert not modes["mode_descents"].values[1:].any()
    assert np.isfinite(modes["mode_cost"].values).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 7])
def test_of_a_cheap_function_an_alias_is_found(seed):
    """The frequency of a sine read once a second: 30 % of the posterior, by a sum over a grid, is below 3."""
    random = np.random.default_rng(7)
    t = np.sort(1 + np.arange(14) + 0.05 * random.standard_normal(14))
    basis = lambda w, t: np.c_[np.cos(w * t), np.sin(w * t), np.ones(len(t)), (t - 7) / 7]  # noqa: E731
    stds = np.array([1.0, 1.0, 1.0, 0.5])
    slopes, w = stds * random.standard_normal(4), 4 + random.standard_normal()
    y = basis(w, t) @ slopes + 0.25 * random.standard_normal(14)
    prior = {"w": {"prior": "normal", "mean": 4.0, "std": 1.0}}
    prior |= {name: {"prior": "normal", "mean": 0.0, "std": float(s)} for name, s in zip("abcd", stds, strict=True)}
    curve = lambda p, t: basis(p["w"], t) @ np.array([p[name] for name in "abcd"])  # noqa: E731
    result = estimate(curve, (t, y), prior, error=0.25, cheap=True, seed=seed, progress=False)
    assert np.mean(result.posterior["w"].values < 3) == pytest.approx(0.30, abs=0.05)
