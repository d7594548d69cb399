"""How the loop over a series treats the ensemble of a scheme: inflation, and smoothers behind a filter.

With a smoother, what a filter has analysed learns from later observations, and the filter does not notice.

- **EnKS**: the weights of each analysis are applied to the ensembles of the cycles before it, since member i there is
  the past of member i here. Fixed lag: what is further back gains little but the noise of the sample, to which model
  errors add that of their draws, uncorrelated with the states that they join but not with those before.
- **EnRTS**: all of the series, in a pass back from its end with the ensemble's own Rauch–Tung–Striebel gain,

      E_k ← E_k + (E_{k+1} − F_{k+1}) J_k,   J_k = (anomalies of F_{k+1})⁺ (anomalies of E_k),

  F the forecasts; every ensemble is kept until then. Members that the square root of a model error or inflation has
  widened are not the future of those before: the pass takes what is smoothed back over it, by the moments of both.

For a linear model without model error both are the Kalman smoother of the ensemble's moments. With one EnRTS is, of the
errors that are drawn in the mean alone. Inflation is to the EnRTS an error that joins the analysis, as large as what it
adds to the covariance: what is smoothed forgets later observations as the filter does earlier ones. The EnKS takes
analyses before inflation, and what it smooths is narrower by the factor of inflation to the power of the lag.

``passed`` takes a cycle's forecast (N, n), once more where it was widened, its analysis (N, n), once more where it was
inflated, and the weights (N, N) of the analysis; ``ended`` follows the last cycle. ``trail`` holds what a smoother
keeps of earlier cycles, arrays (…, N, n); members lost are taken from them.

Sources: Evensen & van Leeuwen (2000), Mon. Wea. Rev. 128, 1852; Raanes (2016), Q. J. R. Meteorol. Soc. 142, 1259.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from en4dvar import schemes
from en4dvar.ensemble.linalg import centre, least_coordinates
from en4dvar.model.state import Array
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError, narrowed
from en4dvar.series.start import EnsembleCoordinates

Pair = Sequence[Array]  # an ensemble (N, n), and what became of it where it was widened
Put = Callable[[int, Array], None]  # cycle, its smoothed ensemble (N, n)


@dataclass(frozen=True)
class EnKS:
    """Smoothing by ``lag`` later observation vectors, fewer at the end of the series. The trail: analyses so far."""

    lag: int

    def __post_init__(self) -> None:
        if self.lag < 1:
            raise ValueError(f"the lag of the EnKS must be at least 1, not {self.lag}")

    def passed(self, trail: list[Array], cycle: int, forecasts: Pair, analyses: Pair, rows: Array, put: Put) -> None:
        if trail:
            past = np.array(trail)
            mean = past.mean(axis=1, keepdims=True)
            trail[:] = mean + rows @ (past - mean)
        if len(trail) == self.lag:
            put(cycle - self.lag, trail.pop(0))
        trail.append(analyses[0])

    def ended(self, trail: list[Array], last: int, put: Put) -> None:
        for back, ensemble in enumerate(reversed(trail)):
            put(last - back, ensemble)


@dataclass(frozen=True)
class EnRTS:
    """Smoothing by all later observations.

    The trail: forecast and analysis (2, N, n) of every cycle, or both before and after they were widened (4, N, n).
    """

    def passed(self, trail: list[Array], cycle: int, forecasts: Pair, analyses: Pair, rows: Array, put: Put) -> None:
        ensembles = [*forecasts, *analyses]
        if len(ensembles) == 3:
            ensembles = [forecasts[0], forecasts[-1], analyses[0], analyses[-1]]
        trail.append(np.array(ensembles))

    def ended(self, trail: list[Array], last: int, put: Put) -> None:
        smoothed = trail[last][-1]
        put(last, smoothed)
        for k in range(last - 1, -1, -1):
            following, *between, inflated = trail[k + 1]
            if between:
                widened, analysis = between
                smoothed = narrowed(following, widened, narrowed(analysis, inflated, smoothed))
            _, anomalies = centre(following)
            # (E − F) X⁺ (N, N) rather than J (n, n), for states of any size
            weights = least_coordinates(anomalies, smoothed - following)
            analysis = trail[k][-1]
            smoothed = analysis + weights @ centre(analysis)[1]
            put(k, smoothed)


Smoother = EnKS | EnRTS


@dataclass(frozen=True)
class Inflation:
    """What adds to the spread that sampling error and model error take away, of the anomalies of an analysis:

        multiplicative   X ← λ X                                                    Anderson & Anderson (1999)
        RTPS             X_j ← X_j (1 + α (σ_b,j − σ_a,j) / σ_a,j)                   Whitaker & Hamill (2012)

    λ ``multiplicative`` and α ``rtps`` (relaxation to prior spread, 0: none, 1: the spread of the prior; Mon. Wea. Rev.
    140, 3078, eq. 2), which leaves alone what has no spread.

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
            lost = prior.std(axis=0, ddof=1) - spread
            anomalies = anomalies * (1 + self.rtps * np.divide(lost, spread, out=np.zeros_like(lost), where=spread > 0))
        return anomalies if self.multiplicative == 1 else self.multiplicative * anomalies


NO_INFLATION = Inflation()


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``.

    ``rotation``: every analysis is turned by random :class:`~en4dvar.series.sequential.Rotations`, which keep the mean.
    ``stochastic_model``: a model that gives other numbers when a member is run again is accepted.
    ``to_end``: the last times, which no whole window follows, are smoothed by the observations that there are.
    ``innovations``: what was expected of each observation is recorded. ``members_every``: analysis ensembles are kept
    after so many observation times, and the last; 0: the last alone.
    ``smoother``: what goes behind a filter.

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
