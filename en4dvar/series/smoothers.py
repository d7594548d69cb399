"""Smoothers behind a filter: what it has analysed learns from later observations, and the filter does not notice.

- **EnKS**: the weights of each analysis are applied to the ensembles of the cycles before it, since member i there is
  the past of member i here. Fixed lag: what is further back gains little but the noise of the sample.
- **EnRTS**: all of the series, in a pass back from its end with the ensemble's own Rauch–Tung–Striebel gain,

      E_k ← E_k + (E_{k+1} − F_{k+1}) J_k,   J_k = (anomalies of F_{k+1})⁺ (anomalies of E_k),

  F the forecasts; every ensemble is kept until then.

For a linear model both are the Kalman smoother of the ensemble's moments. Analyses are taken before inflation, which
would otherwise be repeated with every cycle that is gone back.

``passed`` takes a cycle's ensembles (N, n) and the weights (N, N) of its analysis, ``ended`` follows the last cycle.
``trail`` holds what a smoother keeps of earlier cycles, arrays (…, N, n); members lost are taken from them.

Sources: Evensen & van Leeuwen (2000), Mon. Wea. Rev. 128, 1852; Raanes (2016), Q. J. R. Meteorol. Soc. 142, 1259.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.linalg import centre, min_norm_fit
from en4dvar.model.state import Array

Put = Callable[[int, Array], None]  # cycle, its smoothed ensemble (N, n)


@dataclass(frozen=True)
class EnKS:
    """Smoothing by ``lag`` later observation vectors, fewer at the end of the series. The trail: analyses so far."""

    lag: int

    def __post_init__(self) -> None:
        if self.lag < 1:
            raise ValueError(f"the lag of the EnKS must be at least 1, not {self.lag}")

    def passed(self, trail: list[Array], cycle: int, forecast: Array, analysis: Array, rows: Array, put: Put) -> None:
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
    """Smoothing by all later observations. The trail: forecast and analysis (2, N, n) of every cycle."""

    def passed(self, trail: list[Array], cycle: int, forecast: Array, analysis: Array, rows: Array, put: Put) -> None:
        trail.append(np.array([forecast, analysis]))

    def ended(self, trail: list[Array], last: int, put: Put) -> None:
        following, smoothed = trail[last]
        put(last, smoothed)
        for k in range(last - 1, -1, -1):
            _, anomalies = centre(following)
            # (E − F) X⁺ (N, N) rather than J (n, n), for states of any size
            weights = min_norm_fit(anomalies.T, (smoothed - following).T).T
            following, analysis = trail[k]
            smoothed = analysis + weights @ centre(analysis)[1]
            put(k, smoothed)


Smoother = EnKS | EnRTS
