"""Forward runs of every data set about its posterior under an interim prior, and the emulators learnt from them."""

from __future__ import annotations

import math

import numpy as np

from en4dvar.estimation.population.effort import Effort
from en4dvar.estimation.population.likelihoods import JITTER, EmulatedLikelihood, draw_interim, fit_likelihood
from en4dvar.estimation.population.marginals import TEMPERATURE
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.evidence import sample_sets
from en4dvar.sampling.forward_runs import CampaignRuns, Sets, log_likelihood
from en4dvar.sampling.importance import Importance, about
from en4dvar.sampling.mixture import resampled

DRAWS = 400  # of a round of the search for all modes
SETTLING = 6  # the walkers' positions are kept after this part of their rounds


class Training:
    """Points (S, B, n) that were run and what came of them (S, B, K); ``count`` forward runs.

    The first are visited by walkers of each set under N(mean, std²). They start from draws of that posterior, all its
    modes in their proportions, by importance sampling from N(mean, std²) and ``start``, which may have missed some.
    """

    def __init__(
        self, runs: CampaignRuns, start: Array, mean: Array, std: Array, seed: int, effort: Effort, workers: int = 1
    ):  # fmt: skip
        self.runs, self.seed, self.degree, self.workers = runs, seed, effort.degree, workers
        self.count, self.revisited, self.refits = 0, 0, 0
        self.at, self.outputs = np.empty((0, 0, 0)), np.empty((0, 0, 0))
        stream = member_stream(seed, "interim runs")
        walkers = effort.walkers // 2 * 2
        x, density = self._started(start, walkers, mean, std, stream)
        kept = self._visit(x, density, mean, std, effort.rounds, stream)
        self.likelihoods = self._fitted(kept, mean, std)
        self.refit(mean, std, effort.refits)

    def refit(self, mean: Array, std: Array, times: int) -> None:
        """So many turns of running where the emulators see the posterior under N(mean, std²).

        In every other turn it is the tempered one, which the weights draw from as well.
        """
        for _ in range(times):
            words, hot = f"training draws {self.refits}", TEMPERATURE if self.refits % 2 else 1.0
            draws = draw_interim(
                self.likelihoods, mean, std, self.seed, words, count=4, temperature=hot, workers=self.workers
            )
            outputs = np.concatenate([self._run(part) for part in np.array_split(draws.transpose(1, 0, 2), 4)])
            self.at = np.concatenate([self.at, draws], axis=1)
            self.outputs = np.concatenate([self.outputs, outputs.transpose(1, 0, 2)], axis=1)
            self.revisited += draws.shape[1]
            self.refits += 1
            self.likelihoods = self._fitted(draws, mean, std)

    def _run(self, x: Array, sets: Sets = None) -> Array:
        """Predictions (B, S, K) of control vectors (B, S, n)."""
        self.count += x.shape[0] * x.shape[1]
        return self.runs.predictions(x, sets)

    def _started(
        self, start: Array, walkers: int, mean: Array, std: Array, stream: np.random.Generator
    ) -> tuple[Array, Array]:
        """(W, S, n) where the walkers start, and their log-densities (W, S)."""
        started = {
            s: Importance(about((entry - mean) / std, 0.5), member_stream(self.seed, "start", s), DRAWS)
            for s, entry in enumerate(start)
        }
        sample_sets(self.runs, lambda z: mean + std * z, started)
        self.count += sum(len(entry.z) for entry in started.values())
        if failed := [s for s, entry in started.items() if not np.isfinite(entry.log)]:
            raise ValueError(f"no forward run of data set number {failed[0] + 1} succeeded")
        x = np.stack(
            [mean + std * entry.z[resampled(entry.shares, walkers, stream)] for entry in started.values()], axis=1
        )
        x = stream.permutation(x)  # which are in the order of their draws
        return x, log_likelihood(self.runs, self._run(x)) + _log_gauss(x, mean, std)

    def _visit(
        self, x: Array, density: Array, mean: Array, std: Array, rounds: int, stream: np.random.Generator
    ) -> Array:
        """(S, D, n) positions of walkers (W, S, n), which move by differential evolution (ter Braak 2006), each half
        about the other; what they try is what the emulators are learnt from.
        """
        _, n_sets, n = x.shape
        half, sets = len(x) // 2, np.arange(n_sets)
        x, density = x.reshape(2, half, n_sets, n), density.reshape(2, half, n_sets)
        points, outputs, kept = [], [], []
        for step in range(rounds):
            for g in (0, 1):
                a = stream.integers(half, size=(half, n_sets))
                b = (a + stream.integers(1, half, size=(half, n_sets))) % half
                jump = 1.0 if step % 10 == 0 else 2.38 / math.sqrt(2 * n) * (1.0 if step % 2 else 0.5)
                trial = x[g] + jump * (x[1 - g][a, sets] - x[1 - g][b, sets])
                trial = trial + JITTER * std * stream.standard_normal(trial.shape)
                predicted = self._run(trial)
                new = log_likelihood(self.runs, predicted) + _log_gauss(trial, mean, std)
                better = np.log(stream.uniform(size=new.shape)) < new - density[g]
                x[g] = np.where(better[..., None], trial, x[g])
                density[g] = np.where(better, new, density[g])
                if step >= rounds // SETTLING:
                    points.append(trial)
                    outputs.append(predicted)
                    kept.append(x[g].copy())
        self.at, self.outputs, positions = (
            np.concatenate(parts).transpose(1, 0, 2) for parts in (points, outputs, kept)
        )
        return positions

    def _fitted(self, draws: Array, mean: Array, std: Array) -> list[EmulatedLikelihood]:
        values, weight = self.runs.values, self.runs.weight
        log_prior = _log_gauss(self.at, mean, std)
        return [
            fit_likelihood(x, outputs, log, values[s], weight[s], draws[s], self.degree, self.revisited)
            for s, (x, outputs, log) in enumerate(zip(self.at, self.outputs, log_prior, strict=True))
        ]


def _log_gauss(x: Array, mean: Array, std: Array) -> Array:
    return np.asarray(-0.5 * np.sum(((x - mean) / std) ** 2, axis=-1))
