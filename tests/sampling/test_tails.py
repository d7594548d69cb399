"""Posteriors that are not Gaussian, of plain functions, against quadrature: sampled if these are cheap, else told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy import stats

import en4dvar
from en4dvar import ConfigError, Field, ForwardModel, Observable, Parameter, StateField, StateLayout

EIGHT = np.linspace(0.2, 3, 8)
DECAYED = np.exp(-0.8 * EIGHT) + 0.1 * np.random.default_rng(2).standard_normal(8)
ONE = np.array([1.0])


class Bent(NamedTuple):
    """A function of k and t, its readings and their error, the prior of k in words and in numbers, and where it is."""

    function: Callable[[Any, Any], Any]
    times: np.ndarray
    values: Any
    error: float
    prior: dict[str, Any]
    density: Any
    reach: tuple[float, float]


def decay(k, t):
    return np.exp(-k * t)


def normal(mean, std):
    return {"prior": "normal", "mean": mean, "std": std}, stats.norm(mean, std), (mean - 6 * std, mean + 6 * std)


def lognormal(median, std):
    return {"prior": "lognormal", "median": median, "log_std": std}, stats.lognorm(std, scale=median), (1e-6, 200.0)


def uniform(low, high):
    return {"prior": "uniform", "lower": low, "upper": high}, stats.uniform(low, high - low), (low, high)


BETA = {"prior": "beta", "lower": 0, "upper": 2, "alpha": 0.5, "beta": 0.5}
CASES = {
    "wider than its prior says in ln k": Bent(decay, ONE, [0.02], 0.1, *lognormal(1, 1)),
    "a prior with two horns": Bent(decay, EIGHT, DECAYED, 0.3, BETA, stats.beta(0.5, 0.5, 0, 2), (1e-9, 2 - 1e-9)),
    "saturated": Bent(lambda k, t: np.tanh(k) + 0 * t, ONE, [1.0], 0.05, *normal(0, 2)),
    "flat": Bent(lambda k, t: k**3 + 0 * t, ONE, [0.0], 0.2, *normal(0.5, 1)),
    "flat on one side": Bent(lambda k, t: np.maximum(k - 0.5, 0) + 0 * t, ONE, [0.0], 0.1, *normal(0, 1)),
    "steep on one side": Bent(
        lambda k, t: np.where(k > 0.5, 0.2, 5.0) * (k - 0.5) + 0 * t, ONE, [0.1], 0.2, *normal(0, 1)
    ),
    "a step": Bent(lambda k, t: 1.0 * (k > 0.5) + 0 * t, ONE, [1.0], 0.2, *normal(0, 1)),
    "many steps": Bent(
        lambda k, t: np.floor(10 * k) / 10 * t, np.array([1.0, 2, 3]), [1.0, 2.0, 3.0], 0.1, *normal(0, 1)
    ),
}


def exact(case):
    """Mean and standard deviation of the posterior."""
    k = np.linspace(*case.reach, 400_001)
    residuals = sum((y - case.function(k, t)) ** 2 for t, y in zip(case.times, case.values, strict=True))
    logs = case.density.logpdf(k) - 0.5 * residuals / case.error**2
    shares = np.exp(logs - logs.max())
    mean = np.average(k, weights=shares)
    return mean, np.sqrt(np.average((k - mean) ** 2, weights=shares))


def estimated(case, seed=1, members=48, **more):
    return en4dvar.estimate(
        lambda p, t: case.function(p["k"], t), (case.times, np.array(case.values)), {"k": case.prior},
        error=case.error, seed=seed, progress=False, assimilation={"members": members}, **more,
    )  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_cheap_function_is_sampled(name):
    """1500 effective draws and 48 members of heavy tails tell a standard deviation to about a tenth."""
    mean, std = exact(CASES[name])
    found = estimated(CASES[name], cheap=True)
    k = found.posterior["k"].values.ravel()
    assert found.sample_stats.attrs["importance_draws"] > 0
    assert k.mean() == pytest.approx(mean, abs=0.1 * std)
    assert k.std(ddof=1) == pytest.approx(std, rel=0.2)
    assert "ensemble-collapse" not in found.sample_stats.attrs["warning_codes"]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_of_another_function_it_is_told(name, seed):
    mean, std = exact(CASES[name])
    found = estimated(CASES[name], seed)
    k = found.posterior["k"].values.ravel()
    assert abs(k.mean() - mean) > 0.5 * std or abs(k.std(ddof=1) / std - 1) > 0.3
    codes = found.sample_stats.attrs["warning_codes"].split()
    assert "non-gaussian" in codes or "several-modes" in codes


@pytest.mark.parametrize("seed", [105, 135, 140, 148, 149])
def test_a_tail_along_which_the_cost_hardly_rises_is_told(seed):
    """Of a decay that was over before the second reading, against quadrature: no member is where k is large."""
    rng, t = np.random.default_rng(seed), np.arange(4.0)
    while True:
        a, k = np.exp(rng.standard_normal(2))
        if 1 < a < 4 and 0.5 < k < 3:
            break
    y = a * np.exp(-k * t) + 0.3 * rng.standard_normal(4)
    ln_a, ln_k = np.linspace(-2, 3, 251)[:, None], np.linspace(-5, 5, 501)
    logs = -0.5 * (ln_a**2 + ln_k**2)
    for at, value in zip(t, y, strict=True):
        logs = logs - 0.5 * ((value - np.exp(ln_a - np.exp(ln_k) * at)) / 0.3) ** 2
    shares = np.exp(logs - logs.max()).sum(axis=0)
    found = en4dvar.estimate(
        lambda p, t: p["a"] * np.exp(-p["k"] * t), (t, y), {name: lognormal(1, 1)[0] for name in "ak"},
        error=0.3, seed=seed, progress=False,
    )  # fmt: skip
    beyond = np.exp(ln_k) > np.quantile(found.posterior["k"].values, 0.95)
    assert shares[beyond].sum() > 0.15 * shares.sum()
    (told,) = (c for c in found.cautions if c.code == "non-gaussian")
    assert "k" in told.parameters


@pytest.mark.slow
@pytest.mark.parametrize("seed", [78, 99, 120])
def test_the_upper_end_of_a_growth_that_is_seen_to_its_bend_is_told_or_sampled(seed):
    """Of a logistic growth, against draws of the prior: how far it goes has a long tail, along a bent way."""
    rng, t = np.random.default_rng(seed), np.linspace(0.5, 10, 12)

    def grown(p, t):
        return p["M"] / (1 + np.exp(-p["r"] * (t - p["m"])))

    def drawn(rng, count):
        m, r, middle = rng.standard_normal((3, count))
        return {"M": 3 * np.exp(0.5 * m), "r": np.exp(0.7 * r), "m": 8 + 3 * middle}

    y = grown(drawn(rng, 1), t) + 0.25 * rng.standard_normal(12)
    many = drawn(np.random.default_rng(1), 400_000)
    logs = -0.5 * sum((value - grown(many, at)) ** 2 for at, value in zip(t, y, strict=True)) / 0.25**2
    shares, m = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum(), many["M"]
    order, std = np.argsort(m), np.sqrt(shares @ (m - shares @ m) ** 2)
    end = np.interp(0.95, np.cumsum(shares[order]), m[order])
    priors = {"M": lognormal(3, 0.5)[0], "r": lognormal(1, 0.7)[0], "m": normal(8, 3)[0]}

    def estimated(**more):
        return en4dvar.estimate(grown, (t, y), priors, error=0.25, seed=seed, progress=False, **more)

    of_members = estimated()
    assert end - np.quantile(of_members.posterior["M"].values, 0.95) > 0.7 * std
    (told,) = (c for c in of_members.cautions if c.code == "non-gaussian")
    assert "M" in told.parameters
    assert of_members.sample_stats.attrs["tail_q95_M"] == pytest.approx(end, abs=0.5 * std)
    sampled = estimated(cheap=True)
    assert sampled.sample_stats.attrs["importance_draws"] > 0
    row = next(row for row in sampled.rows if row.name == "M")
    assert row.q95 == pytest.approx(end, abs=0.5 * std)


def test_what_is_told_is_what_the_posterior_is():
    """Weights of many members, against quadrature."""
    case = CASES["wider than its prior says in ln k"]
    mean, std = exact(case)
    told = estimated(case, members=1000).sample_stats.attrs
    assert told["tail_mean_k"] == pytest.approx(mean, abs=0.1 * std)
    assert told["tail_std_k"] == pytest.approx(std, rel=0.15)


@pytest.mark.parametrize("name", ["a step", "many steps"])
def test_few_members_do_not_tell_what_it_should_be(name):
    """One to fourteen of them count; by one alone the spread of many steps would be 0.01 where it is 0.03."""
    found = estimated(CASES[name])
    (told,) = (c for c in found.cautions if c.code == "non-gaussian")
    assert found.sample_stats.attrs["tail_members"] < 20
    assert np.isnan(found.sample_stats.attrs["tail_std_k"])
    assert "members count: too few to say what these should be" in told.words
    assert "should be about" not in told.words
    assert told.severity == "serious"  # most of the posterior is where the ensemble is not


@pytest.mark.slow
@pytest.mark.parametrize("seed", [102, 0, 17, 147])
def test_the_edge_of_a_step_is_never_quoted_for_its_plateau(seed):
    """Of a whole number n, against the closed form: the lowest minimum is the narrow edge of a step, and another
    descent ends on a plateau, which holds almost all of the posterior.
    """
    rng, t, n = np.random.default_rng(7 * seed + 5), np.linspace(0.5, 10, 12), np.arange(1, 7)
    truth = rng.uniform(0.5, 6.5), rng.standard_normal()
    y = np.round(truth[0]) * t / 10 + truth[1] + 0.5 * rng.standard_normal(12)
    logs = stats.multivariate_normal(np.zeros(12), 0.25 * np.eye(12) + 1).logpdf(y - n[:, None] * t / 10)
    shares = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    mean, std = shares @ n, np.sqrt(shares @ (n - shares @ n) ** 2 + 1 / 12)

    def whole(**more):
        return en4dvar.estimate(
            lambda p, t: np.round(p["n"]) * t / 10 + p["b"], (t, y),
            {"n": uniform(0.5, 6.5)[0], "b": normal(0, 1)[0]}, error=0.5, seed=seed, progress=False, **more,
        )  # fmt: skip

    edge = whole()
    assert edge.posterior["n"].values.std() < 0.2 * std
    assert all(row.untrusted for row in edge.rows)
    assert all("seed" not in c.advice for c in edge.cautions)
    assert any(c.severity == "serious" and "set assimilation.refine: mcmc" in c.advice for c in edge.cautions)
    for sampled in (whole(assimilation={"refine": "mcmc"}), whole(cheap=True)):
        values = sampled.posterior["n"].values.ravel()
        assert values.mean() == pytest.approx(mean, abs=0.2 * std)
        assert values.std(ddof=1) == pytest.approx(std, rel=0.2)


class Driven(ForwardModel):
    """x' = −0.3 x + u, whose u may vary."""

    parameters = Parameter("x0", "m"), Parameter("u", "m/s")
    layout = StateLayout((Field("x", unit="m"), Field("u", unit="m/s")))
    observables = (Observable("x", "m", StateField("x")),)

    def initial_state(self, theta):
        return np.array([theta["x0"], theta["u"]])

    def step(self, state, t0, t1):
        left = np.exp(-0.3 * (t1 - t0))
        return np.array([left * state[0] + state[1] * (1 - left) / 0.3, state[1]])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_an_estimated_width_of_changes_is_never_gaussian(seed):
    """Against the closed form, integrated over the width; weights of 2, 20 and 28 members told 0.08 to 0.14 as its
    standard deviation, or nothing at all.
    """
    rng, knots = np.random.default_rng(seed), np.array([3.0, 6.0, 9.0])
    t = np.sort(rng.uniform(0.1, 9.9, 17)).round(2)
    driven = [(1 - np.exp(-0.3 * np.maximum(t - at, 0))) / 0.3 for at in (0, *knots)]
    slopes = np.stack([np.exp(-0.3 * t), *driven], axis=1)
    y = slopes @ np.array([2.3, 0.8, 0.9, -0.2, 0.1]) + 0.2 * rng.standard_normal(17)
    widths = (np.arange(1500) + 0.5) / 500
    covariances = [slopes @ np.diag([1, 0.25, q, q, q]) @ slopes.T + 0.04 * np.eye(17) for q in widths**2]
    logs = [stats.multivariate_normal.logpdf(y, slopes[:, :2] @ [2, 1], c) for c in covariances]
    shares = np.exp(logs - np.max(logs) - 0.5 * (widths / 0.5) ** 2)
    shares /= shares.sum()
    mean = shares @ widths
    std = np.sqrt(shares @ (widths - mean) ** 2)
    found = en4dvar.estimate(
        Driven, (t, y),
        {
            "x0": {"prior": "normal", "mean": "2 m", "std": "1 m"},
            "u": {"prior": "normal", "mean": "1 m/s", "std": "0.5 m/s", "varies": {"every": "3 s", "std": "estimated"}},
        },
        error="0.2 m", seed=seed, progress=False,
    )  # fmt: skip
    own = found.posterior["u_change_std"].values
    assert own.mean() - mean > 0.5 * std
    assert own.std(ddof=1) > 1.3 * std
    (told,) = (c for c in found.cautions if c.code == "non-gaussian")
    assert "should be about" not in told.words
    assert "refine: mcmc" in told.advice
    assert "declare the model cheap" in told.advice


