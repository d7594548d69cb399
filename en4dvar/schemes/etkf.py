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
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Runs, Step, Weights, gauss_newton
from en4dvar.state import Array


@dataclass(frozen=True)
class ETKF:
    """The filter: a window without length, analysed once. Filters with another analysis say so in :meth:`advance`."""

    on: ClassVar[tuple[str, ...]] = ("window", "series")
    cycled: ClassVar[bool] = True
    searches: ClassVar[bool] = False
    passes: ClassVar[int] = 1
    lag: ClassVar[int] = 0
    shift: ClassVar[int] = 1
    mda_weights: ClassVar[tuple[float, ...]] = (1.0,)

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """I (N, N): the members are the forecast."""
        return weights.rows

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        """Mean (K',) and anomalies (N, K') of the members' predictions."""
        return centre(runs.predictions)

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Weights of the analysis, with the symmetric transform."""
        return gauss_newton(weights.w, evaluation)

    def done(self, iteration: int, step: Step | GaussNewtonStep) -> bool:
        """After the last pass."""
        return iteration + 1 == self.passes
