"""How the loop over a series treats the ensemble of a scheme."""

from dataclasses import dataclass, field

import numpy as np

from en4dvar import schemes
from en4dvar.model.state import Array
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.smoothers import EnKS, Smoother
from en4dvar.series.start import EnsembleCoordinates


@dataclass(frozen=True)
class Inflation:
    """What adds to the spread that sampling error and model error take away, of the anomalies of an analysis:

        multiplicative   X ← λ X                                                    Anderson & Anderson (1999)
        RTPS             X_j ← X_j (1 + α (σ_b,j − σ_a,j) / σ_a,j)                   Whitaker & Hamill (2012)

    λ ``multiplicative`` and α ``rtps`` (relaxation to prior spread, 0: none, 1: the spread of the prior).

    Raises ValueError: a factor that is not positive, or α outside [0, 1].
    """

    multiplicative: float = 1.0
    rtps: float = 0.0

    def __post_init__(self) -> None:
        if not self.multiplicative > 0:
            raise ValueError(f"multiplicative inflation must be positive, not {self.multiplicative:g}")
        if not 0 <= self.rtps <= 1:
            raise ValueError(f"rtps must lie in [0, 1], not {self.rtps:g}")

    def apply(self, prior: Array, anomalies: Array) -> Array:
        """Analysis anomalies (N, n) inflated; ``prior`` (N, n) is the ensemble before the analysis."""
        if self.rtps:
            spread = np.sqrt(np.sum(anomalies**2, axis=0) / (len(anomalies) - 1))
            anomalies = anomalies * relaxation(prior.std(axis=0, ddof=1), spread, self.rtps)
        return anomalies if self.multiplicative == 1 else self.multiplicative * anomalies


def relaxation(prior_std: Array, posterior_std: Array, alpha: float) -> Array:
    """Factors (n,) of relaxation to prior spread; 1 where the posterior has no spread.

    Source: Whitaker & Hamill (2012), Mon. Wea. Rev. 140, 3078, eq. 2.
    """
    lost = prior_std - posterior_std
    return 1 + alpha * np.divide(lost, posterior_std, out=np.zeros_like(lost), where=posterior_std > 0)


NO_INFLATION = Inflation()


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``.

    ``rotation``: every analysis is turned by random :class:`~en4dvar.series.sequential.Rotations`, which keep the mean.
    ``stochastic_model``: a model that gives other numbers when a member is run again is accepted.
    ``to_end``: the last times, which no whole window follows, are smoothed by the observations that there are.
    ``innovations``: what was expected of each observation is recorded. ``members_every``: analysis ensembles are kept
    after so many observation times, and the last; 0: the last alone.
    ``smoother``: what goes behind a filter (:mod:`en4dvar.series.smoothers`).

    Raises ValueError: a smoother behind what is no cycled filter or is localised, localisation of what has no local
    analysis, a square root of the model error where members must keep their past.
    """

    scheme: Scheme
    inflation: Inflation = NO_INFLATION
    rotation: bool = False
    localisation: BlockLocalisation | None = None
    min_active_fraction: float = 0.5
    stochastic_model: bool = False
    model_error: ModelError | None = None
    coordinates: EnsembleCoordinates = field(default_factory=EnsembleCoordinates)
    to_end: bool = False
    innovations: bool = False
    members_every: int = 0
    smoother: Smoother | None = None

    def __post_init__(self) -> None:
        if self.smoother and (self.scheme.lag or not self.scheme.cycled):
            raise ValueError("a smoother goes behind a filter that is cycled, not behind a smoother or a baseline")
        if self.localisation and self.smoother:
            others = " or ".join(name for name, kind in schemes.ON_A_SERIES.items() if "lag" in schemes.keys_of(kind))
            raise ValueError(f"a smoother behind a filter takes no localisation; scheme {others} smooths with it")
        if self.localisation and self.scheme.resamples:
            raise ValueError("members of this scheme survive as a whole: it takes no localisation")
        if self.model_error and self.model_error.form == "square-root":
            if self.scheme.lag:
                raise ValueError("square-root is for filters; a smoother with a window estimates the model error")
            if isinstance(self.smoother, EnKS):
                raise ValueError("square-root leaves no member its past, which enks needs; use enrts, or drawn")

    @property
    def smooths(self) -> bool:
        """True if there are smoothed states."""
        return bool(self.scheme.lag or self.smoother)
