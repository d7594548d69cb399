"""Forward runs of every data set about its posterior under an interim prior, and the emulators learnt from them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from en4dvar.prior import member_stream
from en4dvar.state import Array
from en4dvar_bubble.study.effort import Effort
from en4dvar_bubble.study.emulator import Emulators, draw_interim, fit_emulators
from en4dvar_bubble.study.marginals import TEMPERATURE
from en4dvar_bubble.study.set_runs import Runs, log_likelihood

SAMPLE, SEARCH = 512, 80  # of the interim prior, and rounds of a search from it
POOR = 4.0  # standard deviations of χ²


class Training:
    """Points (S, B, n) that were run and what came of them (S, B, K); ``count`` forward runs.

    The first are visited by walkers of each set under N(mean, std²), by differential evolution (ter Braak 2006), from
    ``start`` on. Where that fits too badly to be chance (it may have ended in a minimum that is not the lowest), they
    start from where a search from a sample of N(mean, std²) ends, if that is better.
    """

    def __init__(
        self, runs: Runs, start: Array, mean: Array, std: Array, seed: int, effort: Effort, workers: int = 1
    ):  # fmt: skip
        self.runs, self.seed, self.degree, self.workers = runs, seed, effort.degree, workers
        walkers, rounds = effort.walkers, effort.rounds
        stream = member_stream(seed, "interim runs")
        n_sets, n_members, n = start.shape
        half, sets = walkers // 2, np.arange(n_sets)
        x = start[:, stream.permutation(n_members)[: 2 * half]].transpose(1, 0, 2).copy()
        logs = log_likelihood(runs, runs.predictions(x))
        density = logs + _gauss(x, mean, std)
        readings = np.sum(runs.weight > 0, axis=1)
        poor = np.flatnonzero(-2 * logs.mean(axis=0) > readings + POOR * np.sqrt(2 * readings))
        self.count = (rounds + 1) * 2 * half * n_sets
        if len(poor):
            found, best = self._searched(poor, mean, std, 2 * half, stream)
            better = poor[best.max(axis=0) > density[:, poor].max(axis=0)]
            chosen = np.isin(poor, better)
            x[:, better], density[:, better] = found[:, chosen], best[:, chosen]
        x, density = x.reshape(2, half, n_sets, n), density.reshape(2, half, n_sets)
        points, predictions, kept = [], [], []
        for step in range(rounds):
            for g in (0, 1):
                a = stream.integers(half, size=(half, n_sets))
                b = (a + stream.integers(1, half, size=(half, n_sets))) % half
                jump = 1.0 if step % 10 == 0 else 2.38 / math.sqrt(2 * n) * (1.0 if step % 2 else 0.5)
                trial = x[g] + jump * (x[1 - g][a, sets] - x[1 - g][b, sets])
                trial = trial + 1e-3 * std * stream.standard_normal(trial.shape)
                seen = runs.predictions(trial)
                new = log_likelihood(runs, seen) + _gauss(trial, mean, std)
                better = np.log(stream.uniform(size=new.shape)) < new - density[g]
                x[g] = np.where(better[..., None], trial, x[g])
                density[g] = np.where(better, new, density[g])
                if step >= rounds // 6:
                    points.append(trial)
                    predictions.append(seen)
                    kept.append(x[g].copy())
        self.at, self.seen = np.concatenate(points).transpose(1, 0, 2), np.concatenate(predictions).transpose(1, 0, 2)
        self.visited, self.refits = 0, 0
        self.emulators = self._fit(np.concatenate(kept).transpose(1, 0, 2), mean, std)
        self.refit(mean, std, effort.refits)

    def refit(self, mean: Array, std: Array, times: int) -> Emulators:
        """The emulators after so many turns of running where they see the posterior under N(mean, std²).

        In every other turn it is the tempered one, which the weights draw from as well.
        """
        for _ in range(times):
            words, hot = f"training draws {self.refits}", TEMPERATURE if self.refits % 2 else 1.0
            draws = draw_interim(
                self.emulators, mean, std, self.seed, words, count=4, temperature=hot, workers=self.workers
            )
            told = np.concatenate([self.runs.predictions(part) for part in np.array_split(draws.transpose(1, 0, 2), 4)])
            self.at = np.concatenate([self.at, draws], axis=1)
            self.seen = np.concatenate([self.seen, told.transpose(1, 0, 2)], axis=1)
            self.visited += draws.shape[1]
            self.count += draws.shape[0] * draws.shape[1]
            self.refits += 1
            self.emulators = self._fit(draws, mean, std)
        return self.emulators

    def _searched(
        self, sets: npt.NDArray[np.intp], mean: Array, std: Array, count: int, stream: np.random.Generator
    ) -> tuple[Array, Array]:
        """(count, s, n) coordinates that differential evolution finds for ``sets``, and their log-densities."""

        def evaluated(at: Array) -> Array:
            self.count += at.shape[0] * at.shape[1]
            told = np.concatenate(
                [log_likelihood(self.runs, self.runs.predictions(p, sets), sets) for p in np.array_split(at, 8)]
            )
            return told + _gauss(at, mean, std)

        own = np.arange(len(sets))
        x = mean + std * stream.standard_normal((SAMPLE, len(sets), len(mean)))
        density = evaluated(x)
        first = np.argsort(-density, axis=0)[:count]
        x, density = x[first, own], density[first, own]
        for _ in range(SEARCH):
            a = stream.integers(count, size=density.shape)
            b = (a + stream.integers(1, count, size=density.shape)) % count
            top = x[np.argmax(density, axis=0), own]
            pull, push = stream.uniform(0, 1, (2, *density.shape, 1))
            trial = x + pull * (top - x) + push * (x[a, own] - x[b, own])
            new = evaluated(trial)
            better = new > density
            x, density = np.where(better[..., None], trial, x), np.where(better, new, density)
        return x, density

    def _fit(self, draws: Array, mean: Array, std: Array) -> Emulators:
        log_prior = _gauss(self.at, mean, std)
        return fit_emulators(
            self.at, self.seen, log_prior, self.runs.values, self.runs.weight, draws, self.degree, self.visited
        )


def _gauss(x: Array, mean: Array, std: Array) -> Array:
    return np.asarray(-0.5 * np.sum(((x - mean) / std) ** 2, axis=-1))
