r"""Which law? What readings tell of which of several laws holds, before they are made.

The laws k = 1 … L are inverse problems of the same readings, equally probable before. Readings y are simulated from
draws of each, and the evidences of all laws found by importance sampling
(:func:`en4dvar.estimation.design.nested.log_integral`):

    P(k | y) = p(y | k) / Σ_j p(y | j),     I = ln L + E[ln P(k | y)] = ln L + E[Σ_j P(j | y) ln P(j | y)] ≤ ln L.

An error of the evidences makes the first form of the mutual information I of law and readings too small and the second
too large, by the same amount to second order; I is their mean. E[P(k | y)] of the law k that holds, which is linear in
P, is the probability that it will have: 1/L where readings tell nothing, 1 where they decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.estimation.design.laplace import require_alive, standard_error
from en4dvar.estimation.design.nested import explained, explaining, log_integral
from en4dvar.estimation.design.planned import Planned
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream, own_seed

ENOUGH, ROUNDS = 100.0, 10  # effective draws behind an evidence, and rounds until then
DECIDED = 0.95  # probability of the law that holds: odds of 19, or a difference of 3 between two log-evidences


@dataclass(frozen=True)
class Decision:
    """Expected information of readings about which law holds, each number with its Monte Carlo standard error.

    ``information`` nats, of law and readings; ``probability`` that the law that holds will have; ``decided`` share of
    experiments in which that is 0.95 or more. ``thin`` share of the evidences with fewer effective draws than wanted.
    """

    information: float
    information_error: float
    probability: float
    probability_error: float
    decided: float
    decided_error: float
    thin: float

    @classmethod
    def of(cls, logs: Sequence[Array], thin: float = 0.0) -> Decision:
        """From log-evidences (R, L) of readings simulated with each of the L laws, in their order."""
        told, holds = [], []
        for k, log in enumerate(logs):
            ln = log - np.logaddexp.reduce(log, axis=1, keepdims=True)
            entropy = -np.sum(np.exp(ln) * np.where(np.isfinite(ln), ln, 0.0), axis=1)
            told.append(np.log(len(logs)) + 0.5 * (ln[:, k] - entropy))
            holds.append(np.exp(ln[:, k]))
        decided, count = np.mean([np.mean(p >= DECIDED) for p in holds]), sum(map(len, holds))
        unsure = (decided * count + 2) / (count + 4)  # Agresti & Coull (1998): no share is known exactly
        return cls(
            *_mean(told), *_mean(holds), float(decided), float(np.sqrt(unsure * (1 - unsure) / (count + 4))), thin
        )


def _mean(values: Sequence[Array]) -> tuple[float, float]:
    """Mean over equally probable laws of the means of values (R,) of each, and its standard error."""
    errors = [standard_error(sample) for sample in values]
    return float(np.mean([sample.mean() for sample in values])), float(np.linalg.norm(errors) / len(values))


def deciding(laws: Sequence[Planned], count: int, inner: int, seed: int) -> Decision:
    """From ``count`` sets of readings of each law, and ``inner`` runs (a round) behind each evidence.

    ``laws`` share their observations, whose errors are those of the readings whichever law holds.

    Raises :class:`TooFewMembersError` where a model mostly fails.
    """
    tangents = [
        hypothesis.tangents(hypothesis.draws(count, own_seed(seed, f"law {k}"))) for k, hypothesis in enumerate(laws)
    ]
    for hypothesis in tangents:
        require_alive(len(hypothesis.at), count)
    noise, logs, behind = laws[0].problem.observations.noise, [], []
    for k, truths in enumerate(tangents):
        evidences = np.empty((len(truths.at), len(laws)))
        for i, number in enumerate(truths.alive):
            values = noise.drawn(truths.at[i].prediction, member_stream(seed, f"design readings {k}", int(number)))
            for j, law in enumerate(laws):
                near = explaining(law, tangents[j], values, i if j == k else None)
                stream = member_stream(seed, f"design evidence {k}", int(number))
                draws = explained(law, values, np.empty(0), near, inner, stream, ENOUGH, ROUNDS)
                evidences[i, j], effective = log_integral(draws)
                behind.append(effective)
        alive = np.isfinite(evidences[:, k])
        require_alive(int(alive.sum()), count)
        logs.append(evidences[alive])
    return Decision.of(logs, float(np.mean(np.array(behind) < ENOUGH)))
