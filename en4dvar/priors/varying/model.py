"""What varies at knots: a parameter that is constant between them, or the state itself, and a model that is run so.

A random walk of a parameter is

    x_0 ~ N(mean, std²),     x_k = x_{k−1} + c_k,     c_k ~ N(0, q²)

in the transformed space of the parameter, whose prior is that of x_0. The changes c_k are parameters of the control
vector like any other, independent of each other and of x_0, so that J, its minimisation, the ensemble and the evidence
are what they are without; the values of the pieces are their sums. Where q is estimated it is a parameter as well, with
a half-normal prior, and the c_k / q ~ N(0, 1) take the place of the c_k, so that all are still independent.

The weak constraint: the state itself changes at knots by what the model does not know, its model error. A field of it
is multiplied by exp(c), or c is added to it, c ~ N(0, q²); these changes are parameters of the control vector too.

The model is run piece by piece. Its state at a knot goes on with the value of the next piece in the field that has the
parameter's name. Any model whose state carries the parameter, and that can be resumed from a state, can be run like
this.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from en4dvar.model.forward import (
    Alternative,
    Batch,
    Failure,
    ForwardModel,
    Trajectory,
    ValidityLimit,
    initial_states,
)
from en4dvar.model.state import Array, Field, Indices, Mask, Parameter, StateLayout
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.priors.prior import PriorTerm

SCALE = {"normal": "", "lognormal": "ln", "logit": "logit"}  # what a change is one of; else of the Gaussian score


@dataclass(frozen=True)
class RandomWalk:
    """``first`` is the prior of the first piece, ``changes`` (m) are those of the changes at the ``knots`` (m,).

    The knots are in the model's time, increasing and positive. ``spread`` is the prior of the changes' standard
    deviation where that is estimated; they then count it.
    """

    first: PriorTerm
    knots: tuple[float, ...]
    changes: tuple[PriorTerm, ...]
    spread: PriorTerm | None = None

    @classmethod
    def of(
        cls, model: ForwardModel, first: PriorTerm, knots: Sequence[float], std: float, estimated: bool = False
    ) -> "RandomWalk":
        """With changes N(0, std²) in the transformed space of ``first``. Raises :class:`ConfigError`. ``estimated``:
        ``std`` is that of the half-normal prior of their standard deviation.
        """

        def change(k: int, knot: float) -> PriorTerm:
            p = _change(model, first, k, knot)
            if estimated:
                p = replace(p, unit="1", display_unit="1", label=f"{p.label}, in its standard deviations")
            return PriorTerm.normal(p, 0.0, 1.0 if estimated else std)

        label = f"std of the changes of {SCALE.get(first.transform, 'score')} {first.parameter.label}"
        of_changes = _of_walk(first, "change_std", label, bounds=(0.0, math.inf))
        spread = PriorTerm.half_normal(of_changes, std) if estimated else None
        return cls(first, tuple(knots), tuple(change(k, knot) for k, knot in enumerate(knots, 1)), spread)

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        return (*([self.spread] if self.spread else []), *self.changes)

    @property
    def parameter(self) -> Parameter:
        return self.first.parameter

    @property
    def name(self) -> str:
        return self.parameter.name

    @property
    def label(self) -> str:
        return self.parameter.label

    @property
    def own(self) -> Field:
        """Where the state of a run, and a result file, keep the values of the pieces."""
        return Field(f"{self.name}_pieces", len(self.knots) + 1, self.parameter.unit)

    def values(self, theta: Mapping[str, Array]) -> Array:
        """:meth:`pieces`. Raises ValueError where one lies outside of the parameter's bounds."""
        p, pieces = self.parameter, self.pieces(theta)
        if not np.all((pieces >= p.bounds[0]) & (pieces <= p.bounds[1]) & np.isfinite(pieces)):
            raise ValueError(f"a piece of {p.name} outside [{p.bounds[0]:g}, {p.bounds[1]:g}] {p.unit}")
        return pieces

    def pieces(self, theta: Mapping[str, Array]) -> Array:
        """Physical values (…, m + 1) of the pieces, from those of the parameter and of its changes, (…,) by name. NaN
        where the parameter is outside of the range of its transform.
        """
        term, value = self.first, np.asarray(theta[self.name], dtype=float)
        low, high = term.range
        inside = (value > low) & (value < high)
        centre = term.to_physical(np.array(term.mean))
        first = np.where(inside, term.from_physical(np.where(inside, value, centre)), np.nan)
        std = theta[self.spread.parameter.name] if self.spread else 1.0
        changes = [std * theta[term.parameter.name] for term in self.changes]
        return self.first.to_physical(np.cumsum(np.stack([first, *changes], axis=-1), axis=-1))


