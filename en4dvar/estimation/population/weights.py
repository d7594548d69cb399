"""Importance weights of draws h of a population: with emulators for all of them, with forward runs for the best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from en4dvar.estimation.population.hyper import Hyper
from en4dvar.estimation.population.likelihoods import EmulatedLikelihood
from en4dvar.estimation.population.marginals import Marginals, SetPosterior, marginals
from en4dvar.estimation.population.mixtures import log_marginal
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.forward_runs import CampaignRuns, log_likelihood
from en4dvar.sampling.mixture import StudentMixture, resampled

NOISE = 0.4  # variance of a log-weight that estimates of the marginals may add
FEWEST, MOST = 8, 1000  # draws of one marginal
PILOT, TRIAL = 64, 256  # populations and draws from which the numbers of draws are found
PICKS = 8  # most forward runs of one set for one h
BATCH = 50  # populations of one call for forward runs


@dataclass(frozen=True)
class Weighed:
    """Draws ``h`` (B, 2p) with logs of their weights (B,), not normalised, and of each x (B, S, P, n) given h: from
    forward runs P = 1, given the data as well.
    """

    h: Array
    logs: Array
    x: Array

    @property
    def effective(self) -> float:
        """Effective number of draws."""
        weights = normalised(self.logs)[0]
        return float(1 / np.sum(weights**2))

    def resampled(self, count: int, stream: np.random.Generator) -> npt.NDArray[np.intp]:
        """(count,) indices of draws, each as often as its weight says."""
        return resampled(normalised(self.logs)[0], count, stream)


def normalised(logs: Array) -> tuple[Array, float]:
    """Weights that add up to one, and ln of their mean before.

    Raises
    ------
    ValueError: all of them are zero.
    """
    top = float(logs.max())
    if not np.isfinite(top):
        raise ValueError("none of the populations that were drawn explains the data")
    weights = np.exp(logs - top)
    return weights / weights.sum(), top + math.log(float(weights.mean()))


def with_emulators(
    hyper: Hyper, proposal: StudentMixture, sets: Sequence[SetPosterior], count: int, seed: int, turn: int, workers: int
) -> Weighed:
    """``count`` draws of the proposal with the weights p(h) Π_i p_i(h) / q(h) (Tran et al. 2013, "IS²").

    Each marginal p_i is estimated without bias, so that the weights are right whatever the numbers of draws; these are
    such that estimates add a variance of :data:`NOISE` to a log-weight.
    """
    h = proposal.draw(count, member_stream(seed, "proposal", turn))
    logs = hyper.log_density(h) - proposal.log_density(h)
    inside = np.flatnonzero(np.isfinite(logs))
    mean, variance = hyper.population(h[inside])
    likely = normalised(logs[inside] + log_marginal([interim.mixture for interim in sets], mean, variance))[0]
    pilot = member_stream(seed, "pilot", turn).choice(len(inside), PILOT, p=likely)

    def estimated(rows: npt.NDArray[np.intp] | slice, counts: list[int], words: str) -> Marginals:
        return marginals(sets, mean[rows], variance[rows], counts, PICKS, seed, f"{words} {turn}", workers)

    root = np.sqrt(estimated(pilot, [TRIAL] * len(sets), "trial marginals").variance.mean(axis=0))
    counts = np.clip(root * root.sum() / NOISE, FEWEST, MOST).astype(int).tolist()
    estimates = estimated(slice(None), counts, "marginals")
    logs[inside] += estimates.logs.sum(axis=1)
    x = np.empty((len(h), *estimates.x.shape[1:]))
    x[inside] = estimates.x
    return Weighed(h, logs, x)


def with_runs(
    weighed: Weighed,
    likelihoods: Sequence[EmulatedLikelihood],
    runs: CampaignRuns,
    count: int,
    stream: np.random.Generator,
) -> tuple[Weighed, int]:
    """``count`` draws, as often as their weights say, weighed by Π_i of the mean L_i/L̂_i over draws of x_i; runs made.

    Sets whose emulator errs get more than one forward run for each h, until the variance that the errors give to a
    log-weight falls below :data:`NOISE` or :data:`PICKS` are reached.
    """
    kept = weighed.resampled(count, stream)
    x = weighed.x[kept]
    n_sets = x.shape[1]
    ratio = np.full((count, n_sets, PICKS), -np.inf)  # ln L/L̂
    done, wanted = np.zeros(n_sets, dtype=int), np.ones(n_sets, dtype=int)
    while not np.array_equal(done, wanted):
        for k in range(PICKS):
            sets = np.flatnonzero((done <= k) & (wanted > k))
            if len(sets):
                ratio[:, sets, k] = _errors(runs, likelihoods, x[:, sets, k], sets)
        done = wanted.copy()
        errors = _relative_variance(ratio) / done
        while errors.sum() > NOISE:
            worst = int(np.argmax(np.where(wanted < PICKS, errors, 0.0)))
            if wanted[worst] == PICKS or errors[worst] < NOISE / (2 * n_sets):
                break  # what remains is beyond more runs
            wanted[worst] *= 2
            errors[worst] /= 2
    logs = np.logaddexp.reduce(ratio, axis=2) - np.log(done)
    # one of the draws of each x by its weight (Gumbel 1954), from a stream of its own
    own = np.random.Generator(cast(np.random.Philox, stream.bit_generator).jumped())
    pick = np.argmax(ratio + own.gumbel(size=ratio.shape), axis=2)
    chosen = np.take_along_axis(x, pick[:, :, None, None], axis=2)
    return Weighed(weighed.h[kept], logs.sum(axis=1), chosen), count * int(done.sum())


def _errors(
    runs: CampaignRuns, likelihoods: Sequence[EmulatedLikelihood], x: Array, sets: npt.NDArray[np.intp]
) -> Array:
    """ln L/L̂ (B, s) of coordinates (B, s, n) of ``sets``."""
    parts = [x[i : i + BATCH] for i in range(0, len(x), BATCH)]
    exact = np.concatenate([log_likelihood(runs, runs.predictions(part, sets), sets) for part in parts])
    emulated = np.stack([likelihoods[s].log(x[:, i]) for i, s in enumerate(sets)], axis=1)
    return np.asarray(exact - emulated)


def _relative_variance(logs: Array) -> Array:
    """(S,) of exp(logs) (B, S, P) relative to the square of its mean; entries not computed yet are −inf and no draw."""
    weights = np.exp(logs - logs.max(axis=(0, 2), keepdims=True))
    computed = np.isfinite(logs).any(axis=0)  # (S, P)
    count = len(logs) * np.maximum(computed.sum(axis=1), 1)
    mean = weights.sum(axis=(0, 2)) / count
    return np.asarray((weights**2).sum(axis=(0, 2)) / count / mean**2 - 1)
