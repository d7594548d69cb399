"""A model whose parameters vary in time, run piece by piece.

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
from en4dvar.state import Array, Field, StateLayout
from en4dvar.varying.paths import Outcomes, Walk
from en4dvar.varying.random_walk import RandomWalk

ATTRIBUTES = (
    "observables", "time_unit", "time_display_unit", "batch", "compiled", "validity", "path_quantities",
)  # fmt: skip


def can_vary(model: ForwardModel, name: str) -> bool:
    """Whether a parameter can change on the way: the state carries it, and it does not act at the start alone."""
    acts = not model.path_parameters or name in model.path_parameters
    return acts and name in model.layout.names and model.layout[name].stop - model.layout[name].start == 1


class PiecewiseModel(ForwardModel):
    """``model`` with parameters that vary; the changes are parameters of its own, the pieces fields of its state."""

    def __init__(self, model: ForwardModel, varying: Sequence[RandomWalk]):
        self.model, self.varying = model, tuple(varying)
        self.parameters = (*model.parameters, *(c.parameter for walk in self.varying for c in walk.changes))
        own = (Field(v.pieces_name, len(v.knots) + 1, v.parameter.unit) for v in self.varying)
        self.layout = StateLayout((*model.layout.fields, *own))
        varied = {walk.name for walk in self.varying}
        self.path_parameters = tuple(name for name in model.path_parameters if name not in varied)
        for name in ATTRIBUTES:
            setattr(self, name, getattr(model, name))

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
        return np.hstack([inner, *(_within_bounds(walk, walk.pieces(theta)) for walk in self.varying)])

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
            for one in self.varying:
                piece = int(np.searchsorted(one.knots, begin, side="right"))
                inner[:, self.model.layout[one.name]] = x[:, [self.layout[one.pieces_name].start + piece]]
            since = np.maximum(start, begin)

            def integrate(members: npt.NDArray[np.intp], asked: Array, since: Array = since) -> Outcomes:
                return self.model.resumed(inner[members], since[members], asked)

            ends = walk.run(begin, end, integrate)
            inner[walk.alive] = ends.reshape(-1, inner.shape[1])
        return walk.outcomes()


def _within_bounds(walk: RandomWalk, pieces: Array) -> Array:
    p = walk.parameter
    if not np.all((pieces >= p.bounds[0]) & (pieces <= p.bounds[1]) & np.isfinite(pieces)):
        raise ValueError(f"a piece of {p.name} outside [{p.bounds[0]:g}, {p.bounds[1]:g}] {p.unit}")
    return pieces