@dataclass(frozen=True)
class StateChanges:
    """``field`` of the state, every component of it, changes at the ``knots`` (m,) by one of the ``changes`` (m).

    The knots are in the model's time, increasing and positive. ``relative``: a change is that of the logarithm.
    """

    field: Field
    relative: bool
    knots: tuple[float, ...]
    changes: tuple[PriorTerm, ...]

    @classmethod
    def of(cls, model: ForwardModel, field: Field, knots: Sequence[float], std: float, relative: bool) -> Self:
        """Changes N(0, std²), in the field's unit or of its logarithm. Raises :class:`ConfigError`."""
        what, unit = (f"ln {field.name}", "1") if relative else (field.name, field.unit)

        def change(k: int, knot: float) -> PriorTerm:
            label, source = f"model error: change of {what} at {clock(model, knot)}", "change of the state at a knot"
            name, symbol = f"{field.name}_change_{k}", f"Δ{k} {what}"
            return PriorTerm.normal(Parameter(name, unit, label=label, symbol=symbol, source=source), 0.0, std)

        return cls(field, relative, tuple(knots), tuple(change(k, knot) for k, knot in enumerate(knots, 1)))

    @property
    def name(self) -> str:
        return self.field.name

    @property
    def label(self) -> str:
        return f"{self.name} of the state"

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        return self.changes

    @property
    def own(self) -> Field:
        """Where the state of a run keeps the changes."""
        return Field(f"{self.name}_changes", len(self.knots))

    def values(self, theta: Mapping[str, Array]) -> Array:
        """Changes (N, m) from those of the control vector, (N,) by name."""
        return np.stack([theta[term.parameter.name] for term in self.changes], axis=-1)

    def applied(self, model: ForwardModel, x: Array, change: Array) -> tuple[Array, Mask]:
        """The states ``x`` (N, n_state) after a ``change`` (N,), and which members (N,) stay inside the bounds."""
        low, high = self.field.bounds
        if self.relative:
            changed = model.changed(self.name, x, change)
        else:
            changed = x.copy()
            changed[:, model.layout[self.name]] += change[:, None]
        if self.name not in model.layout.names:
            return changed, np.asarray(np.isfinite(changed).all(axis=1))
        values = changed[:, model.layout[self.name]]
        return changed, np.asarray(np.all((values > low) & (values < high), axis=1))


def clock(model: ForwardModel, knot: float) -> str:
    """An instant of the model in words."""
    return f"{convert(knot, model.time_unit, model.time_display_unit):.6g}{unit_after(model.time_display_unit)}"


def _change(model: ForwardModel, first: PriorTerm, k: int, knot: float) -> Parameter:
    p, scale = first.parameter, SCALE.get(first.transform, "score")
    if len(p.symbol) > 2 and p.symbol[0] == p.symbol[-1] == "$":
        function = rf"\mathrm{{{scale}}} " if scale else ""
        symbol = rf"$\Delta_{{{k}}}({function}{p.symbol[1:-1]})$"
    else:
        symbol = f"Δ{k} {scale} {p.symbol}".replace("  ", " ")
    return _of_walk(first, f"change_{k}", f"change of {scale} {p.label} at {clock(model, knot)}", symbol=symbol)


def _of_walk(first: PriorTerm, name: str, label: str, **more: Any) -> Parameter:
    """A quantity of the walk, in the unit of a change."""
    p = first.parameter
    unit, shown = (p.unit, p.display_unit) if first.transform == "normal" else ("1", "1")
    source, label = "random walk of a parameter that varies in time", label.replace("  ", " ")
    return Parameter(f"{p.name}_{name}", unit, label=label, display_unit=shown, source=source, **more)


ATTRIBUTES = (
    "observables", "time_unit", "time_display_unit", "batch", "compiled", "dense", "validity", "path_quantities",
    "doubts",
)  # fmt: skip

Outcomes = Sequence[Trajectory | Failure]
Part = tuple[Trajectory, Mask]
Varying = RandomWalk | StateChanges


def can_vary(model: ForwardModel, name: str) -> bool:
    """True if a parameter can change on the way: the state carries it, and it does not act at the start alone."""
    acts = not model.path_parameters or name in model.path_parameters
    return model.resumable and acts and any(f.name == name and f.size == 1 for f in model.layout)


