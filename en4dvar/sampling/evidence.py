"""Evidence of single data sets by adaptive importance sampling with forward runs, from the prior on.

The first draws are as wide as the prior; :mod:`en4dvar.sampling.importance` has the equations.

A likelihood may have a narrow spike of low J beside a wide mode that holds most of the probability, as that of a bubble
whose radius is read near its collapse. There Laplace's approximation at the lowest J, where the iterations of En4D-Var
end, was off by up to nine, and proposals that start about its ensemble do not find the wide mode either.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.sampling.forward_runs import CampaignRuns, log_likelihood
from en4dvar.sampling.importance import Importance, standard

DRAWS, MOST_ROUNDS = 400, 40
ENOUGH = 400.0  # effective draws that end the rounds of a set
TOO_FEW, MORE = 100.0, 3  # below so many after all rounds: once more with as many times the draws


@dataclass(frozen=True)
class Evidence:
    """Evidence of S sets: ``log`` ln ∫ L N dx (S,), without Σ ln(std √2π), and the ``effective`` numbers of draws
    behind it.
    """

    log: Array
    effective: Array


def sampled_evidence(runs: CampaignRuns, prior: Prior, seed: int) -> Evidence:
    """At most :data:`MOST_ROUNDS` times :data:`DRAWS` forward runs of each set, or :data:`MORE` times as many.

    Deterministic in ``seed``. A set no draw of which can be run gets −inf.
    """
    every, first = range(len(runs.values)), standard(len(prior.names))
    estimates = {s: Importance(first, member_stream(seed, "evidence", s), DRAWS) for s in every}
    sample_sets(runs, prior.from_white, estimates)
    again = {
        s: member_stream(seed, "evidence again", s) for s, estimate in estimates.items() if estimate.effective < TOO_FEW
    }
    second = {s: Importance(first, stream, MORE * DRAWS) for s, stream in again.items()}
    sample_sets(runs, prior.from_white, second)
    estimates |= {s: estimate for s, estimate in second.items() if estimate.effective > estimates[s].effective}
    return Evidence(np.array([estimates[s].log for s in every]), np.array([estimates[s].effective for s in every]))


def sample_sets(runs: CampaignRuns, control: Callable[[Array], Array], samplers: Mapping[int, Importance]) -> None:
    """Rounds of all samplers, by the number of their set, until they have enough draws. ``control``: coordinates
    (B, n) → control vectors.
    """
    for _ in range(MOST_ROUNDS):
        going = np.array([s for s, sampler in samplers.items() if sampler.effective < ENOUGH], dtype=int)
        if not len(going):
            break
        z = np.stack([samplers[s].draw() for s in going])  # in units of the prior
        x = control(z.transpose(1, 0, 2))
        logs = log_likelihood(runs, runs.predictions(x, going), going).T
        for s, at, log in zip(going, z, logs, strict=True):
            samplers[s].add(at, log)
