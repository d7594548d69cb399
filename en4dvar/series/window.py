"""One window of a series: the members at its start, and the observations in it that are assimilated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.descent.loop import Descends, Objective
from en4dvar.descent.step_control import Move
from en4dvar.ensemble.linalg import centre
from en4dvar.model.state import Array
from en4dvar.schemes.base import Evaluation, GaussNewtonStep, Runs, Scheme, Step, Weights
from en4dvar.schemes.localisation import BlockDescents, BlockLocalisation
from en4dvar.series.moving import Flow, MembersLost
from en4dvar.series.series import CycleSeries

Batch = Sequence[tuple[int, float]]  # index of each observation time in the window, and how much its observations count


@dataclass
class CycleDescent(Descends):
    """The descent of one cycle."""

    weights: Weights
    iteration: int = 0


@dataclass(frozen=True)
class Ahead:
    """Forecasts of the members before the analysis, at the time of ``index``: ``states`` (N, n), ``predicted`` (N, p).

    Anomalies of the states are ``width`` times those of the ensemble.
    """

    index: int
    states: Array
    predicted: Array
    width: float


class CycleWindow(Objective[CycleDescent]):
    """The window that begins at the time of index ``start`` with ``members`` (N, n + q m), see :class:`Flow`."""

    def __init__(
        self,
        flow: Flow,
        series: CycleSeries,
        members: Array,
        start: int,
        batch: Batch,
        localisation: BlockLocalisation | None,
        scheme: Scheme,
        stream: Callable[[str, int], Array],
    ):
        self.flow, self.series, self.members, self.start, self.batch = flow, series, members, start, batch
        self.scheme, self.stream = scheme, stream
        self.indices = [index for index, _ in batch]
        self.mean, self.anomalies = centre(members)
        self.localised: Array | None = None
        self.localisation = localisation and _over(localisation, flow, members.shape[1], len(batch))
        local = self.localisation
        self.local = BlockDescents(local, members) if local and not scheme.filters else None
        self.runs: Runs | None = None
        self.ahead: list[Ahead] = []

    def linearise(self, going: Sequence[CycleDescent]) -> list[Step | GaussNewtonStep]:
        (descent,), scheme = going, self.scheme
        self.runs = self.run(descent)
        evaluation = self.whiten(*scheme.linearise(descent.weights, self.runs))
        if self.localisation is not None and self.local is None:
            self.localised = self.localisation.analysis(scheme, self.members, evaluation, self.draw)
        return [scheme.advance(descent.weights, evaluation, descent.iteration, self.draw)]

    def run(self, descent: CycleDescent) -> Runs:
        """The members of the scheme through the window. Raises :class:`MembersLost`."""
        scheme = self.scheme
        if descent.iteration == 0:  # here w = 0 and the members are those of the window, or close to their mean
            width = 1.0 if scheme.filters else float(scheme.members(descent.weights)[0, 0])
            members = self.members if width == 1 else self.mean + width * self.anomalies
        elif self.local:
            members = self.local.members(scheme.members)
        else:
            members = self.mean + scheme.members(descent.weights) @ self.anomalies
        states = self.flow.forecast(members, self.start, self.indices)
        each = [self.flow.predict(at, index) for at, index in zip(states, self.indices, strict=True)]
        predicted = each[0] if len(each) == 1 else np.hstack(each)
        if not np.isfinite(predicted).all():
            raise MembersLost(["" if row.all() else "non-finite prediction" for row in np.isfinite(predicted)])
        if descent.iteration == 0:
            self.ahead = [Ahead(i, at, p, width) for i, at, p in zip(self.indices, states, each, strict=True)]
        return Runs(predicted)

    def whiten(self, reference: Array, anomalies: Array) -> Evaluation:
        """The observations of every time in the window, one below the other."""
        p, parts = self.series.values.shape[1], []
        for j, (index, weight) in enumerate(self.batch):
            own = slice(j * p, (j + 1) * p)
            d, S = self.series.whiten(index - 1, reference[own], anomalies[:, own])
            parts.append((d, S) if weight == 1 else (np.sqrt(weight) * d, np.sqrt(weight) * S))
        if len(parts) == 1:
            return Evaluation(*parts[0])
        return Evaluation(np.concatenate([d for d, _ in parts]), np.concatenate([S for _, S in parts]))

    def draw(self, purpose: str, columns: int | None = None) -> Array:
        size = columns or self.series.values.shape[1] * len(self.batch)
        return self.stream(f"{purpose}, cycle {self.indices[-1] - 1}", size)

    def move(self, going: Sequence[CycleDescent], moves: Sequence[Move | None]) -> None:
        (descent,), scheme = going, self.scheme
        if self.local is None:
            descent.weights = descent.step.weights
        else:  # the blocks' own steps from the same runs, of which the largest tells when a cycle ends
            assert self.runs is not None
            step = self.local.advance(scheme, self.runs, self.whiten, descent.iteration, self.draw)
            descent.step = Step(descent.weights, step)
        descent.ended = scheme.done(descent.iteration, descent.step)
        if self.local and descent.ended:
            self.localised = self.local.members(lambda weights: weights.rows)
        descent.iteration += 1

    def posterior(self, descent: CycleDescent) -> tuple[Array, Array]:
        """Mean and anomalies of the members after the analysis."""
        if self.localised is not None:
            return centre(self.localised)
        weights = descent.weights
        return self.mean + weights.w @ self.anomalies, weights.T @ self.anomalies


def _over(localisation: BlockLocalisation, flow: Flow, size: int, times: int) -> BlockLocalisation:
    """The same for members that hold model errors too, and for observations at several ``times``.

    The changes of a variable are localised as the variable is.
    """
    blocks = localisation.blocks
    if flow.error is not None and size > flow.size:
        where = flow.error.where
        firsts = range(flow.size, size, len(where))
        blocks = [
            np.concatenate([block, *(first + np.flatnonzero(np.isin(where, block)) for first in firsts)])
            for block in blocks
        ]
    return replace(localisation, blocks=blocks, taper=np.tile(localisation.taper, (1, times)))
