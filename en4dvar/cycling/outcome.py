"""What the loop over a series leaves: its result, and on the way the state from which it can go on."""

from __future__ import annotations

from dataclasses import dataclass

from en4dvar.cycling.moments import Moments
from en4dvar.state import Array


@dataclass(frozen=True)
class SequentialState:
    """All that the rest of a run depends on, besides its arguments, and what it has found so far.

    ``cycle`` observation times are done; ``ensemble`` (N', n_state + changes) stands at ``start`` (0: time zero, k:
    observation time k). Random numbers are drawn by cycle, so that no generator has a state.
    """

    cycle: int
    start: int
    ensemble: Array
    forecast: Moments
    analysis: Moments
    smoothed: Moments
    predicted: Moments
    ranks: Array
    evidence: Array
    iterations: Array
    effective: Array
    kept: tuple[tuple[int, Array], ...]
    forward_runs: int
    failures: tuple[str, ...] = ()
    trail: tuple[Array, ...] = ()


@dataclass(frozen=True)
class SequentialResult:
    """What a run leaves: moments of forecast, analysis (by y_1…y_k) and smoothed ensemble (by y_1…y_{k+L}).

    The last L smoothed rows of the IEnKS, unless ``to_end``, and all of a filter without a smoother are NaN.
    ``predicted``: moments (K, p) of the forecast where it was observed. ``ranks`` (K, p): share of the members, with
    the errors of the observations, that lie below the observation, NaN where there was none. ``evidence`` (K,): log
    density of the observations of a time given those before, of the Gaussian of the forecast; NaN in a twin experiment.
    ``iterations`` (K,) forecasts of the window. ``effective`` (K,): members that the weights of a particle filter
    leave, NaN: all. ``members`` (N', n) the final ensemble at the start of the last window; ``kept``: index of a time →
    analysis members (N', n), physical; ``failures`` the reasons of the members lost.
    """

    forecast: Moments
    analysis: Moments
    smoothed: Moments
    predicted: Moments
    ranks: Array
    evidence: Array
    iterations: Array
    effective: Array
    members: Array
    kept: tuple[tuple[int, Array], ...] = ()
    failures: tuple[str, ...] = ()
    forward_runs: int = 0
