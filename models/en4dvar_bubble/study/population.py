r"""The population behind the data sets: mean and between-bubble spread of each parameter.

    x_i ~ N(ν, diag τ²)   (transformed coordinates: ln G, ln α, ln μ, ln R0),     data_i ~ L_i(x_i)

Stacking the per-set posteriors instead counts the prior once a set and so returns it where single sets are hardly
informative. Here the prior enters once, as a hyperprior: ν ~ N(prior mean, ``mean_std``²), τ ~ half-normal(``spread``).
Coordinates that are no property of the population (the time shift) keep their prior.

The per-set likelihoods are curved sheets (the elastic stress determines one combination of G, α and R0), which no
Gaussian describes, so a Gaussian two-stage step goes astray. In stages, each corrected by the next:

1. forward runs of every set around its posterior under a wide interim prior; polynomial emulators on them;
2. interim posteriors on the emulators, as Gaussian mixtures with the interim prior divided out (Lunn et al. 2013, Stat.
   Med. 32, 4139, reweight the draws themselves, which fails where τ is small);
3. ν, τ by differential evolution with every x_i integrated out analytically, until R-hat and effective size suffice;
4. importance weights: for each (ν, τ) the marginal likelihood of every set from ``inner`` draws of x_i (Tran et al.
   2013, "IS²"), with the emulators, then with forward runs. What is returned is resampled by them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior, member_stream
from en4dvar.sampling.mcmc import effective_sample_size, split_r_hat
from en4dvar.state import Array
from en4dvar_bubble.study.emulator import Emulators, draw_interim, fit_emulators
from en4dvar_bubble.study.mixture import Mixtures, fit_mixtures
from en4dvar_bubble.study.set_runs import Runs, log_likelihood

SPREADS = (1e-3, 10.0)  # of τ; smaller ones are indistinguishable, and lost to rounding in the marginals
MAX_R_HAT = 1.1  # Gelman et al. (2013), Bayesian Data Analysis, § 11.5


@dataclass(frozen=True)
class HyperPrior:
    """Standard deviation of ν about the prior mean and scale of τ, in transformed coordinates."""

    mean_std: float = 1.0
    spread: float = 0.5


@dataclass(frozen=True)
class Effort:
    """How much is computed: forward runs a set and round of stage 1, mixture components, chain, importance draws."""

    walkers: int = 16
    rounds: int = 200
    degree: int = 4
    refits: int = 5
    components: int = 12
    chains: int = 32
    block: int = 500
    blocks: int = 8
    effective: float = 200.0
    draws: int = 2000
    inner: int = 24
    exact: int = 500


@dataclass(frozen=True)
class Population:
    """Draws of ν and τ (M, p) in transformed coordinates, of the parameters ``names``.

    ``r_hat`` and ``effective`` (2p,) judge the chain of stage 3 (ν, then ln τ); ``weighed`` are the effective sample
    sizes of the weights of stage 4, with emulators and with forward runs; ``log_evidence``: of all data, hyperpriors
    included, without Σ ln(std √2π).
    """

    names: tuple[str, ...]
    prior: Prior
    nu: Array
    tau: Array
    r_hat: Array
    effective: Array
    weighed: tuple[float, float]
    log_evidence: float
    forward_runs: int

    @property
    def converged(self) -> bool:
        """Whether chain and weights can be trusted: R-hat below 1.1, at least 100 effective draws in the end."""
        return bool(np.all(self.r_hat < MAX_R_HAT) and self.size >= 100)

    @property
    def size(self) -> float:
        """Effective number of draws behind the result: no more than the chain, the weights of either kind give."""
        return min(float(np.min(self.effective)), *self.weighed)

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
    runs: Runs,
    start: Array,
    prior: Prior,
    names: Sequence[str],
    seed: int,
    hyper: HyperPrior | None = None,
    effort: Effort | None = None,
) -> Population:
    """Sample the population of ``names`` given all data sets.

    Parameters
    ----------
    start: (S, N, n) control vectors near the posterior of each set (its ensemble); any rough ones will do.

    Raises
    ------
    ValueError: fewer than 3 sets, or too few successful runs about the best fit of one.
    """
    hyper, effort = hyper or HyperPrior(), effort or Effort()
    if len(start) < 3:
        raise ValueError("a population needs at least 3 data sets")
    where = [prior.names.index(name) for name in names]
    wide = prior.std.copy()
    wide[where] = math.hypot(hyper.mean_std, hyper.spread)  # what ν and τ allow
    emulators, count = _train(runs, start, prior.mean, wide, seed, effort)
    interim = draw_interim(emulators, prior.mean, wide, seed, count=60)
    mixtures = fit_mixtures(interim, prior.mean, wide, member_stream(seed, "mixtures"), effort.components)
    target = _Target(mixtures, prior, where, hyper)
    chain = _sample(target, member_stream(seed, "population"), effort)
    flat = chain.reshape(-1, chain.shape[2])
    h = flat[np.linspace(0, len(flat) - 1, effort.draws).astype(int)]
    stream = member_stream(seed, "weights")
    kept, weights, inner_evidence = _weigh(target, emulators, runs, h, stream, effort)
    picked = kept[np.searchsorted(np.cumsum(weights[1]), stream.uniform(size=effort.draws)).clip(max=len(kept) - 1)]
    p = len(where)
    return Population(
        tuple(names), prior, picked[:, :p], np.exp(picked[:, p:]), split_r_hat(chain), effective_sample_size(chain),
        (_effective(weights[0]), _effective(weights[1])), _log_evidence(target, h, stream) + inner_evidence,
        count + effort.exact * len(start),
    )  # fmt: skip


def _train(runs: Runs, start: Array, mean: Array, wide: Array, seed: int, effort: Effort) -> tuple[Emulators, int]:
    """Stage 1: walkers of each set under the interim prior; every forward run on the way is a training point."""
    stream = member_stream(seed, "interim runs")
    n_sets, n_members, n = start.shape
    half = effort.walkers // 2
    x = start[:, stream.permutation(n_members)[: 2 * half]].transpose(1, 0, 2).reshape(2, half, n_sets, n).copy()
    seen = runs.predictions(x.reshape(-1, n_sets, n))
    density = (log_likelihood(runs, seen) + _gauss(x.reshape(-1, n_sets, n), mean, wide)).reshape(2, half, n_sets)
    points, predictions, kept, sets = [], [], [], np.arange(n_sets)
    for step in range(effort.rounds):
        for g in (0, 1):
            a = stream.integers(half, size=(half, n_sets))
            b = (a + stream.integers(1, half, size=(half, n_sets))) % half
            jump = 1.0 if step % 10 == 0 else 2.38 / math.sqrt(2 * n) * (1.0 if step % 2 else 0.5)
            trial = x[g] + jump * (x[1 - g][a, sets] - x[1 - g][b, sets])
            trial = trial + 1e-3 * wide * stream.standard_normal(trial.shape)
            seen = runs.predictions(trial)
            new = log_likelihood(runs, seen) + _gauss(trial, mean, wide)
            better = np.log(stream.uniform(size=new.shape)) < new - density[g]
            x[g] = np.where(better[..., None], trial, x[g])
            density[g] = np.where(better, new, density[g])
            if step >= effort.rounds // 6:
                points.append(trial)
                predictions.append(seen)
                kept.append(x[g].copy())
    at, seen = np.concatenate(points).transpose(1, 0, 2), np.concatenate(predictions).transpose(1, 0, 2)
    draws = np.concatenate(kept).transpose(1, 0, 2)
    count, visited = (effort.rounds + 1) * 2 * half * n_sets, 0
    for number in range(effort.refits + 1):
        emulators = fit_emulators(at, seen, runs.values, runs.weight, draws, effort.degree, visited)
        if number < effort.refits:
            draws = draw_interim(emulators, mean, wide, seed + number, count=4)
            at = np.concatenate([at, draws], axis=1)
            told = np.concatenate([runs.predictions(part) for part in np.array_split(draws.transpose(1, 0, 2), 4)])
            seen = np.concatenate([seen, told.transpose(1, 0, 2)], axis=1)
            visited += draws.shape[1]
    return emulators, count + visited * n_sets


def _gauss(x: Array, mean: Array, std: Array) -> Array:
    return np.asarray(-0.5 * np.sum(((x - mean) / std) ** 2, axis=-1))


class _Target:
    """p(ν, ln τ | data) with all x_i integrated out over mixtures; h = (ν, ln τ)."""

    def __init__(self, mixtures: Mixtures, prior: Prior, where: list[int], hyper: HyperPrior):
        self.mixtures, self.prior, self.where, self.hyper = mixtures, prior, where, hyper
        self.start = prior.mean[where]
        p = len(where)
        self.constant = -p * (0.5 * math.log(2 * math.pi) + math.log(hyper.mean_std))
        self.constant += p * (0.5 * math.log(2 / math.pi) - math.log(hyper.spread))

    def population(self, h: Array) -> tuple[Array, Array]:
        """Mean and variance (B, n) of x given h (B, 2p)."""
        p = len(self.where)
        mean = np.tile(self.prior.mean, (len(h), 1))
        variance = np.tile(self.prior.std**2, (len(h), 1))
        mean[:, self.where], variance[:, self.where] = h[:, :p], np.exp(2 * h[:, p:])
        return mean, variance

    def __call__(self, h: Array) -> Array:
        """(B,) log density, normalised but for the likelihoods."""
        p = len(self.where)
        hyper = -0.5 * np.sum(((h[:, :p] - self.start) / self.hyper.mean_std) ** 2, axis=1)
        hyper += np.sum(h[:, p:] - 0.5 * np.exp(2 * h[:, p:]) / self.hyper.spread**2, axis=1)
        inside = np.all((h[:, p:] > math.log(SPREADS[0])) & (h[:, p:] < math.log(SPREADS[1])), axis=1)
        total = np.full(len(h), -np.inf)
        total[inside] = self.mixtures.log_marginal(*self.population(h[inside])) + hyper[inside] + self.constant
        return np.where(np.isnan(total), -np.inf, total)


def _sample(target: _Target, stream: np.random.Generator, effort: Effort) -> Array:
    """Stage 3: (steps, chains, 2p) after a quarter of burn-in."""
    p, half = len(target.where), effort.chains // 2
    spread = target.hyper.spread
    nu = target.start + 0.5 * stream.standard_normal((2, half, p))
    chains = np.concatenate([nu, math.log(0.6 * spread) + 0.5 * stream.standard_normal((2, half, p))], axis=2)
    density = np.stack([target(group) for group in chains])
    kept: list[Array] = []
    for block in range(effort.blocks):
        for step in range(effort.block):
            jump = 1.0 if step % 10 == 0 else 2.38 / math.sqrt(4 * p) * (1.0 if step % 2 else 0.5)
            for g in (0, 1):
                a = stream.integers(half, size=half)
                b = (a + stream.integers(1, half, size=half)) % half
                trial = chains[g] + jump * (chains[1 - g][a] - chains[1 - g][b])
                trial = trial + 1e-3 * stream.standard_normal(trial.shape)
                new = target(trial)
                better = np.log(stream.uniform(size=half)) < new - density[g]
                chains[g][better], density[g][better] = trial[better], new[better]
            kept.append(chains.reshape(-1, 2 * p).copy())
        chain = np.stack(kept[len(kept) // 4 :])
        enough = np.all(effective_sample_size(chain) >= effort.effective)
        if block and enough and np.all(split_r_hat(chain) < MAX_R_HAT):
            break
    return chain


def _weigh(
    target: _Target, emulators: Emulators, runs: Runs, h: Array, stream: np.random.Generator, effort: Effort
) -> tuple[Array, tuple[Array, Array], float]:
    """Stage 4: draws of h that were run (E, 2p), normalised weights of all and of those, ln of the mean weights."""
    mean, variance = target.population(h)
    logs, chosen = np.empty(len(h)), []
    for begin in range(0, len(h), 100):
        rows = slice(begin, begin + 100)
        x = target.mixtures.draw(stream, mean[rows], variance[rows], effort.inner)  # (b, J, S, n)
        flat = x.reshape(-1, *x.shape[2:])
        ratio = (emulators.log_likelihood(flat) - target.mixtures.log_density(flat)).reshape(x.shape[:3])
        top = ratio.max(axis=1, keepdims=True)
        of_draw = np.exp(ratio - top)
        logs[rows] = np.sum(top[:, 0] + np.log(of_draw.mean(axis=1)), axis=1)
        share = np.cumsum(of_draw, axis=1)
        pick = np.argmax(share > stream.uniform(size=(x.shape[0], 1, x.shape[2])) * share[:, -1:], axis=1)
        chosen.append(np.take_along_axis(x, pick[:, None, :, None], axis=1)[:, 0])
    weights, middle = _normalised(logs)
    where = np.searchsorted(np.cumsum(weights), (np.arange(effort.exact) + stream.uniform()) / effort.exact)
    where = where.clip(max=len(h) - 1)
    x = np.concatenate(chosen)[where]
    exact = np.concatenate([log_likelihood(runs, runs.predictions(x[i : i + 50])) for i in range(0, len(x), 50)])
    of_exact, correction = _normalised(np.sum(exact - emulators.log_likelihood(x), axis=1))
    return h[where], (weights, of_exact), middle + correction


def _normalised(logs: Array) -> tuple[Array, float]:
    """Weights that add up to one, and ln of their mean before."""
    top = float(logs.max())
    weights = np.exp(logs - top)
    return weights / weights.sum(), top + math.log(float(weights.mean()))


def _effective(weights: Array) -> float:
    return float(1 / np.sum(weights**2))


def _log_evidence(target: _Target, h: Array, stream: np.random.Generator, count: int = 2000) -> float:
    """ln ∫ of the target by importance sampling from a Student t (5 degrees of freedom) about its draws."""
    d, degrees = h.shape[1], 5
    centre, root = h.mean(axis=0), np.linalg.cholesky(np.cov(h, rowvar=False))
    normal = stream.standard_normal((count, d))
    scale = np.sqrt(degrees / stream.chisquare(degrees, count))[:, None]
    proposal = centre + (normal * scale) @ root.T
    log_q = (
        math.lgamma((degrees + d) / 2) - math.lgamma(degrees / 2) - d / 2 * math.log(degrees * math.pi)
        - np.sum(np.log(np.diag(root))) - (degrees + d) / 2 * np.log1p(np.sum((normal * scale) ** 2, axis=1) / degrees)
    )  # fmt: skip
    return float(np.logaddexp.reduce(target(proposal) - log_q) - math.log(count))
