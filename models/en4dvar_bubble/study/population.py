r"""The population behind the data sets: mean and between-bubble spread of each parameter.

    x_i ~ N(ν, diag τ²)   (transformed coordinates: ln G, ln α, ln μ, ln R0),     data_i ~ L_i(x_i)

with L_i of :mod:`~en4dvar_bubble.study.gaussian`. Stacking the per-set posteriors instead counts the prior once a set
and so returns it where single sets are hardly informative. Integrating x_i out, with D = diag τ²,

    ln p(data_i | ν, τ) = c_i − ½ ln|I + D Λ_i| + ½ η_iᵀ D (I + Λ_i D)⁻¹ η_i + h_iᵀ ν − ½ νᵀ P_i ν,
    P_i = (I + Λ_i D)⁻¹ Λ_i,   h_i = (I + Λ_i D)⁻¹ η_i,

which is Gaussian in ν: τ is sampled with ν integrated out, then ν given τ exactly. Coordinates that are no property of
the population (the time shift) keep their prior as ν and τ. Weak hyperpriors: ν ~ N(prior mean, ``mean_std``²),
τ ~ half-normal(``spread``).

τ: two halves of an ensemble of chains propose from each other's differences (ter Braak 2006, differential evolution).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior, member_stream
from en4dvar.state import Array
from en4dvar_bubble.study.gaussian import Factors


@dataclass(frozen=True)
class HyperPrior:
    """Standard deviation of ν and scale of τ in transformed coordinates, and the length of the chains."""

    mean_std: float = 1.0
    spread: float = 0.5
    chains: int = 24
    steps: int = 1200
    burn_in: int = 400


@dataclass(frozen=True)
class Population:
    """Draws of ν and τ (M, p) in transformed coordinates, of the parameters ``names``."""

    names: tuple[str, ...]
    prior: Prior
    nu: Array
    tau: Array

    @property
    def mean(self) -> Array:
        """(M, p) draws of the population mean, physical: exp(ν + τ²/2) of a lognormal, ν of a normal.

        Raises
        ------
        ValueError: a logit prior, which has no closed mean.
        """
        return self._moments()[0]

    @property
    def std(self) -> Array:
        """(M, p) draws of the between-bubble standard deviation, physical."""
        return self._moments()[1]

    def interval(self, level: float = 0.95) -> Array:
        """(2, p) central interval of the population mean."""
        tail = (1 - level) / 2
        return np.asarray(np.quantile(self.mean, (tail, 1 - tail), axis=0))

    def _moments(self) -> tuple[Array, Array]:
        mean, std = self.nu.copy(), self.tau.copy()
        for j, name in enumerate(self.names):
            transform = self.prior.terms[self.prior.names.index(name)].transform
            if transform == "logit":
                raise ValueError(f"{name}: the population mean of a logit prior has no closed form")
            if transform == "lognormal":
                mean[:, j] = np.exp(self.nu[:, j] + self.tau[:, j] ** 2 / 2)
                std[:, j] = mean[:, j] * np.sqrt(np.expm1(self.tau[:, j] ** 2))
        return mean, std


def estimate_population(
    likelihoods: Factors, prior: Prior, names: Sequence[str], seed: int, hyper: HyperPrior | None = None
) -> Population:
    """Sample the population of ``names`` given the likelihood factors of the sets.

    Raises
    ------
    ValueError: fewer than 3 sets.
    """
    hyper = hyper or HyperPrior()
    if len(likelihoods.constant) < 3:
        raise ValueError("a population needs at least 3 data sets")
    posterior = _Posterior(likelihoods, [likelihoods.names.index(name) for name in names], hyper)
    stream = member_stream(seed, "population")
    log_tau = _sample(posterior, stream, hyper)
    _, mean, covariance = posterior(log_tau)
    root = np.linalg.cholesky(covariance)
    nu = mean + np.einsum("mij,mj->mi", root, stream.standard_normal(mean.shape))
    return Population(tuple(names), prior, nu, np.exp(log_tau))


def population_log_evidence(
    likelihoods: Factors, prior: Prior, names: Sequence[str], seed: int, hyper: HyperPrior | None = None
) -> float:
    """ln p(all data) of a model whose parameters ``names`` vary about a common mean, hyperpriors included.

    Importance sampling of ln τ by a Student t (5 degrees of freedom) of the draws' mean and twice their covariance.
    """
    hyper = hyper or HyperPrior()
    posterior = _Posterior(likelihoods, [likelihoods.names.index(name) for name in names], hyper)
    stream = member_stream(seed, "population evidence")
    draws = _sample(posterior, stream, hyper)
    p, degrees, count = draws.shape[1], 5, 4000
    centre, root = draws.mean(axis=0), np.linalg.cholesky(2 * np.cov(draws, rowvar=False).reshape(p, p))
    normal = stream.standard_normal((count, p))
    scale = np.sqrt(degrees / stream.chisquare(degrees, count))[:, None]
    proposal = centre + (normal * scale) @ root.T
    log_q = (
        math.lgamma((degrees + p) / 2) - math.lgamma(degrees / 2) - p / 2 * math.log(degrees * math.pi)
        - np.sum(np.log(np.diag(root))) - (degrees + p) / 2 * np.log1p(np.sum((normal * scale) ** 2, axis=1) / degrees)
    )  # fmt: skip
    blocks = [posterior(proposal[i : i + 100])[0] for i in range(0, count, 100)]
    weights = np.concatenate(blocks) - log_q
    return float(posterior.constant + np.logaddexp.reduce(weights) - math.log(count))


class _Posterior:
    """p(ln τ | data) with ν integrated out, and the Gaussian of ν given τ."""

    def __init__(self, likelihoods: Factors, where: list[int], hyper: HyperPrior):
        self.of, self.where, self.hyper = likelihoods, where, hyper
        self.others = [j for j in range(len(likelihoods.names)) if j not in where]
        start = likelihoods.prior_mean[where] / hyper.mean_std
        half_normal = 0.5 * math.log(2 / math.pi) - math.log(hyper.spread)
        # what does not depend on τ: of the likelihoods, of the density of ν, of that of τ
        self.constant = float(
            likelihoods.constant.sum() - 0.5 * start @ start - len(where) * math.log(hyper.mean_std)
            + len(where) * half_normal
        )  # fmt: skip

    def __call__(self, log_tau: Array) -> tuple[Array, Array, Array]:
        """Log density (B,), mean (B, p) and covariance (B, p, p) of ν, at ln τ (B, p)."""
        of, p = self.of, len(self.where)
        n = len(of.names)
        variance = np.broadcast_to(of.prior_std**2, (len(log_tau), n)).copy()
        variance[:, self.where] = np.exp(2 * log_tau)
        M = np.eye(n) + of.precision[None] * variance[:, None, None, :]  # I + ΛD, (B, S, n, n)
        right = np.concatenate([of.precision, of.linear[..., None]], axis=2)
        solved = np.linalg.solve(M, np.broadcast_to(right, (len(log_tau), *right.shape)))
        P, h = solved[..., :n].sum(axis=1), solved[..., n].sum(axis=1)
        total = -0.5 * np.linalg.slogdet(M)[1].sum(axis=1)
        total += 0.5 * np.einsum("si,bi,bsi->b", of.linear, variance, solved[..., n])
        # coordinates with a known ν
        fixed = of.prior_mean[self.others]
        P_ff, P_pf = P[:, self.others][:, :, self.others], P[:, self.where][:, :, self.others]
        total += h[:, self.others] @ fixed - 0.5 * np.einsum("i,bij,j->b", fixed, P_ff, fixed)
        start = of.prior_mean[self.where]
        precision = P[:, self.where][:, :, self.where] + np.eye(p) / self.hyper.mean_std**2
        linear = h[:, self.where] - P_pf @ fixed + start / self.hyper.mean_std**2
        covariance = np.linalg.inv(precision)
        covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
        mean = np.einsum("bij,bj->bi", covariance, linear)
        total += 0.5 * np.einsum("bi,bi->b", linear, mean) - 0.5 * np.linalg.slogdet(precision)[1]
        # half-normal τ; the Jacobian of ln τ is τ
        total += np.sum(log_tau - 0.5 * np.exp(2 * log_tau) / self.hyper.spread**2, axis=1)
        return total, mean, covariance


def _sample(posterior: _Posterior, stream: np.random.Generator, hyper: HyperPrior) -> Array:
    """Draws of ln τ (M, p) after the burn-in, every tenth step of every chain."""
    p, half = len(posterior.where), hyper.chains // 2
    chains = math.log(0.5 * hyper.spread) + 0.5 * stream.standard_normal((2, half, p))
    density = np.stack([posterior(group)[0] for group in chains])
    kept = []
    for step in range(hyper.steps):
        jump = 1.0 if step % 10 == 0 else 2.38 / math.sqrt(2 * p)  # now and then between modes
        for g in (0, 1):
            pairs = np.array([stream.choice(half, 2, replace=False) for _ in range(half)])
            difference = chains[1 - g][pairs[:, 0]] - chains[1 - g][pairs[:, 1]]
            proposal = chains[g] + jump * difference + 1e-3 * stream.standard_normal((half, p))
            new = posterior(proposal)[0]
            accept = np.log(stream.uniform(size=half)) < new - density[g]
            chains[g][accept], density[g][accept] = proposal[accept], new[accept]
        if step >= hyper.burn_in and step % 10 == 5:
            kept.append(chains.reshape(-1, p).copy())
    return np.concatenate(kept)
