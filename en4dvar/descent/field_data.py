"""What localised schemes work on: readings with a model that predicts them, an ensemble, and what they tell."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import member_stream
from en4dvar.problem import InverseProblem
from en4dvar.schemes.local_gain import parts
from en4dvar.schemes.settings import AssimilationSettings

Members = npt.NDArray[np.intp]
Forward = Callable[[Array], Array]  # members (M, n) → predictions (M, K)


@dataclass(frozen=True)
class FieldData:
    """Readings ``values`` (K,) with independent errors ``std`` (K,), and the model that predicts them.

    ``forward``: members (M, n) → predictions (M, K); it gets ``at_once`` members in a call.
    """

    values: Array
    std: Array
    forward: Forward
    at_once: int = 16

    def predict(self, members: Callable[[slice], Array], count: int) -> Array:
        """Predictions (count, K) of members that are made a few at a time. Raises as :meth:`enough`."""
        return self.enough(self.runs(members, count))

    def runs(self, members: Callable[[slice], Array], count: int) -> Array:
        """The same, NaN where a reading is missing."""
        predictions = np.empty((count, len(self.values)))
        for first in range(0, count, self.at_once):
            some = slice(first, min(first + self.at_once, count))
            predictions[some] = np.asarray(self.forward(members(some)), dtype=float)
        return predictions

    @staticmethod
    def enough(predictions: Array, fewest: int | None = None) -> Array:
        """Predictions (M, K) as they are.

        Raises :class:`En4dvarError` where those of fewer than ``fewest``, by default all, are finite.
        """
        count = len(predictions)
        lost = np.flatnonzero(~np.isfinite(predictions).all(axis=1))
        if count - len(lost) < (count if fewest is None else fewest):
            raise En4dvarError(f"{len(lost)} of {count} members have predictions that are not finite, first {lost[0]}")
        return predictions

    def width(self, members: int) -> int:
        """Numbers that a cell takes in an update."""
        return max(len(self.values), members)

    def perturbations(self, seed: int, purpose: str, members: Iterable[int]) -> Array:
        """Draws (M, K) of the errors of ``members``, centred."""
        z = np.stack([member_stream(seed, purpose, i).standard_normal(len(self.values)) for i in members])
        return np.asarray(self.std * (z - z.mean(axis=0)))


@dataclass(frozen=True)
class Pass:
    """Where a descent stands, or ES-MDA before a pass: the ``centre`` (n,) and its ``prediction`` (K,), J_b there.

    ``step`` is the length of the next step, ``share`` the part of it that is taken, ``dfs`` the trace of H K;
    ``members`` gives a part (N, m) of the ensemble. What is not known is NaN.
    """

    centre: Array
    prediction: Array
    members: Callable[[slice], Array]
    background: float = math.nan
    step: float = math.nan
    share: float = 1.0
    dfs: float = math.nan


def silent(_: Pass) -> None:
    """Where nobody listens."""


def mean_of(ensemble: Array, alive: Members) -> Array:
    """(n,) of some members of (N, n), a part at a time."""
    each = parts(ensemble.shape[1], len(ensemble))
    return np.concatenate([ensemble[alive, part].mean(axis=0) for part in each])


def prior_members(problem: InverseProblem, settings: AssimilationSettings, seed: int) -> Array:
    """The prior ensemble (N, n + m): n parameters with names, m cells of fields; ``exact`` has the prior's mean."""
    prior, n = problem.prior, len(problem.prior.terms)
    ensemble = np.empty((settings.members, n + sum(field.field.size for field in problem.fields)))
    if n:
        exact = settings.sampling == "exact" and settings.members > n
        ensemble[:, :n] = prior.sample(settings.members, seed, "exact" if exact else "random")
    for field, columns in problem.columns_of_fields:
        for i, member in enumerate(ensemble):
            member[n + columns.start : n + columns.stop] = field.draw(seed, i)
    if settings.sampling == "exact":
        mean = mean_of(ensemble, np.arange(len(ensemble)))
        mean[:n] -= prior.mean
        ensemble -= mean
    return ensemble
