r"""Evidence of single data sets by adaptive importance sampling with forward runs, from the prior on.

    p(y) = ∫ L(x) N(x; prior) dx ≈ (1/TM) Σ_i L(x_i) N(x_i) / q(x_i),     q = (1/T) Σ_t q_t

The first M draws are as wide as the prior. Those of a later round come from a mixture of Student t fitted to all
before, whose weights are tempered as long as few of them count, so that the proposals close in on the posterior from
outside. q is the mixture of all rounds (Cornuet, Marin, Mira & Robert 2012, Scand. J. Stat. 39, 798).

A likelihood may have a narrow spike of low J beside a wide mode that holds most of the probability, as that of a bubble
whose radius is read near its collapse. There Laplace's approximation at the lowest J, where the iterations of En4D-Var
end, was off by up to nine, and proposals that start about its ensemble do not find the wide mode either.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior, member_stream
from en4dvar.sampling.forward_runs import CampaignRuns, log_likelihood
from en4dvar.sampling.mixture import StudentMixture, effective_number, resampled
from en4dvar.state import Array

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


def sampled_evidence(runs: CampaignRuns, prior: Prior, seed: int) -> Evidence:
    """At most :data:`MOST_ROUNDS` times :data:`DRAWS` forward runs of each set, or :data:`MORE` times as many.

    Deterministic in ``seed``. A set no draw of which can be run gets −inf.
    """
    every = range(len(runs.values))
    found = {s: _Importance(prior, member_stream(seed, "evidence", s), DRAWS) for s in every}
    _sample(runs, prior, found)
    again = {s: member_stream(seed, "evidence again", s) for s, one in found.items() if one.effective < TOO_FEW}
    second = {s: _Importance(prior, stream, MORE * DRAWS) for s, stream in again.items()}
    _sample(runs, prior, second)
    found |= {s: one for s, one in second.items() if one.effective > found[s].effective}
    return Evidence(np.array([found[s].log for s in every]), np.array([found[s].effective for s in every]))


def _sample(runs: CampaignRuns, prior: Prior, samplers: Mapping[int, _Importance]) -> None:
    """Rounds of all samplers, by the number of their set, until they have enough draws."""
    for _ in range(MOST_ROUNDS):
        going = np.array([s for s, one in samplers.items() if one.effective < ENOUGH], dtype=int)
        if not len(going):
            break
        z = np.stack([samplers[s].draw() for s in going])  # in units of the prior
        x = prior.mean + prior.std * z.transpose(1, 0, 2)
        logs = log_likelihood(runs, runs.predictions(x, going), going).T
        for s, at, log in zip(going, z, logs, strict=True):
            samplers[s].add(at, log)


class _Importance:
    """The draws and proposals of one set, ``count`` in a round; coordinates z, in which the prior is N(0, 1)."""

    def __init__(self, prior: Prior, stream: np.random.Generator, count: int):
        n = len(prior.names)
        self.stream, self.count = stream, count
        self.proposals = [StudentMixture(np.ones(1), np.zeros((1, n)), np.eye(n)[None])]
        self.z, self.target, self.mixture = np.empty((0, n)), np.empty(0), np.empty(0)  # mixture: ln Σ_t q_t
        self.log, self.effective = -np.inf, 0.0

    def draw(self) -> Array:
        """(M, n) draws of the next round."""
        if len(self.z):
            self.proposals.append(self._next_proposal())
        return self.proposals[-1].draw(self.count, self.stream)

    def add(self, z: Array, log_likelihood: Array) -> None:
        """Draws (M, n) and what came of them (M,); weights and evidence of all draws follow."""
        n = z.shape[1]
        target = log_likelihood - 0.5 * np.sum(z**2, axis=1) - 0.5 * n * np.log(2 * np.pi)
        if len(self.z):
            self.mixture = np.logaddexp(self.mixture, self.proposals[-1].log_density(self.z))
        here = np.logaddexp.reduce([q.log_density(z) for q in self.proposals], axis=0)
        self.z, self.target = np.concatenate([self.z, z]), np.concatenate([self.target, target])
        self.mixture = np.concatenate([self.mixture, here])
        self.log_weights = self.target - self.mixture + np.log(len(self.proposals))
        top = float(self.log_weights.max())
        if np.isfinite(top):
            weights = np.exp(self.log_weights - top)
            self.log = top + float(np.log(weights.mean()))
            self.effective = effective_number(weights)

    def _next_proposal(self) -> StudentMixture:
        if not np.isfinite(self.log):
            return self.proposals[0]
        logs, power = self.log_weights - self.log_weights.max(), 1.0
        weights = np.exp(logs)
        while effective_number(weights) < FEWEST and power > 1e-4:
            power *= 0.8
            weights = np.exp(power * logs)
        where = resampled(weights / weights.sum(), self.count, self.stream)
        return StudentMixture.fitted(self.z[where], self.stream, COMPONENTS)