@dataclass
class Walk:
    """Members on their way from piece to piece: initial states ``x`` (N, n_state), instants ``times`` (N, K).

    ``layout`` is that of ``x``, whose last fields are no part of the state that is integrated; ``parts`` are the paths
    of each member over the pieces, and which of their instants are asked for.
    """

    x: Array
    times: Array
    layout: StateLayout
    parts: Mapping[int, list[Part]] = field(default_factory=lambda: defaultdict(list))
    failures: dict[int, Failure] = field(default_factory=dict)

    @property
    def alive(self) -> Indices:
        """The members (N',) that have not failed."""
        return np.array([i for i in range(len(self.x)) if i not in self.failures], dtype=np.intp)

    def run(self, begin: float, end: float, integrate: Callable[[Indices, Array], Outcomes]) -> Array:
        """The states (N'', n_state) at ``end`` of the members that survive the piece from ``begin`` to there.
        ``integrate`` runs members (N',) to the instants (N', C + 1) that it is given; no further than to their last.
        """
        members, inside = self.alive, (self.times > begin) & (self.times <= end)
        met = np.flatnonzero(inside.any(axis=0))
        columns = slice(int(met[0]), int(met[-1]) + 1) if len(met) else slice(0, 0)
        asked = np.column_stack([self.times[:, columns], self.times[:, -1]])
        outcomes = integrate(members, np.minimum(asked, end)[members])
        asked_for = np.pad(inside[:, columns], ((0, 0), (0, 1)))  # but for the end
        for i, outcome in zip(members.tolist(), outcomes, strict=True):
            if isinstance(outcome, Failure):
                self.failures[i] = outcome
            else:
                self.parts[i].append((outcome, asked_for[i]))
        if isinstance(outcomes, Batch) and outcomes.whole:
            return outcomes.last
        return np.array([path.states[-1] for path in outcomes if isinstance(path, Trajectory)])

    def outcomes(self) -> Outcomes:
        return [
            self.failures.get(i) or JoinedTrajectory(times, x, self.layout, self.parts[i])
            for i, (times, x) in enumerate(zip(self.times, self.x, strict=True))
        ]


class JoinedTrajectory(Trajectory):
    """The whole path of a member that began at ``x`` (n_state,), with its ``parts`` as of :class:`Walk`."""

    _x: Array
    _parts: Sequence[Part]

    def __init__(self, times: Array, x: Array, layout: StateLayout, parts: Sequence[Part]):
        self.__dict__.update(times=times, layout=layout, _x=x, _parts=parts)  # the dataclass is frozen

    def __getitem__(self, name: str) -> Array:
        if name in self.layout.slices and name not in self._parts[0][0].layout.slices:
            return self._constant(self.layout.part(self._x, name))
        return self._joined(lambda path: path[name])

    def largest(self, name: str) -> float:
        return max(path.largest(name) for path, _ in self._parts)

    def beyond(self, limit: ValidityLimit) -> float:
        return min(path.beyond(limit) for path, _ in self._parts)

    @property
    def states(self) -> Array:
        inner = self._joined(lambda path: path.states)
        return np.hstack([inner, self._constant(self._x[inner.shape[1] :])])

    def _joined(self, read: Callable[[Trajectory], Array]) -> Array:
        """(K, …) of what is read along each of the pieces."""
        return np.concatenate([read(path)[asked] for path, asked in self._parts])

    def _constant(self, values: Array) -> Array:
        """(K, …) of what is no part of the state that is integrated."""
        return np.repeat(np.expand_dims(values, 0), len(self.times), axis=0)


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
    def unforeseen(self) -> Mapping[str, float]:  # type: ignore[override]
        return self.model.unforeseen

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """Those of the model, with the same parameters varying."""
        each = self.model.alternatives
        return tuple(replace(a, model=a.model and PiecewiseModel(a.model, self.varying)) for a in each)

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({name: np.array([value]) for name, value in theta.items()})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """Initial states of the model with the varying parameters appended. Raises ValueError where a piece lies
        outside of the parameter's bounds.
        """
        n_members = len(next(iter(theta.values())))
        inner = initial_states(self.model, {p.name: theta[p.name] for p in self.model.parameters}, n_members)
        return np.hstack([inner, *(change.values(theta) for change in self.varying)])

    def changed(self, name: str, x: Array, change: Array) -> Array:
        inner = self.model.layout.size
        return np.hstack([self.model.changed(name, x[:, :inner], change), x[:, inner:]])

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
                inner[:, self.model.layout[change.name]] = x[:, [self.layout[change.own.name].start + piece]]
            since = np.maximum(start, begin)

            def integrate(members: Indices, asked: Array, since: Array = since) -> Outcomes:
                return self.model.resumed(inner[members], since[members], asked)

            ends = walk.run(begin, end, integrate)
            inner[walk.alive] = ends.reshape(-1, inner.shape[1])
            self._change(walk, inner, end, start <= end)
        return walk.outcomes()

    def _change(self, walk: Walk, inner: Array, knot: float, concerned: Mask) -> None:
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