@pytest.mark.parametrize(
    ("n", "members"),
    [(1, 16), *(pytest.param(*case, marks=pytest.mark.slow) for case in [(12, 16), (1, 200), (12, 48)])],
)
def test_a_linear_function_is_neither_sampled_nor_doubted(n, members):
    """Weights of the posterior and of the ensemble are the same, so that nothing hangs on what was drawn."""
    names, slopes = [f"k{i}" for i in range(n)], np.random.default_rng(5).standard_normal((40, n)) / np.sqrt(n)
    for seed in range(5):
        y = slopes @ np.random.default_rng(seed).standard_normal(n) + np.random.default_rng(-seed % 99).standard_normal(
            40
        )
        found = en4dvar.estimate(
            lambda p, t: slopes @ [p[name] for name in names], (np.arange(40.0), y),
            {name: {"prior": "normal", "mean": 0, "std": 1} for name in names},
            error=1.0, seed=seed, progress=False, cheap=True, assimilation={"members": members},
        ).sample_stats.attrs  # fmt: skip
        assert "importance_draws" not in found
        assert (found["tail_shift"], found["tail_ratio"]) == pytest.approx((0, 1), abs=1e-6)
        assert found["tail_excess"] == 0
        assert "tail_end" not in found


@pytest.mark.slow
def test_a_curve_that_the_readings_tell_is_not_doubted():
    """Of 200 curves of three parameters, known from twenty readings, none is."""
    t, doubted = np.linspace(0, 60, 20), 0
    priors = {
        "hot": {"prior": "normal", "mean": 90, "std": 5},
        "k": {"prior": "lognormal", "median": 0.03, "log_std": 0.7},
        "room": {"prior": "normal", "mean": 21, "std": 1},
    }
    for seed in range(200):
        rng = np.random.default_rng([seed, 77])
        z = rng.standard_normal(3)
        hot, k, room = 90 + 5 * z[0], 0.03 * np.exp(0.7 * z[1]), 21 + z[2]
        y = room + (hot - room) * np.exp(-k * t) + 0.5 * rng.standard_normal(20)
        found = en4dvar.estimate(
            lambda p, t: p["room"] + (p["hot"] - p["room"]) * np.exp(-p["k"] * t), (t, y), priors,
            error=0.5, seed=seed, progress=False,
        )  # fmt: skip
        doubted += "non-gaussian" in found.sample_stats.attrs["warning_codes"]
    assert doubted == 0


