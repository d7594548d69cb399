"""Smoothers behind a filter: what it has analysed learns from later observations, and the filter does not notice.

- **EnKS**: the weights of each analysis are applied to the ensembles of the cycles before it, since member i there is
  the past of member i here. Fixed lag: what is further back gains little but the noise of the sample, to which model
  errors add that of their draws, uncorrelated with the states that they join but not with those before.
- **EnRTS**: all of the series, in a pass back from its end with the ensemble's own Rauch–Tung–Striebel gain,

      E_k ← E_k + (E_{k+1} − F_{k+1}) J_k,   J_k = (anomalies of F_{k+1})⁺ (anomalies of E_k),

  F the forecasts; every ensemble is kept until then. Members that the square root of a model error has widened are not
  the future of those at k: the pass first takes E_{k+1} back to F before the widening, by the moments of both.

For a linear model without model error both are the Kalman smoother of the ensemble's moments. With one EnRTS is, of the
errors that are drawn in the mean alone. Analyses are taken before inflation, which would otherwise be repeated with
every cycle that is gone back.

``passed`` takes a cycle's forecast (N, n), once more where it was widened, its analysis (N, n) and the weights (N, N)
of that, ``ended`` follows the last cycle. ``trail`` holds what a smoother keeps of earlier cycles, arrays (…, N, n);
members lost are taken from them.

Sources: Evensen & van Leeuwen (2000), Mon. Wea. Rev. 128, 1852; Raanes (2016), Q. J. R. Meteorol. Soc. 142, 1259.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.linalg import centre, min_norm_fit
from en4dvar.model.state import Array
from en4dvar.series.model_error import narrowed

Put = Callable[[int, Array], None]  # cycle, its smoothed ensemble (N, n)


@dataclass(frozen=True)
class EnKS:
    """Smoothing by ``lag`` later observation vectors, fewer at the end of the series. The trail: analyses so far."""

    lag: int

    def __post_init__(self) -> None:
        if self.lag < 1:
            raise ValueError(f"the lag of the EnKS must be at least 1, not {self.lag}")

    def passed(
        self, trail: list[Array], cycle: int, forecasts: Sequence[Array], analysis: Array, rows: Array, put: Put
    ) -> None:
        if trail:
            past = np.array(trail)
            mean = past.mean(axis=1, keepdims=True)
            trail[:] = mean + rows @ (past - mean)
        if len(trail) == self.lag:
            put(cycle - self.lag, trail.pop(0))
        trail.append(analysis)

    def ended(self, trail: list[Array], last: int, put: Put) -> None:
        for back, ensemble in enumerate(reversed(trail)):
            put(last - back, ensemble)


@dataclass(frozen=True)
class EnRTS:
    """Smoothing by all later observations. The trail: forecasts and analysis (2 or 3, N, n) of every cycle."""

    def passed(
        self, trail: list[Array], cycle: int, forecasts: Sequence[Array], analysis: Array, rows: Array, put: Put
    ) -> None:
        trail.append(np.array([*forecasts, analysis]))

    def ended(self, trail: list[Array], last: int, put: Put) -> None:
        smoothed = trail[last][-1]
        put(last, smoothed)
        for k in range(last - 1, -1, -1):
            following, *widened, _ = trail[k + 1]
            for each in widened:
                smoothed = narrowed(following, each, smoothed)
            _, anomalies = centre(following)
            # (E − F) X⁺ (N, N) rather than J (n, n), for states of any size
            weights = min_norm_fit(anomalies.T, (smoothed - following).T).T
            analysis = trail[k][-1]
            smoothed = analysis + weights @ centre(analysis)[1]
            put(k, smoothed)


Smoother = EnKS | EnRTS
