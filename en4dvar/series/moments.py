"""Ensemble moments along a sequential run, taken of many cycles at once, and the outcome that holds them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from en4dvar.data.noise import Correlation
from en4dvar.data.noise.discrepancy import whitened
from en4dvar.model.state import Array
from en4dvar.plumbing.moved import former_name
from en4dvar.priors.prior import member_stream
from en4dvar.series.series import CycleSeries

BLOCK = 64  # ensembles kept until their moments are taken, at most
BLOCK_SIZE = 2_000_000  # numbers in them, at most


def __getattr__(name: str) -> Any:
    return former_name(__name__, name)


@dataclass(frozen=True)
class Moments:
    """Ensemble mean and standard deviation (K, n_state) at the observation times; NaN where there is none.

    ``rank`` is that of the truth among the N members, counted from ½ to N + ½ and divided by N + 1; (K, 0) without one.
    """

    mean: Array
    std: Array
    rank: Array

    def until(self, cycle: int) -> "Moments":
        """Copy of the rows before ``cycle``."""
        return Moments(*(rows[:cycle].copy() for rows in vars(self).values()))


class MomentsRecorder:
    """Collects ensembles (N, n) and takes their moments in blocks: on small states the calls cost more than the sums.

    The moments of a cycle do not depend on which cycles share its block.
    """

    def __init__(self, cycles: int, size: int, before: Moments | None = None, truth: Array | None = None):
        self._truth = truth
        widths = size, size, 0 if truth is None else size
        self._moments = Moments(*(np.full((cycles, width), np.nan) for width in widths))
        for whole, known in zip(vars(self._moments).values(), vars(before).values() if before else (), strict=False):
            whole[: len(known)] = known
        self._cycles: list[int] = []
        self._scales: list[float] = []
        self._ensembles = np.empty((0, 0, size))

    def put(self, cycle: int, ensemble: Array, scale: float = 1.0) -> None:
        """Record an ensemble; its standard deviation is multiplied by ``scale``."""
        if ensemble.shape != self._ensembles.shape[1:] or len(self._cycles) == len(self._ensembles):
            self._flush()
            block = max(1, min(BLOCK, BLOCK_SIZE // ensemble.size))
            if (block, *ensemble.shape) != self._ensembles.shape:
                self._ensembles = np.empty((block, *ensemble.shape))
        self._ensembles[len(self._cycles)] = ensemble
        self._cycles.append(cycle)
        self._scales.append(scale)

    def moments(self) -> Moments:
        """The moments of everything recorded so far."""
        self._flush()
        return self._moments

    def _flush(self) -> None:
        if not self._cycles:
            return
        ensembles = self._ensembles[: len(self._cycles)]
        n_members = ensembles.shape[1]
        mean = np.add.reduce(ensembles, axis=1) / n_members
        anomalies = ensembles - mean[:, None]
        variance = np.einsum("kij,kij->kj", anomalies, anomalies) / (n_members - 1)
        self._moments.mean[self._cycles] = mean
        scales = np.array(self._scales)[:, None]
        self._moments.std[self._cycles] = scales * np.sqrt(variance)
        if self._truth is not None:
            error = self._truth[self._cycles] - mean
            below = np.count_nonzero(scales[:, None] * anomalies < error[:, None], axis=1)
            self._moments.rank[self._cycles] = (below + 0.5) / (n_members + 1)
        self._cycles.clear()
        self._scales.clear()


class InnovationRecorder(MomentsRecorder):
    """Moments of predictions (N, p) of a series; and of its observations (K, p) ranks and, ``of_data``, evidence (K,).

    A rank is the place of the observation among the N members, each with an error of the observations of its own,
    counted from a random number between 0 and 1 and divided by N + 1: of a reliable ensemble it is uniform, as the mean
    over these errors is not, whose ends are rare. NaN where there is none. Random numbers are those of the cycle.

    ``ranks`` and ``evidence`` are those of everything recorded so far once :meth:`moments` has been asked for.
    """

    def __init__(self, series: CycleSeries, of_data: bool, before: "SequentialState | None" = None):
        cycles, size = series.values.shape
        super().__init__(cycles, size, before.predicted if before else None)
        self._series, self._of_data = series, of_data
        self._std = np.broadcast_to(series.std, series.values.shape)
        self.ranks, self.evidence = np.full(series.values.shape, np.nan), np.full(len(series.times), np.nan)
        if before is not None:
            self.ranks[: len(before.ranks)], self.evidence[: len(before.evidence)] = before.ranks, before.evidence

    def _flush(self) -> None:
        if not self._cycles:
            return
        at = list(self._cycles)
        super()._flush()
        gaps = self._ensembles[: len(at)]  # the members are not needed any more: memory is not asked for again
        np.subtract(self._series.values[at][:, None], gaps, out=gaps)
        gaps /= self._std[at][:, None]
        if self._of_data:
            self.evidence[at] = log_evidence(gaps, self._std[at], self._series.correlation)
        for cycle, gap in zip(at, gaps, strict=True):
            stream = member_stream(0, "ranks", cycle)
            below = np.count_nonzero(stream.standard_normal(gap.shape) < gap, axis=0)
            place = (below + stream.random(len(below))) / (len(gap) + 1)
            self.ranks[cycle] = np.where(np.isfinite(gap[0]), place, np.nan)


def log_evidence(gaps: Array, std: Array, correlation: Correlation | None) -> Array:
    """ln N(y; ȳ, P + R) (B,) of observations before they are assimilated, ȳ and P of the members' predictions.

    ``gaps`` (B, N, p): (y − predictions) / ``std`` (B, p), NaN where nothing was observed.
    """
    _, n_members, p = gaps.shape
    there, d = np.isfinite(gaps[:, 0]), gaps.mean(axis=1)
    s = gaps - d[:, None]
    s /= np.sqrt(n_members - 1)
    if not there.all():
        d, s = np.where(there, d, 0.0), np.where(there[:, None], s, 0.0)
    log_norm = np.sum(np.where(there, np.log(std) + 0.5 * np.log(2 * np.pi), 0.0), axis=1)
    if correlation is not None:
        for k, among in enumerate(there):
            part = Correlation(correlation.matrix[np.ix_(among, among)])
            d[k, among], s[k][:, among] = part.decorrelated(d[k, among]), part.decorrelated(s[k][:, among])
            log_norm[k] += np.sum(part.log_root)
    if p <= n_members:
        v, roots = whitened(d, np.eye(p) + np.swapaxes(s, 1, 2) @ s)
        square = np.sum(v**2, axis=1)
    else:  # (I + SᵀS)⁻¹ = I − Sᵀ (I + SSᵀ)⁻¹ S
        v, roots = whitened(np.einsum("kij,kj->ki", s, d), np.eye(n_members) + s @ np.swapaxes(s, 1, 2))
        square = np.sum(d**2, axis=1) - np.sum(v**2, axis=1)
    return np.asarray(-0.5 * square - np.sum(np.log(roots), axis=1) - log_norm)


@dataclass(frozen=True)
class SequentialState:
    """What a run has found so far: moments of forecast, analysis (by y_1…y_k) and smoothed ensemble (by y_1…y_{k+L}).

    The last L smoothed rows of the IEnKS, unless ``to_end``, and all of a filter without a smoother are NaN.
    ``predicted``: moments (K, p) of the forecast where it was observed. ``ranks`` (K, p): place of the observation
    among the members with errors of the observations, 0 to 1, NaN where there was none. ``evidence`` (K,): log density
    of the observations of a time given those before, of the Gaussian of the forecast; NaN in a twin experiment.
    ``iterations`` (K,) forecasts of the window; ``left`` (K,) the length of the step that a limit made their last, in
    posterior standard deviations, 0 where they were done. ``effective`` (K,): members that the weights of a particle
    filter leave, NaN: all. ``members`` (N', n + changes of what varies) at the ``start`` of the window (0: time zero,
    k: observation time k); ``kept``: index of a time → analysis members (N', n), physical; ``failures`` the reasons of
    the members lost. ``bystanders`` (N', m): constants that nothing depends on, N(0, 1) at the start, as the analyses
    of a scheme that perturbs have left them; (N', 0) of another. ``residuals`` (K, p): observations less the
    predictions of the analysis, over their errors; NaN of a filter.

    The rest of a run depends on its arguments and these alone: ``cycle`` observation times are done; ``trail`` is what
    a smoother keeps, ``covariances`` are averages, (n, p) and (p, p), both empty of a run that has ended. Random
    numbers are drawn by cycle, so that no generator has a state.
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
    cycle: int = 0
    start: int = 0
    trail: tuple[Array, ...] = ()
    covariances: tuple[Array, ...] = ()
    bystanders: Array = field(default_factory=lambda: np.empty((0, 0)))
    residuals: Array = field(default_factory=lambda: np.empty((0, 0)))
    left: Array = field(default_factory=lambda: np.empty(0))

    @property
    def ensemble(self) -> Array:
        """The members."""
        return self.members
