r"""How much wider a prior must be to agree with data that contradict it.

Where predictions are linear, the posterior's covariance P and its centre's distance δ from the prior mean tell what the
data say by themselves: the information Λ = P⁻¹ − B⁻¹, and Λ times where they lead is P⁻¹δ. With another prior
covariance B' the minimum lies at (Λ + B'⁻¹)⁻¹ P⁻¹ δ. The data lead the farther the less they know: a prior that is as
many times as wide as the minimum is off lets it move on, and may contradict it again.
"""

from collections.abc import Sequence

import numpy as np

from en4dvar.diagnosis import diagnostics as diag
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior

MARGIN = 0.7  # of the distances that are told, since predictions are not linear
WIDEST = 1000
KNOWN = 1e-8  # variance, relative to the prior's, below which a direction is known: a sum with 1/WIDEST² keeps digits

Wider = tuple[Sequence[int], int]  # parameters, and how many times as wide their priors


def farthest(z: Array) -> list[int]:
    """The parameters that lie more than two of their prior standard deviations off, or the one that lies most."""
    order = np.argsort(-np.abs(z)).tolist()
    return [j for j in order if abs(z[j]) > 2] or order[:1]


def contradicts(z: Array, white: Array, share: float = 1.0) -> bool:
    """Whether a minimum of J lies where 2 J_b is beyond a ``share`` (of distances) of what χ²_n exceeds once in 4000,
    or one of the z² beyond what the largest of n does. ``z`` (n,) are prior standard deviations from the mean,
    ``white`` (n,) its white coordinates.
    """
    each = diag.TAIL / 2
    together, alone = diag.chi2_interval(len(z), each)[1], diag.chi2_interval(1, each / len(z))[1]
    return bool(white @ white > share**2 * together or np.max(z**2) > share**2 * alone)


def enough(prior: Prior, centre: Array, members: Array) -> Wider | None:
    """Of which parameters the prior has to be how many times as wide: of as few as will do, the farthest first.
    None where nothing contradicts it, no width ends that, or too few ``members`` (N, n) of the posterior, transformed,
    tell their covariance.
    """
    n, z = len(centre), (centre - prior.mean) / prior.std
    if len(members) < n + 2 or not contradicts(z, prior.white(centre)):
        return None
    order = np.argsort(-np.abs(z)).tolist()
    to_white = prior.white_change(np.eye(n)).T
    white = prior.white(members) - prior.white(centre)
    values, axes = np.linalg.eigh(white.T @ white / (len(members) - 1))
    known = axes @ np.diag(1 / np.clip(values, KNOWN, 1.0) - 1) @ axes.T  # Λ, in white coordinates
    pull = known @ prior.white(centre) + prior.white(centre)
    for count in range(1, n + 1):
        wide = order[:count]
        for factor in dict.fromkeys(int(np.ceil(f)) for f in np.geomspace(2, WIDEST, 60)):
            scale = np.ones(n)
            scale[wide] = factor
            # white coordinates of the wider prior: S⁻¹ in transformed space, carried to the old ones
            narrowed = to_white @ np.diag(1 / scale) @ np.linalg.inv(to_white)
            there = np.linalg.solve(known + narrowed.T @ narrowed, pull)
            moved = np.linalg.solve(to_white, there)
            if not contradicts(moved / (scale * prior.std), narrowed @ there, MARGIN):
                return wide, factor
    return None
