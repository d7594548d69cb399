"""The Markov chain: its own diagnostics on series with known answers, and the refinement of a skewed posterior."""

from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Decay, make_problem

from en4dvar.diagnosis.analysis import ChainRecord, IterationRecord
from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.executor import ThreadsExecutor
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import PriorTerm
from en4dvar.sampling import mcmc
from en4dvar.schemes.settings import AssimilationSettings


def autoregressive(steps, chains, phi, seed=0):
    """x_t = φ x_{t−1} + e: effective sample size steps · chains (1 − φ)/(1 + φ)."""
    noise = np.random.default_rng(seed).standard_normal((steps, chains, 1))
    x = np.empty_like(noise)
    x[0] = noise[0] / np.sqrt(1 - phi**2)
    for t in range(1, steps):
        x[t] = phi * x[t - 1] + noise[t]
    return x


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9, -0.4])
def test_effective_sample_size_of_an_autoregressive_series(phi):
    x = autoregressive(4000, 8, phi)
    assert mcmc.effective_sample_size(x)[0] == pytest.approx(32000 * (1 - phi) / (1 + phi), rel=0.1)


def test_r_hat_sees_drift_and_separation():
    x = autoregressive(1000, 6, 0.3)
    assert mcmc.split_r_hat(x)[0] == pytest.approx(1, abs=0.01)
    drift = x + np.linspace(-2, 2, 1000)[:, None, None]
    apart = x + np.arange(6)[:, None]
    # halves at ±1 about the mean (1.07² their own variance and that of the slope), chains at 0…5: variance 3.5
    assert mcmc.split_r_hat(drift)[0] > 1.2
    assert mcmc.split_r_hat(apart)[0] == pytest.approx(
        np.sqrt(1 + np.arange(6).var(ddof=0) * 12 / 11 / x.var()), rel=0.02
    )


def test_chain_of_a_gaussian_and_its_thinning():
    cov = np.array([[1.0, 0.8], [0.8, 1.0]])
    precision = np.linalg.inv(cov)
    start = np.random.default_rng(1).standard_normal((48, 2)) * 0.5 + 1.0  # wrong in mean and spread
    density = lambda x: -0.5 * np.einsum("bi,ij,bj->b", x, precision, x)  # noqa: E731
    chain = mcmc.sample(density, start, 3, max_steps=6000, target=4000)
    assert chain.converged
    assert np.all(np.abs(chain.flat.mean(axis=0)) < 0.06)
    assert np.cov(chain.flat.T) == pytest.approx(cov, abs=0.08)
    shift, ratio = chain.off
    assert shift > 0.5
    assert ratio < 1 / 1.5
    assert chain.summary()["mcmc_largest_spread_ratio"] == 1 / ratio
    draws = chain.thin(48, exact=True)
    assert draws.mean(axis=0) == pytest.approx(chain.flat.mean(axis=0), abs=0.01)
    assert np.cov(draws.T) == pytest.approx(np.cov(chain.flat.T), abs=0.03)
    plain = chain.thin(48)
    assert len(np.unique(plain[:, 0])) > 40
    assert {tuple(row) for row in (*plain, *draws)} <= {tuple(row) for row in chain.flat}


def test_an_interrupt_in_the_density_passes_in_silence(capfd):
    """emcee's own wrapper would print every position and a traceback."""
    calls = iter(range(1000))

    def density(x):
        if next(calls) == 5:
            raise KeyboardInterrupt
        return -0.5 * np.sum(x * x, axis=1)

    with pytest.raises(KeyboardInterrupt):
        mcmc.sample(density, np.random.default_rng(0).standard_normal((20, 2)), seed=1)
    assert capfd.readouterr() == ("", "")


def test_a_density_that_vanishes_is_an_error():
    with pytest.raises(En4dvarError, match="cannot run 48 of 48 walkers"):
        mcmc.sample(lambda x: np.full(len(x), -np.inf), np.eye(5), 1)


def test_a_chain_too_short_says_so():
    chain = mcmc.sample(
        lambda x: -0.5 * np.sum(x**2, axis=1), np.random.default_rng(0).standard_normal((9, 2)), 1, max_steps=60
    )
    assert not chain.converged
    assert "has not converged after 60 steps" in chain.warning()


def skewed():
    model = Decay()
    a, b = model.parameters
    terms = (PriorTerm.lognormal(a, 1.2, 0.5), PriorTerm.lognormal(b, 1.0, 0.9))
    return make_problem(model, [1.5, 1.2], std=0.4, prior=terms, k=6)


@pytest.mark.slow
def test_refinement_reaches_the_posterior_that_no_gaussian_fits():
    problem = skewed()
    axes = [m + s * np.linspace(-6, 6, 121) for m, s in zip(problem.prior.mean, problem.prior.std, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    p = np.exp(log_posterior(problem, grid))
    p /= p.sum()
    mean = p @ grid
    std = np.sqrt(p @ (grid - mean) ** 2)

    plain = assimilate(problem, AssimilationSettings(), 1)
    refined = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    x, z = (problem.prior.from_physical(a.posterior) for a in (plain, refined))
    assert np.max(np.abs(z.mean(axis=0) - mean) / std) < 0.1
    assert np.max(np.abs(z.std(axis=0, ddof=1) / std - 1)) < 0.07
    assert np.max(np.abs(x.mean(axis=0) - mean) / std) > 0.15  # the plain ensemble is visibly off
    assert refined.refinement["mcmc_converged"]
    assert refined.refinement["mcmc_effective_sample_size"] > 1000
    assert refined.forward_runs > plain.forward_runs
    assert np.array_equal(refined.centre, plain.centre)


def test_refinement_has_the_same_bits_for_any_workers(monkeypatch):
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 20})
    problem, settings = make_problem(Decay(compiled=True), [1.5, 1.2]), AssimilationSettings(members=12, refine="mcmc")
    heard = []
    one = assimilate(problem, settings, 1, progress=lambda name, record: heard.append(record))
    iterations = [record.iteration for record in heard if isinstance(record, IterationRecord)]
    assert iterations == list(range(len(one.iterations)))
    end = ChainRecord(20, one.refinement["mcmc_r_hat"], one.refinement["mcmc_effective_sample_size"])
    assert heard[-1] == end
    with ThreadsExecutor(2) as executor:
        assert_same_bits(assimilate(problem, settings, 1, executor), one)
    assert any("has not converged" in warning for warning in one.warnings)
    other = assimilate(problem, settings, 2)
    assert not np.array_equal(other.posterior, one.posterior)
    plain = assimilate(problem, replace(settings, refine="none"), 1)
    assert plain.refinement == {}
