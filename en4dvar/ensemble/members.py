"""The members of a forecast as arrays: where they start, and what H reads from their paths.

Everything is one array operation as long as all members are well. Where one is not, members are taken one by one: those
in trouble get a reason, the others do not notice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.ensemble.batch import Batch
from en4dvar.executor import Outcome, describe
from en4dvar.forward import Failure
from en4dvar.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.state import Array

Indices = npt.NDArray[np.intp] | slice
EVERYONE = slice(None)


def out_of_bounds(prior: Prior, physical: Array) -> list[str]:
    """Reasons (B,) of the members (B, n) with a parameter outside its bounds, "" for the others."""
    failures = [""] * len(physical)
    low, high = prior.finite_bounds
    inside = (physical >= low) & (physical <= high)
    if not inside.all():
        low, high = prior.bounds
        for i, j in np.argwhere(~inside):
            p = prior.parameters[j]
            failures[i] = failures[i] or f"{p.name} outside [{low[j]:g}, {high[j]:g}] {p.unit}"
    return failures


def initial_states(problem: InverseProblem, physical: Array, failures: list[str]) -> tuple[Indices, Array]:
    """Which members (B', of B) have an initial state, and the states (B', n_state).

    Members with an entry in ``failures`` (B,) have none; the reasons of those that the model refuses are added there.
    """
    alive = _without(failures)
    size = problem.model.layout.size
    theta = {name: np.full(len(physical), float(value)) for name, value in problem.fixed.items()}
    theta.update(zip(problem.prior.names, physical.T, strict=True))

    def build(members: Indices) -> Array:
        everyone = isinstance(members, slice)
        values = theta if everyone else {name: value[members] for name, value in theta.items()}
        own = {p.name: values[p.name] for p in problem.model.parameters if p.name in values}
        states = _perturbed(problem, np.asarray(problem.model.initial_states(own), dtype=float), values)
        if states.shape != (len(physical if everyone else physical[members]), size):
            raise ValueError("misshapen initial state")
        if not np.isfinite(states).all():
            raise ValueError("non-finite initial state")
        return states

    if all(failures):
        return alive, np.empty((0, size))
    try:
        return alive, build(alive)
    except Exception:  # some member has no state: find out which, one by one
        states = []
    for i in np.arange(len(failures))[alive]:
        try:
            states.append(build(np.array([i])))
        except Exception as error:  # a model may refuse parameters in any way; the reason is kept
            failures[i] = describe(error)
    return _without(failures), np.concatenate([np.empty((0, size)), *states])


def _without(failures: list[str]) -> Indices:
    return np.flatnonzero([not reason for reason in failures]) if any(failures) else EVERYONE


def _perturbed(problem: InverseProblem, states: Array, theta: Mapping[str, Array]) -> Array:
    """Initial states (B, n_state) with the perturbations of the control vector; ValueError outside a field's bounds."""
    if not problem.perturbations or states.ndim != 2 or states.shape[1] != problem.model.layout.size:
        return states
    states = states.copy()
    fields = {f.name: f for f in problem.model.layout}
    for perturbation in problem.perturbations:
        where, value = problem.model.layout[perturbation.field], theta[perturbation.parameter.name][:, None]
        states[:, where] = states[:, where] * value if perturbation.relative else states[:, where] + value
        low, high = fields[perturbation.field].bounds
        if not np.all((states[:, where] > low) & (states[:, where] < high)):
            unit = fields[perturbation.field].unit
            raise ValueError(f"perturbed initial {perturbation.field} outside ({low:g}, {high:g}) {unit}")
    return states


@dataclass(frozen=True)
class Reading:
    """What is read from a path: ``quantities`` (T,) each, H and, where it is needed, its rate; ``largest`` by name.

    ``batched``: the quantities take a :class:`~en4dvar.ensemble.batch.Batch` as well and give (B, T).
    """

    quantities: tuple[Callable[[Any], Array], ...]
    largest: tuple[str, ...] = ()
    batched: bool = False

    def observe(self, outcomes: Sequence[Outcome], n_times: int) -> tuple[Array, Array, list[str]]:
        """Quantities (Q, B, T) and largest values (B, V) of B outcomes, NaN where a member failed, and reasons (B,)."""
        if (isinstance(outcomes, Batch) and outcomes.whole) or not any(isinstance(o, Failure) for o in outcomes):
            try:
                read = self._all(outcomes)
                if read[0].shape[1:] == (len(outcomes), n_times) and np.isfinite(read[0]).all():
                    return *read, [""] * len(outcomes)
            except Exception:  # of some member: find out which, one by one
                pass
        values = np.full((len(self.quantities), len(outcomes), n_times), np.nan)
        largest = np.full((len(outcomes), len(self.largest)), np.nan)
        reasons = [""] * len(outcomes)
        for i, outcome in enumerate(outcomes):
            if isinstance(outcome, Failure):
                reasons[i] = outcome.reason
                continue
            try:
                one = self._all([outcome])
            except Exception as error:  # H belongs to the user as well
                reasons[i] = describe(error)
                continue
            if one[0].shape[2:] != (n_times,):
                reasons[i] = "misshapen prediction"
            elif not np.isfinite(one[0]).all():
                reasons[i] = "non-finite prediction"
            else:
                values[:, i], largest[i] = one[0][:, 0], one[1][0]
        return values, largest, reasons

    def _all(self, outcomes: Sequence[Any]) -> tuple[Array, Array]:
        values: list[Any]
        largest: list[Any]
        if isinstance(outcomes, Batch) and self.batched:
            values = [read(outcomes) for read in self.quantities]
            largest = [outcomes.largest(name) for name in self.largest]
        else:
            values = [[read(path) for path in outcomes] for read in self.quantities]
            largest = [[path.largest(name) for path in outcomes] for name in self.largest]
        shape = (len(self.largest), len(outcomes))
        return np.array(values, dtype=np.float64), np.array(largest, dtype=np.float64).reshape(shape).T
