"""A model whose parameters vary in time, or whose state changes at knots, run piece by piece.

Its state at a knot goes on with the value of the next piece in the field that has the parameter's name. Any model whose
state carries the parameter, and that can be resumed from a state, can be run like this.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from en4dvar.forward import Alternative, Failure, ForwardModel
from en4dvar.state import Array, StateLayout
from en4dvar.varying.paths import Outcomes, Walk
from en4dvar.varying.random_walk import RandomWalk
from en4dvar.varying.state_changes import StateChanges

ATTRIBUTES = (
    "observables", "time_unit", "time_display_unit", "batch", "compiled", "validity", "path_quantities",
)  # fmt: skip


Varying = RandomWalk | StateChanges


def can_vary(model: ForwardModel, name: str) -> bool:
    """Whether a parameter can change on the way: the state carries it, and it does not act at the start alone."""
    acts = not model.path_parameters or name in model.path_parameters
    return (
        model.resumable
        and acts
        and name in model.layout.names
        and model.layout[name].stop - model.layout[name].start == 1
    )


class PiecewiseModel(ForwardModel):
    """``model`` with what varies; the changes are parameters of its own, and its state carries their values along."""

    def __init__(self, model: ForwardModel, varying: Sequence[Varying]):
        self.model, self.varying = model, tuple(varying)
        self.walks = tuple(one for one in self.varying if isinstance(one, RandomWalk))
        self.state_changes = tuple(one for one in self.varying if isinstance(one, StateChanges))
        self.parameters = (*model.parameters, *(term.parameter for one in self.varying for term in one.terms))
        self.layout = StateLayout((*model.layout.fields, *(one.own for one in self.varying)))
        varied = {walk.name for walk in self.walks}
        self.path_parameters = tuple(name for name in model.path_parameters if name not in varied)
        for name in ATTRIBUTES:
            setattr(self, name, getattr(model, name))

    @property
    def dense(self) -> bool:
        """As the model."""
        return self.model.dense

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """Those of the model, with the same parameters varying."""
        return tuple(
            replace(one, model=PiecewiseModel(one.model, self.varying)) if one.model else one
            for one in self.model.alternatives
        )

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({name: np.array([value]) for name, value in theta.items()})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """As of the model. Raises ValueError where a piece lies outside of the parameter's bounds."""
        inner = self.model.initial_states({p.name: theta[p.name] for p in self.model.parameters})
        return np.hstack([inner, *(one.values(theta) for one in self.varying)])

    def doubts(
        self, observable: str, times: Array, values: Array, predicted: Array, members: Mapping[str, Array]
    ) -> Sequence[str]:
        """Those of the model."""
        return self.model.doubts(observable, times, values, predicted, members)

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Raises RuntimeError with the model's reason where it fails."""
        (path,) = self.resumed(x[None], np.array([t0]), np.array([[t1]]))
        if isinstance(path, Failure):
            raise RuntimeError(path.reason)
        return np.asarray(path.states[-1])

    def trajectories(self, x: Array, times: Array) -> Outcomes:
        return self.resumed(x, np.zeros(len(x)), np.broadcast_to(times, (len(x), np.shape(times)[-1])))

    def resumed(self, x: Array, start: Array, times: Array) -> Outcomes:
        walk, inner = Walk(x, times, self.layout), np.array(x[:, : self.model.layout.size])
        knots = sorted({knot for one in self.varying for knot in one.knots})
        for begin, end in zip((-math.inf, *knots), (*knots, math.inf), strict=True):
            if not len(walk.alive) or begin >= times[:, -1].max():
                break
            for one in self.walks:
                piece = int(np.searchsorted(one.knots, begin, side="right"))
                inner[:, self.model.layout[one.name]] = x[:, [self.layout[one.pieces_name].start + piece]]
            since = np.maximum(start, begin)

            def integrate(members: npt.NDArray[np.intp], asked: Array, since: Array = since) -> Outcomes:
                return self.model.resumed(inner[members], since[members], asked)

            ends = walk.run(begin, end, integrate)
            inner[walk.alive] = ends.reshape(-1, inner.shape[1])
            self._change(walk, inner, end, start <= end)
        return walk.outcomes()

    def _change(self, walk: Walk, inner: Array, knot: float, concerned: npt.NDArray[np.bool_]) -> None:
        """Change the states (N, n_state) at a knot, of the members (N,) ``concerned``; some may not survive it."""
        for one in self.state_changes:
            if knot not in one.knots:
                continue
            members, where = walk.alive[concerned[walk.alive]], self.model.layout[one.name]
            change = walk.x[members, self.layout[one.own.name].start + one.knots.index(knot)]
            inner[members, where], inside = one.applied(inner[members, where], change)
            for i in members[~inside].tolist():
                low, high = one.field.bounds
                reason = f"{one.name} outside ({low:g}, {high:g}) {one.field.unit} after its change"
                walk.failures[i] = Failure(reason, knot)
