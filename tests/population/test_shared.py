"""Shared parameters: all data sets of one gel fitted together, and where no single gel fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from en4dvar.config import load_config
from en4dvar.config.build import build
from en4dvar.population import fit_shared
from en4dvar.prior import Prior, PriorTerm, member_stream
from en4dvar.sampling.forward_runs import ForwardRuns
from en4dvar.state import Parameter

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


class Linear:
    """y_i = H_i (u, v_i) + noise of std 0.3."""

    def __init__(self, n_sets=5, k=4):
        rng = np.random.default_rng(0)
        self.H = rng.standard_normal((n_sets, k, 3))
        self.weight = np.full((n_sets, k), 1 / 0.09)
        x = np.concatenate([np.full((n_sets, 2), (0.3, -1.0)), rng.standard_normal((n_sets, 1))], axis=1)
        self.values = np.einsum("skj,sj->sk", self.H, x) + 0.3 * rng.standard_normal((n_sets, k))

    def predictions(self, x):
        return np.einsum("skj,bsj->bsk", self.H, x)


def test_linear_case_is_the_evidence_of_all_data_at_once():
    runs, mean, std = Linear(), np.array([0.5, -0.5, 0.2]), np.array([0.8, 1.2, 0.9])
    bounds = (-np.inf, np.inf)
    parameters = [Parameter(name, "1", "normal", bounds, "", "") for name in "abc"]
    terms = [PriorTerm(p, "normal", m, s) for p, m, s in zip(parameters, mean, std, strict=True)]
    prior = Prior(tuple(terms))
    n_sets, k = runs.values.shape
    found = fit_shared(runs, np.tile(mean, (2, n_sets, 1)), prior, ["a", "b"])
    covariance = 0.09 * np.eye(n_sets * k)
    common = runs.H[:, :, :2].reshape(-1, 2)
    covariance += common @ np.diag(std[:2] ** 2) @ common.T
    for i in range(n_sets):
        rows = slice(i * k, (i + 1) * k)
        covariance[rows, rows] += std[2] ** 2 * np.outer(runs.H[i, :, 2], runs.H[i, :, 2])
    exact = multivariate_normal((runs.H @ mean).ravel(), covariance).logpdf(runs.values.ravel())
    assert found.log_evidence - n_sets * k * np.log(0.3 * np.sqrt(2 * np.pi)) == pytest.approx(exact, abs=1e-3)


def test_bubbles_of_one_gel_are_recognised_and_those_of_several_are_not():
    base = build(load_config(CONFIGS / "agarose_10_qlkv.yaml"))[:4]
    prior, stream = base[0].prior, member_stream(3, "one gel")
    truth = np.tile(prior.mean, (4, 1))
    truth[:, 3:] += 0.5 * prior.std[3:] * stream.standard_normal((4, 2))
    exact = ForwardRuns(base).predictions(truth[None])[0]
    problems = []
    for s, problem in enumerate(base):
        o = problem.observations
        values = exact[s, : len(o)] + o.std * stream.standard_normal(len(o))
        problems.append(replace(problem, observations=replace(o, values=values)))
    names, starts = ["G", "alpha", "mu"], np.tile(prior.mean, (1, 4, 1))
    one = fit_shared(ForwardRuns(problems), starts, prior, names)
    assert 0.5 < one.chi2_per_observation < 1.6
    assert one.common[2] == pytest.approx(0.15, rel=0.05)  # viscosity is what is told best
    several = fit_shared(ForwardRuns(base), starts, prior, names)  # the twin's bubbles differ in G, α and μ
    assert several.chi2_per_observation > 3
