r"""Mean ν and spread τ of a population from the likelihoods of its data sets, with common quantities and odd ones.

    x_i ~ (1 − ε) N(ν, diag τ²) + ε/2 π(x) + ε/2p Σ_j N(ν, diag τ² + σ² e_j e_jᵀ),
    θ ~ N(0, I),     data_i ~ L_i(y_i),     y_i = x_i − B θ, say

in white coordinates of the prior π. A data set is odd with probability ε (Hogg, Bovy & Lang 2010, arXiv:1008.4686):
then its parameters are drawn from the prior as if it belonged to no population, or one of them alone lies elsewhere, by
as much as medians of populations differ a priori (σ is that of ν's prior), as where the gel is stiffer or the law is
another one. So one bubble of another gel moves the mean little and widens the spread hardly; how probably each belongs
is part of the answer. Were an odd one always odd in all parameters, one that is so in G alone would have to be
improbable in the others, and would widen the spread instead. ε is :data:`DOUBTED` for a data set whose own warnings
say that its readings are wrong: with the usual ε it would count in full unless it errs by several error bars, and lost
frames, say, all err to one side. Where the warning was false this costs hardly more than leaving the data set out.
θ are quantities with one value in all data sets, whose uncertainty therefore no number of data sets averages out.

With L_i in units of its evidence (:mod:`~en4dvar.estimation.population.own`) the density of h = (ν, ln τ, θ) is

    p(h) Π_i [ (1 − ε) ∫ L_i(y) N(y; ν − B θ, τ²) dy + ε/2 + ε/2p Σ_j … ],

every integral in closed form; where y is another function of x (:mod:`~en4dvar.estimation.population.following`), with
mean and covariance of y. Walkers find where it is; a mixture of Student t distributions fitted to them is the
proposal, whose weighted draws are independent and give the evidence (adaptive importance sampling: Cappé et al. 2008,
Stat. Comput. 18, 447). A walker left behind in a secondary mode moves the proposal a little; the weights know what it
is worth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Lt

from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.estimation.population.own import Mixture, OwnLikelihood, condition, draw_conditioned, log_marginal
from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.mixture import StudentMixture
from en4dvar.sampling.walkers import walked

SPREADS = (1e-3, 10.0)  # of τ; smaller ones are indistinguishable, and lost to rounding in the marginals
FIT = 3000  # positions that the proposal is fitted to
DOUBTED = 0.9  # probability that a data set is odd whose own warnings say that its readings are wrong
RAISED, A_SET = 5.0, 0.25  # times more probably odd by its data, and times the number of sets: named


@dataclass(frozen=True)
class HyperPrior:
    """What is known beforehand of the mean ν and the spread τ of a population, h = (ν, ln τ): the standard deviation of
    ν about the prior mean and the scale of τ, in transformed coordinates; and of odd sets, their share.
    """

    mean_std: Annotated[
        float, Gt(0), "Hyperprior of the mean: normal about the prior's, with so many of its standard deviations."
    ] = 1.0
    spread: Annotated[
        float, Gt(0), "Hyperprior of the spread: half-normal, with so many of the prior's standard deviations."
    ] = 0.5
    odd: Annotated[
        float, Ge(0), Lt(1), "Probability that a data set is odd: of another population, in all parameters or in one."
    ] = 0.05

    def odd_before(self, doubted: Sequence[bool]) -> Array:
        """(S,) probabilities to be odd of data sets, some of which are ``doubted`` for what they say by themselves."""
        return np.where(doubted, max(DOUBTED, self.odd), self.odd) if self.odd else np.zeros(len(doubted))

    def log_density(self, nu: Array, log_tau: Array) -> Array:
        """(B,) of ν and ln τ (B, p), normalised; −inf where a spread is out of bounds."""
        p = nu.shape[1]
        constant = -p * (0.5 * math.log(2 * math.pi) + math.log(self.mean_std))
        constant += p * (0.5 * math.log(2 / math.pi) - math.log(self.spread))
        logs = -0.5 * np.sum((nu / self.mean_std) ** 2, axis=1)
        logs += np.sum(log_tau - 0.5 * np.exp(2 * log_tau) / self.spread**2, axis=1)
        inside = np.all((log_tau > math.log(SPREADS[0])) & (log_tau < math.log(SPREADS[1])), axis=1)
        return np.where(inside, logs + constant, -np.inf)

    def scattered(self, count: int, p: int, stream: np.random.Generator) -> Array:
        """(count, 2p) of ν and ln τ somewhere in the bulk of the hyperprior."""
        nu = 0.5 * self.mean_std * stream.standard_normal((count, p))
        return np.hstack([nu, math.log(0.6 * self.spread) + 0.5 * stream.standard_normal((count, p))])


@dataclass(frozen=True)
class Effort:
    """``hyper_`` walkers, their rounds, and components of the proposal fitted to them; ``draws`` of it that are
    weighed, ``effective`` ones wanted.
    """

    hyper_walkers: int = 64
    hyper_rounds: int = 60
    hyper_components: int = 6
    draws: int = 3000
    effective: float = 300.0


def named(belongs: Array, odd: Array | float) -> tuple[int, ...]:
    """Which data sets are to be named as odd, by the probabilities (S,) to belong: those whose odds, odd/(1 − odd)
    before, the data raise by more than S/4, and at least fivefold.

    The ratio of the odds is the best test of one data set against the others (Neyman & Pearson 1933); the bound grows
    with S as so many may be named by chance, and was set so that fewer than 5 % of campaigns of 12 without an odd one
    name one (``benchmarks/campaigns.py power``). Were a probability of one half asked, half of the bubbles of four
    times the modulus would be missed, as a wider spread explains them as well.
    """
    if not np.all(odd):
        return ()
    with np.errstate(divide="ignore"):
        raised = (1 - belongs) / belongs * (1 - odd) / odd
    return tuple(np.flatnonzero(raised > max(RAISED, A_SET * len(belongs))).tolist())


@dataclass(frozen=True)
class HierarchyDraws:
    """Draws of ν and τ (M, p), θ (M, c), and of y_i (M, S, p) given them; ``belongs`` (S,) the probabilities
    that the data sets are of the population; ``effective`` draws and ``log_evidence`` in units of the sets' own.
    ``uncertain`` (S,): variance over these draws of the error that the ln of each likelihood has by its own draws.
    """

    nu: Array
    tau: Array
    theta: Array
    x: Array
    belongs: Array
    effective: float
    log_evidence: float
    uncertain: Array


class Hierarchy:
    """The posterior density of h = (ν, ln τ, θ). ``odd`` (S,): how probably each data set is odd, if not as ``scales``
    say.
    """

    def __init__(self, likelihoods: Sequence[OwnLikelihood], scales: HyperPrior, odd: Array | None = None):
        self.likelihoods = likelihoods
        self.odd = scales.odd_before([False] * len(likelihoods)) if odd is None else odd
        self.following = likelihoods[0].following
        self.p, self.c = self.following.slopes.shape
        self.hyper = scales
        shares = np.stack([1 - self.odd, self.odd / 2, *[self.odd / 2 / self.p] * self.p], axis=1)
        self.shares = shares[:, : None if scales.odd else 1]  # (S, K)
        self.wider = scales.mean_std**2 * np.vstack([np.zeros((2, self.p)), np.eye(self.p)])

    def log_parts(self, h: Array) -> Array:
        """(B, S, K) ln of the share and the marginal likelihood of each data set in the population, under its own prior
        and where one parameter lies elsewhere, over that under its own prior.
        """
        mean, variance = h[:, : self.p], np.exp(2 * h[:, self.p : 2 * self.p])
        theta = h[:, 2 * self.p :]
        parts = np.zeros((len(h), *self.shares.shape))
        for k in range(self.shares.shape[1]):
            if k != 1:
                of_y = self.following.moments(mean, variance + self.wider[k], theta)
                for s, likelihood in enumerate(self.likelihoods):
                    parts[:, s, k] = log_marginal(likelihood.mixture, *of_y)
        return np.asarray(parts + np.log(self.shares))

    def log_density(self, h: Array) -> Array:
        """(B,), of all data in units of the sets' own evidences."""
        nu, log_tau, theta = np.split(h, (self.p, 2 * self.p), axis=1)
        logs: Array = self.hyper.log_density(nu, log_tau) - 0.5 * np.sum(theta**2, axis=1)
        logs -= 0.5 * self.c * math.log(2 * math.pi)
        inside = np.isfinite(logs)
        logs[inside] += np.logaddexp.reduce(self.log_parts(h[inside]), axis=2).sum(axis=1)
        return logs

    def belongs(self, h: Array) -> Array:
        """(B, S, K) probabilities of what :meth:`log_parts` tells apart; the first: it is of the population h."""
        parts = self.log_parts(h)
        return np.asarray(np.exp(parts - np.logaddexp.reduce(parts, axis=2)[..., None]))

    def sampled(self, seed: int, effort: Effort) -> HierarchyDraws:
        """Deterministic in ``seed``. Raises :class:`ValueError`: no population that was tried explains the data."""
        stream = member_stream(seed, "population")
        h, logs = self._weighed(self._walked(stream, effort), stream, effort)
        if h.shape[1] < effective_number(shares_of(logs)) < effort.effective:  # once more, from what the weights say
            again = h[resampled(shares_of(logs), FIT, stream)]
            second, its_logs = self._weighed(again, stream, effort)
            if effective_number(shares_of(its_logs)) > effective_number(shares_of(logs)):
                h, logs = second, its_logs
        shares = shares_of(logs)
        taken = h[resampled(shares, effort.draws, stream)]
        belongs, p = self.belongs(taken), self.p
        evidence = float(np.logaddexp.reduce(logs)) - math.log(len(logs))
        nu, tau, theta = taken[:, :p], np.exp(taken[:, p : 2 * p]), taken[:, 2 * p :]
        x = self._given(taken, belongs, stream)
        belonging = belongs[..., 0].mean(axis=0)
        uncertain = self._uncertain(taken)
        return HierarchyDraws(nu, tau, theta, x, belonging, effective_number(shares), evidence, uncertain)

    def _uncertain(self, h: Array) -> Array:
        """(S,) variances over populations h (B, 2p + c) of the error that the ln of each likelihood has by its draws.

        What half of the draws says differs from what all say by an error like that of all (half-sample replication:
        McCarthy 1969, Rev. Int. Stat. Inst. 37, 239).
        """
        halves = Hierarchy([replace(own, mixture=own.half) for own in self.likelihoods], self.hyper, self.odd)
        half, whole = (np.logaddexp.reduce(of.log_parts(h), axis=2) for of in (halves, self))
        return np.asarray((half - whole).var(axis=0))

    def _walked(self, stream: np.random.Generator, effort: Effort) -> Array:
        """(D, 2p + c) positions of walkers, the first third left out."""

        def cost(h: Array) -> Array:
            logs = self.log_density(h)
            return np.asarray(np.where(np.isnan(logs), np.inf, -logs))

        walkers = effort.hyper_walkers
        start = np.hstack([self.hyper.scattered(walkers, self.p, stream), stream.standard_normal((walkers, self.c))])
        return walked(cost, start, stream, effort.hyper_rounds, effort.hyper_rounds // 3)

    def _weighed(self, at: Array, stream: np.random.Generator, effort: Effort) -> tuple[Array, Array]:
        """Draws h (B, 2p + c) of a mixture fitted to positions, and logs of their weights."""
        chosen = at[np.linspace(0, len(at) - 1, FIT).astype(int)]
        proposal = StudentMixture.fitted(chosen, stream, effort.hyper_components)
        h = proposal.draw(effort.draws, stream)
        logs = self.log_density(h) - proposal.log_density(h)
        if not np.isfinite(logs.max()):
            raise ValueError("none of the populations that were drawn explains the data")
        return h, logs

    def _given(self, h: Array, belongs: Array, stream: np.random.Generator) -> Array:
        """Draws (M, S, p) of y_i given h and the data: of the population, or odd as ``belongs`` (M, S, K)."""
        mean, variance = h[:, : self.p], np.exp(2 * h[:, self.p : 2 * self.p])
        theta, x = h[:, 2 * self.p :], np.empty((len(h), len(self.likelihoods), self.p))
        for s, likelihood in enumerate(self.likelihoods):
            chosen = np.sum(stream.uniform(size=(len(h), 1)) > np.cumsum(belongs[:, s, :-1], axis=1), axis=1)
            own = chosen[:, None] == 1
            of_x = np.where(own, 0.0, mean), np.where(own, 1.0, variance + self.wider[chosen])
            middle, spread = self.following.moments(*of_x, theta)
            numbers, uniform = stream.standard_normal((len(h), self.p)), stream.uniform(size=len(h))
            _draw(likelihood.mixture, middle, spread, numbers, uniform, x[:, s])
        return x


@kernel
def _draw(mixture: Mixture, mean: Array, inverse: Array, numbers: Array, uniform: Array, out: Array) -> None:
    """Draws ``out`` (B, p) of L(x) N(x; mean, inverse⁻¹) from standard normal ``numbers``, which are overwritten."""
    n_parts, n = mixture.linear.shape
    middle, root, logs = np.empty((n_parts, n)), np.zeros((n_parts, n, n)), np.empty(n_parts)
    for b in range(mean.shape[0]):
        pull = inverse[b] @ mean[b]
        for m in range(n_parts):
            part = condition(mixture.precision[m], mixture.linear[m], inverse[b], pull, middle[m], root[m])
            logs[m] = mixture.constant[m] + part
        cumulated = np.cumsum(np.exp(logs - logs.max()))
        chosen = min(np.searchsorted(cumulated, uniform[b] * cumulated[-1]), n_parts - 1)
        draw_conditioned(middle[chosen], root[chosen], numbers[b], out[b])
