"""How the loop over a series treats the ensemble of a scheme."""

from dataclasses import dataclass, field

from en4dvar import schemes
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.smoothers import EnKS, Smoother
from en4dvar.series.start import EnsembleCoordinates

NO_INFLATION = Inflation()


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``.

    ``rotation``: every analysis is turned by a random mean-preserving rotation (:mod:`en4dvar.series.rotation`).
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
