r"""Evidence of single data sets by adaptive importance sampling with forward runs, from the prior on.

    p(y) = ∫ L(x) N(x; prior) dx ≈ (1/TM) Σ_i L(x_i) N(x_i) / q(x_i),     q = (1/T) Σ_t q_t

The first M draws are as wide as the prior. Those of a later round come from a mixture of Student t fitted to all
before, whose weights are tempered as long as few of them count, so that the proposals close in on the posterior from
outside. q is the mixture of all rounds (Cornuet, Marin, Mira & Robert 2012, Scand. J. Stat. 39, 798).

Readings near the collapse leave narrow spikes of low J beside a wide mode that holds most of the probability. Laplace's
approximation at the lowest J, with which the iterations of En4D-Var end, was off by up to nine there, and proposals
that start about its ensemble do not find the wide mode either.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior, member_stream
from en4dvar.state import Array
from en4dvar_bubble.study.hyper import Proposal
from en4dvar_bubble.study.set_runs import Runs, log_likelihood

DRAWS, MOST_ROUNDS = 400, 40
ENOUGH = 400.0  # effective draws that end the rounds of a set
TOO_FEW, MORE = 100.0, 3  # below so many after all rounds: once more with as many times the draws
FEWEST = 60.0  # effective draws that a proposal is fitted to: with fewer, to tempered weights
COMPONENTS = 4


@dataclass(frozen=True)
class Evidence:
    """Of S sets: ``log`` ln ∫ L N dx (S,), without Σ ln(std √2π), and the ``effective`` numbers of draws behind it."""

    log: Array
    effective: Array


def set_evidence(runs: Runs, prior: Prior, seed: int) -> Evidence:
    """At most :data:`MOST_ROUNDS` times :data:`DRAWS` forward runs of each set, or :data:`MORE` times as many.

    Deterministic in ``seed``. A set no draw of which can be run gets −inf.
    """
    every = range(len(runs.values))
    found = {s: _Search(prior, member_stream(seed, "evidence", s), DRAWS) for s in every}
    _search(runs, prior, found)
    again = {s: member_stream(seed, "evidence again", s) for s, search in found.items() if search.effective < TOO_FEW}
    if again:
        second = {s: _Search(prior, stream, MORE * DRAWS) for s, stream in again.items()}
        _search(runs, prior, second)
        found |= {s: search for s, search in second.items() if search.effective > found[s].effective}
    return Evidence(np.array([found[s].log for s in every]), np.array([found[s].effective for s in every]))


def _search(runs: Runs, prior: Prior, searches: Mapping[int, _Search]) -> None:
    """Rounds of all searches, by the number of their set, until they are done."""
    for _ in range(MOST_ROUNDS):
        going = np.array([s for s, search in searches.items() if search.effective < ENOUGH], dtype=int)
        if not len(going):
            break
        z = np.stack([searches[s].drawn() for s in going])  # in units of the prior
        x = prior.mean + prior.std * z.transpose(1, 0, 2)
        logs = log_likelihood(runs, runs.predictions(x, going), going).T
        for s, at, told in zip(going, z, logs, strict=True):
            searches[s].told(at, told)


class _Search:
    """The draws and proposals of one set; coordinates z, in which the prior is N(0, 1); ``draws`` in a round."""

    def __init__(self, prior: Prior, stream: np.random.Generator, draws: int):
        n = len(prior.names)
        self.stream, self.draws = stream, draws
        self.proposals = [Proposal(np.ones(1), np.zeros((1, n)), np.eye(n)[None])]
        self.z, self.target, self.mixture = np.empty((0, n)), np.empty(0), np.empty(0)  # mixture: ln Σ_t q_t
        self.log, self.effective = -np.inf, 0.0

    def drawn(self) -> Array:
        """(M, n) draws of the next round."""
        if len(self.z):
            self.proposals.append(self._fitted())
        return self.proposals[-1].draw(self.draws, self.stream)

    def told(self, z: Array, log_likelihood: Array) -> None:
        """What came of draws (M, n)."""
        n = z.shape[1]
        logs = log_likelihood - 0.5 * np.sum(z**2, axis=1) - 0.5 * n * np.log(2 * np.pi)
        if len(self.z):
            self.mixture = np.logaddexp(self.mixture, self.proposals[-1].log_density(self.z))
        here = np.logaddexp.reduce([q.log_density(z) for q in self.proposals], axis=0)
        self.z, self.target = np.concatenate([self.z, z]), np.concatenate([self.target, logs])
        self.mixture = np.concatenate([self.mixture, here])
        self.weights = self.target - self.mixture + np.log(len(self.proposals))
        top = float(self.weights.max())
        if np.isfinite(top):
            share = np.exp(self.weights - top)
            self.log = top + float(np.log(share.mean()))
            self.effective = float(share.sum() ** 2 / np.sum(share**2))

    def _fitted(self) -> Proposal:
        if not np.isfinite(self.log):
            return self.proposals[0]
        weights, power = self.weights - self.weights.max(), 1.0
        share = np.exp(weights)
        while share.sum() ** 2 < FEWEST * np.sum(share**2) and power > 1e-4:
            power *= 0.8
            share = np.exp(power * weights)
        quantiles = (np.arange(self.draws) + self.stream.uniform()) / self.draws
        where = np.searchsorted(np.cumsum(share / share.sum()), quantiles).clip(max=len(self.z) - 1)
        return Proposal.fitted(self.z[where], self.stream, COMPONENTS)