def test_a_model_says_itself_whether_it_is_cheap():
    with pytest.raises(ConfigError, match="cheap: it is said of a function"):
        en4dvar.estimate("bubble", (ONE, ONE), {}, error=1.0, cheap=True)


def test_a_scheme_that_is_not_the_posterior_is_not_called_non_gaussian():
    t = np.linspace(0, 1, 20)
    priors = {name: {"prior": "normal", "mean": 0, "std": 1} for name in "ab"}
    found = en4dvar.estimate(
        lambda p, t: p["a"] + p["b"] * t, (t, 1 + t), priors,
        error=0.1, progress=False, assimilation={"scheme": "denkf"},
    )  # fmt: skip
    (said,) = (w for w in found.warnings if "effective share" in w)
    assert "half of the gain" in said
    assert "far from Gaussian" not in said


def test_a_scheme_whose_ensemble_is_twice_as_wide_says_so():
    """A parameter that is known four times as well as before; the effective share of the members is above a half."""
    t = np.arange(1.0)
    found = en4dvar.estimate(
        lambda p, t: p["a"] + 0 * t, (t, 1 + t), {"a": {"prior": "normal", "mean": 0, "std": 1}},
        error=0.25, progress=False, assimilation={"scheme": "denkf"},
    )  # fmt: skip
    exact = 1 / np.sqrt(1 + 1 / 0.25**2)
    assert found.posterior["a"].values.std(ddof=1) > 1.3 * exact
    assert found.sample_stats.attrs["gaussian_fit"] > 0.5
    assert "non-gaussian" in found.sample_stats.attrs["warning_codes"]


@pytest.mark.parametrize("seed", [0, 4])
def test_units_do_not_make_a_linear_posterior_doubtful(seed):
    """A parameter of some 1e-12 beside one of some 1e9, correlated in the posterior."""
    times, scales = np.linspace(0, 4, 30), dict(zip("abcd", (1e-12, 1e9, 1.0, 1e-3), strict=True))
    waves = dict(zip("abcd", (np.ones(30), times, np.cos(3 * times), times**2), strict=True))
    noise = 0.3 * np.random.default_rng(seed).standard_normal(30)
    result = en4dvar.estimate(
        lambda p, t: sum(p[name] / scale * waves[name] for name, scale in scales.items()), (times, 3 * times + noise),
        {name: {"prior": "normal", "mean": scale, "std": 2 * scale} for name, scale in scales.items()}, error=0.3,
        assimilation={"members": 200}, seed=seed,
    )  # fmt: skip
    assert result.sample_stats.attrs["tail_ratio"] == pytest.approx(1, abs=1e-3)
    assert "non-gaussian" not in {caution.code for caution in result.cautions}
