"""ETKF: the ensemble transform Kalman filter, deterministic, with the symmetric square root.

One Gauss–Newton step from the prior at the time of the observations; nothing is iterated and no state is smoothed.

    w = A⁻¹ Sᵀ d,   T = √(N−1) A^{-1/2},   A = (N−1) I + SᵀS

Sources: Bishop, Etherton & Majumdar (2001), Mon. Wea. Rev. 129, 420; symmetric root: Hunt, Kostelich & Szunyogh (2007),
Physica D 230, 112.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from en4dvar.ensemble.linalg import centre
from en4dvar.schemes import Evaluation, FullStep, Weights, full_step
from en4dvar.state import Array


@dataclass(frozen=True)
class ETKF:
    """The filter: a window without length, analysed once."""

    lag: ClassVar[int] = 0
    max_iterations: ClassVar[int] = 1
    tolerance: ClassVar[float] = 0.0

    def init(self, n_members: int) -> Weights:
        """w = 0, T = I."""
        return Weights.prior(n_members)

    def spread(self, weights: Weights) -> Array:
        """I (N, N): the members are the forecast."""
        return weights.T

    def linearise(self, weights: Weights, predictions: Array) -> tuple[Array, Array]:
        """Mean (K',) and anomalies (N, K') of the members' predictions (N, K')."""
        return centre(predictions)

    def step(self, weights: Weights, evaluation: Evaluation) -> FullStep:
        """Weights of the analysis, with the symmetric transform."""
        return full_step(weights, evaluation)
