"""Smoothers behind a filter: what it has analysed learns from later observations, and the filter does not notice.

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
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.linalg import centre, min_norm_fit
from en4dvar.model.state import Array
from en4dvar.series.model_error import narrowed

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
            weights = min_norm_fit(anomalies.T, (smoothed - following).T).T
            analysis = trail[k][-1]
            smoothed = analysis + weights @ centre(analysis)[1]
            put(k, smoothed)


Smoother = EnKS | EnRTS
