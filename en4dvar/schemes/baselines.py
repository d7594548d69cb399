"""Baselines: what a filter must beat to have earned its cost.

Their members run freely, as if nothing was observed (``cycled`` is false); once they have forgotten how they started,
they are a sample of the model's climatology.

- **Climatology**: mean and spread of the free members; observations are not used.
- **Optimal interpolation**: one analysis of each observation vector with the mean of the free members as its prior; the
  next one starts from them again. The covariance is the climatological one: that of the free members, averaged over
  the times so far. Anomalies are those of the free members, changed as a square-root filter with this covariance does.

Sources: Whitaker & Hamill (2002), Mon. Wea. Rev. 130, 1913, eq. 10 (anomalies); Gandin (1963), Objective Analysis of
Meteorological Fields; as baselines: Raanes (2016), thesis, Oxford.
"""

from dataclasses import dataclass
from typing import ClassVar

from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.etkf import ETKF


@dataclass(frozen=True)
class OptimalInterpolation(ETKF):
    """The ETKF's analysis, with climatological covariances unless it is local; not cycled."""

    words: ClassVar[str] = "one analysis of the free members"
    on: ClassVar[tuple[str, ...]] = ("series",)
    cycled: ClassVar[bool] = False
    climatological: ClassVar[bool] = True


@dataclass(frozen=True)
class Climatology(OptimalInterpolation):
    """The free members themselves."""

    words: ClassVar[str] = "the free members"
    climatological: ClassVar[bool] = False

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        return Step(weights, 0.0)
