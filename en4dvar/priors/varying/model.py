"""A model whose parameters vary in time, or whose state changes at knots, run piece by piece.

Its state at a knot goes on with the value of the next piece in the field that has the parameter's name. Any model whose
state carries the parameter, and that can be resumed from a state, can be run like this.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from en4dvar.model.forward import Alternative, Failure, ForwardModel
from en4dvar.model.state import Array, StateLayout
from en4dvar.plumbing.caution import Caution
from en4dvar.priors.varying.paths import Outcomes, Walk
from en4dvar.priors.varying.random_walk import RandomWalk
from en4dvar.priors.varying.state_changes import StateChanges

ATTRIBUTES = (
    "observables", "time_unit", "time_display_unit", "batch", "compiled", "validity", "path_quantities",
)  # fmt: skip


Varying = RandomWalk | StateChanges


def can_vary(model: ForwardModel, name: str) -> bool:
    """True if a parameter can change on the way: the state carries it, and it does not act at the start alone."""
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
        self.walks = tuple(change for change in self.varying if isinstance(change, RandomWalk))
        self.state_changes = tuple(change for change in self.varying if isinstance(change, StateChanges))
        self.parameters = (*model.parameters, *(term.parameter for change in self.varying for term in change.terms))
        self.layout = StateLayout((*model.layout.fields, *(change.own for change in self.varying)))
        varied = {walk.name for walk in self.walks}
        self.path_parameters = tuple(name for name in model.path_parameters if name not in varied)
        for name in ATTRIBUTES:
            setattr(self, name, getattr(model, name))

    @property
    def dense(self) -> bool:
        """The same as of the model."""
        return self.model.dense

    @property
    def unforeseen(self) -> Mapping[str, float]:  # type: ignore[override]
        """The same as of the model."""
        return self.model.unforeseen

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """Those of the model, with the same parameters varying."""
        return tuple(
            replace(alternative, model=PiecewiseModel(alternative.model, self.varying))
            if alternative.model
            else alternative
            for alternative in self.model.alternatives
        )

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({name: np.array([value]) for name, value in theta.items()})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """Initial states of the model with the varying parameters appended. Raises ValueError where a piece lies
        outside of the parameter's bounds.
        """
        inner = self.model.initial_states({p.name: theta[p.name] for p in self.model.parameters})
        return np.hstack([inner, *(change.values(theta) for change in self.varying)])

    def changed(self, name: str, x: Array, change: Array) -> Array:
        """As of the model."""
        inner = self.model.layout.size
        return np.hstack([self.model.changed(name, x[:, :inner], change), x[:, inner:]])

    def doubts(
        self, observable: str, times: Array, values: Array, predicted: Array, members: Mapping[str, Array]
    ) -> Sequence[str | Caution]:
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
        knots = sorted({knot for change in self.varying for knot in change.knots})
        for begin, end in zip((-math.inf, *knots), (*knots, math.inf), strict=True):
            if not len(walk.alive) or begin >= times[:, -1].max():
                break
            for change in self.walks:
                piece = int(np.searchsorted(change.knots, begin, side="right"))
                inner[:, self.model.layout[change.name]] = x[:, [self.layout[change.pieces_name].start + piece]]
            since = np.maximum(start, begin)

            def integrate(members: npt.NDArray[np.intp], asked: Array, since: Array = since) -> Outcomes:
                return self.model.resumed(inner[members], since[members], asked)

            ends = walk.run(begin, end, integrate)
            inner[walk.alive] = ends.reshape(-1, inner.shape[1])
            self._change(walk, inner, end, start <= end)
        return walk.outcomes()

    def _change(self, walk: Walk, inner: Array, knot: float, concerned: npt.NDArray[np.bool_]) -> None:
        """Change the states (N, n_state) at a knot, of the members (N,) ``concerned``; some may not survive it."""
        for process in self.state_changes:
            if knot not in process.knots:
                continue
            members = walk.alive[concerned[walk.alive]]
            change = walk.x[members, self.layout[process.own.name].start + process.knots.index(knot)]
            inner[members], inside = process.applied(self.model, inner[members], change)
            for i in members[~inside].tolist():
                low, high = process.field.bounds
                reason = f"{process.name} outside ({low:g}, {high:g}) {process.field.unit} after its change"
                walk.failures[i] = Failure(reason, knot)
