"""Evidence of single data sets: closed forms, quadrature, a spike beside the mode that holds the probability."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling import evidence as evidence_module
from en4dvar.sampling.evidence import DRAWS, ENOUGH, MOST_ROUNDS, sampled_evidence


def prior_of(mean, std):
    parameters = [Parameter(f"x{j}", unit="1") for j in range(len(mean))]
    return Prior(tuple(PriorTerm(p, "normal", m, s) for p, m, s in zip(parameters, mean, std, strict=True)))


class Runs:
    """Readings of std 1/√weight, of sets that count the forward runs made."""

    def __init__(self, values, weight):
        self.values, self.weight, self.count = values, weight, np.zeros(len(values), dtype=int)

    def predictions(self, x, sets=None):
        sets = np.arange(len(self.values)) if sets is None else sets
        self.count[sets] += len(x)
        return np.stack([self.model(x[:, j], s) for j, s in enumerate(sets)], axis=1)


class Linear(Runs):
    def __init__(self, n_sets=6, k=5, n=4):
        rng = np.random.default_rng(0)
        self.H = 10.0 ** np.linspace(-1, 1.5, n_sets)[:, None, None] * rng.standard_normal((n_sets, k, n))
        super().__init__(rng.standard_normal((n_sets, k)), np.full((n_sets, k), 1 / 0.09))

    def model(self, x, s):
        return x @ self.H[s].T

    def exact(self, mean, std):
        """ln p(y) of every set, as sampled_evidence counts it."""
        covariances = self.H @ np.diag(std**2) @ self.H.transpose(0, 2, 1) + 0.09 * np.eye(5)
        densities = [multivariate_normal(h @ mean, c) for h, c in zip(self.H, covariances, strict=True)]
        logs = [density.logpdf(y) for density, y in zip(densities, self.values, strict=True)]
        return np.array(logs) + 5 * np.log(0.3 * np.sqrt(2 * np.pi))


class Spiked(Runs):
    """L = exp(−½|x − 1|²/0.01²) + 0.6 exp(−½|x + 1|²/0.4²): J is lowest in the first, the probability in the second."""

    parts = ((1.0, 1.0, 0.01), (0.6, -1.0, 0.4))

    def __init__(self):
        super().__init__(np.zeros((1, 1)), np.ones((1, 1)))

    def model(self, x, s):
        logs = [np.log(a) - 0.5 * np.sum((x - c) ** 2, axis=-1) / w**2 for a, c, w in self.parts]
        return np.sqrt(np.maximum(-2 * np.logaddexp(*logs), 0.0))[:, None]

    def exact(self):
        return sum(a * (np.sqrt(2 * np.pi) * w * norm(c, np.hypot(1, w)).pdf(0.0)) ** 2 for a, c, w in self.parts)


def test_linear_sets_weak_and_sharp():
    runs, mean, std = Linear(), np.array([0.5, -0.5, 0.2, 0.0]), np.array([0.8, 1.2, 0.9, 0.3])
    found = sampled_evidence(runs, prior_of(mean, std), seed=1)
    assert found.log == pytest.approx(runs.exact(mean, std), abs=0.25)
    assert np.all(found.effective >= ENOUGH)
    assert runs.count[0] < runs.count[-1] <= MOST_ROUNDS * DRAWS  # the weak one was done sooner
    again = sampled_evidence(Linear(), prior_of(mean, std), seed=1)
    assert np.array_equal(found.log, again.log)


def test_too_few_effective_draws_are_drawn_again(monkeypatch):
    monkeypatch.setattr(evidence_module, "MOST_ROUNDS", 8)
    monkeypatch.setattr(evidence_module, "DRAWS", 120)
    mean, std = np.zeros(4), np.ones(4)
    monkeypatch.setattr(evidence_module, "TOO_FEW", 0.0)
    once = sampled_evidence(Linear(), prior_of(mean, std), seed=1)
    monkeypatch.setattr(evidence_module, "TOO_FEW", 100.0)
    runs = Linear()
    found = sampled_evidence(runs, prior_of(mean, std), seed=1)
    again = once.effective < 100
    assert 0 < again.sum() < 6
    assert np.array_equal(runs.count > 8 * 120, again)
    assert np.array_equal(found.log[~again], once.log[~again])
    assert np.all(found.effective[again] > once.effective[again])
    exact = runs.exact(mean, std)
    assert found.log[again] == pytest.approx(exact[again], abs=0.4)
    assert np.max(np.abs(found.log - exact)) < np.max(np.abs(once.log - exact))


def test_the_wide_mode_counts_not_the_lowest_spike():
    runs, prior = Spiked(), prior_of([0.0, 0.0], [1.0, 1.0])
    found = [float(sampled_evidence(runs, prior, seed).log[0]) for seed in range(5)]
    assert found == pytest.approx([np.log(runs.exact())] * 5, abs=0.2)
    laplace = np.log(2 * np.pi * 0.01**2) + norm.logpdf(1.0) * 2  # at the lowest J
    assert laplace < min(found) - 5


def test_a_set_that_cannot_be_run_has_no_evidence():
    class Lost(Linear):
        def model(self, x, s):
            return np.where(s == 2, np.nan, super().model(x, s))

    found = sampled_evidence(Lost(), prior_of(np.zeros(4), np.ones(4)), seed=1)
    assert found.log[2] == -np.inf
    assert found.effective[2] == 0
    assert np.isfinite(np.delete(found.log, 2)).all()
