"""What is kept of the iterations: their records, and the worst loss of members."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.analysis import IterationRecord
from en4dvar.descent.step_control import Move
from en4dvar.descent.weight_space import Local, WeightSpace
from en4dvar.schemes import Step
from en4dvar.state import Array


@dataclass(frozen=True)
class Taken:
    """A step as it was taken: from where, the transform (N, N) there, and how far."""

    at: Local
    step: Step
    transform: Array
    step_length: float


def worse(worst: tuple[str, ...], at: Local) -> tuple[str, ...]:
    """Of two lists of failures, the worst so far and those of the members there, the one with more."""
    return max(worst, at.failures, key=lambda failures: sum(map(bool, failures)))


def make_records(space: WeightSpace, first: int, taken: Sequence[Taken]) -> list[IterationRecord]:
    """Records of one iteration or several in a row; ``first`` is the number of the first."""
    if not taken:
        return []
    w = np.array([each.at.weights.w for each in taken])[:, None]
    members = w + np.array([each.transform for each in taken])
    ensembles = space.control(np.concatenate([members, w], axis=1))
    physical = space.problem.prior.to_physical(ensembles)
    centres = [each.at.central for each in taken]
    # one row each (B, 1, K): a record has the same bits whichever others are made with it
    predictions = np.array([run.predictions for run in centres])
    rates = [run.rates for run in centres if run.rates is not None]
    scales = [run.noise_scale for run in centres if run.noise_scale is not None]
    chi2 = diag.chi2_per_observation(
        space.problem.observations,
        predictions,
        np.array(rates) if rates else None,
        np.array(scales) if scales else None,
    )[:, 0].tolist()
    spreads = diag.spread(ensembles[:, :-1], space.prior_variance).tolist()
    return [
        IterationRecord(
            iteration=first + i,
            cost=each.at.cost,
            background=each.at.background,
            observation=each.at.observation,
            step_norm=each.step.norm,
            step_length=each.step_length,
            chi2_per_observation=chi2[i],
            dfs=diag.dfs(each.step.hessian.singular_values, len(space.members)),
            spread=spreads[i],
            active=each.at.active,
            members=physical[i, :-1],
            centre=physical[i, -1],
        )
        for i, each in enumerate(taken)
    ]


@dataclass(frozen=True)
class History:
    """What is kept of iterations that are done: the transform (N, N) of the last, the records, and the worst loss."""

    transform: Array
    records: tuple[IterationRecord, ...] = ()
    worst_loss: tuple[str, ...] = ()

    def after(self, space: WeightSpace, path: Sequence[tuple[Local, Step, Move]]) -> History:
        """With the moves that followed, each with where it starts and the step there."""
        transform, worst_loss = self.transform, self.worst_loss
        taken = []
        for at, step, move in path:
            transform, worst_loss = step.transform, worse(worst_loss, at)
            taken.append(Taken(at, step, transform, move.step_length))
        return History(transform, (*self.records, *make_records(space, len(self.records), taken)), worst_loss)
