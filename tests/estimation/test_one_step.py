"""Schemes that take one step on a model for which one is not enough: what they say, and what sampling makes of it."""

import numpy as np
import pytest

import en4dvar
from en4dvar.schemes import MINIMISERS

PRIORS = {
    "r": {"prior": "normal", "mean": 0.5, "std": 0.2},
    "N0": {"prior": "lognormal", "median": 1, "log_std": 0.3},
}
LINE = {"s": {"prior": "normal", "mean": 0.5, "std": 0.3}, "N0": PRIORS["N0"]}
T = np.arange(0, 72, 8.0) / 24
Y = 1.3 * np.exp(0.35 * T) + 0.05 * np.random.default_rng(1).standard_normal(len(T))
EXACT = 9.25  # ln p(y) by quadrature on a grid


def growth(p, t):
    return p["N0"] * np.exp(p["r"] * t)


def line(p, t):
    return p["N0"] + p["s"] * t


def estimated(scheme, model=growth, priors=PRIORS, **keys):
    return en4dvar.estimate(model, (T, Y), priors, error=0.05, seed=1, assimilation={"scheme": scheme, **keys})


@pytest.fixture(scope="module")
def unfinished():
    return estimated("etkf")


def test_one_step_that_is_not_enough_is_told_with_a_scheme_that_iterates(unfinished):
    first, *others = unfinished.cautions
    assert first.code == "not-converged"
    assert "posterior standard deviations" in first.words
    assert first.advice.startswith(f"set assimilation.scheme: {MINIMISERS[0]}")
    for other in others:
        assert "discrepancy" not in other.advice
        assert "cheap" not in other.advice


@pytest.mark.parametrize("scheme", ["enkf", "enkf-n", "denkf"])
def test_so_of_any_scheme_that_does_not_iterate(scheme):
    assert estimated(scheme).cautions[0].code == "not-converged"


def test_enough_passes_or_a_linear_model_give_no_such_warning():
    assert not estimated("es-mda").cautions
    for scheme in ("etkf", "denkf"):
        told = en4dvar.estimate(
            lambda p, t: p["s"] * t, (T, 0.5 * T), {"s": LINE["s"]}, error=0.05, assimilation={"scheme": scheme}
        )
        assert "not-converged" not in [c.code for c in told.cautions]
        assert np.isfinite(told.sample_stats.attrs["log_evidence"])


def test_an_evidence_that_is_not_that_of_a_minimum_is_not_compared(unfinished):
    assert np.isnan(unfinished.sample_stats.attrs["log_evidence"])
    runs = {"growth": unfinished, "line": estimated(MINIMISERS[0], line, LINE), "again": estimated(MINIMISERS[0])}
    compared = en4dvar.compare_runs(runs)
    assert "evidence of growth is not known" in compared.verdict("data")
    probabilities = {score.run: score.probability for score in compared.scores}
    assert np.isnan(probabilities["growth"])
    assert probabilities["again"] == pytest.approx(1, abs=1e-3)


def test_after_sampling_all_that_is_said_is_of_what_was_sampled():
    sampled = estimated("etkf", refine="mcmc")
    stats = sampled.sample_stats.attrs
    assert not sampled.cautions
    assert stats["log_evidence"] == pytest.approx(EXACT, abs=0.1)
    assert 0.3 < stats["chi2_per_observation"] < 0.6  # of the minimum: 0.44
    assert np.isfinite(sampled.summary().q05["r"])
    other = estimated("etkf", line, LINE, refine="mcmc")
    compared = en4dvar.compare_runs({"growth": sampled, "line": other})
    assert compared.verdict("data").startswith("growth is preferred")
    reference = estimated(MINIMISERS[0], line, LINE).sample_stats.attrs["log_evidence"]
    assert other.sample_stats.attrs["log_evidence"] == pytest.approx(reference, abs=0.1)


def test_what_such_a_scheme_refuses_is_advised_with_one_that_takes_it():
    t = np.linspace(0, 3, 40)
    bent = en4dvar.estimate(
        lambda p, t: p["s"] * t, (t, t + np.sin(4 * t)), {"s": LINE["s"]}, error=0.5, assimilation={"scheme": "etkf"}
    )
    assert "residual-structure" in [c.code for c in bent.cautions]
    advice = " ".join(c.advice for c in bent.cautions)
    assert f"(data.error.discrepancy: estimated, with assimilation.scheme: {MINIMISERS[0]})" in advice
