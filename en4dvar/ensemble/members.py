"""The members of a forecast as arrays: where they start, and what H reads from their paths.

Everything is one array operation as long as all members are well. Where one is not, members are taken one by one: those
in trouble get a reason, the others do not notice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from typing import Any

import numpy as np

from en4dvar.data.series import Part
from en4dvar.executor import Outcome
from en4dvar.model.forward import Batch, Failure, RateOperator, ValidityLimit, gives_rate, initial_states, read_along
from en4dvar.model.state import Array, Field, Indices, floats
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.user_code import ReturnedError, line_of, loss_of, own_fault
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem, Tie

Rows = Indices | slice
EVERYONE = slice(None)


def out_of_bounds(prior: Prior, physical: Array) -> list[str]:
    """Reasons (B,) of the members (B, n) with a parameter outside its bounds, "" for the others."""
    failures = [""] * len(physical)
    low, high = prior.bounds
    inside = (physical >= low) & (physical <= high) & np.isfinite(physical)
    if not inside.all():
        for i, j in np.argwhere(~inside):
            p = prior.parameters[j]
            failures[i] = failures[i] or f"{p.name} outside [{low[j]:g}, {high[j]:g}] {p.unit}"
    return failures


class InitialStates:
    """Where the members of a problem start."""

    def __init__(self, problem: InverseProblem):
        self.problem, self.size = problem, problem.model.layout.size
        columns = {name: j for j, name in enumerate(problem.prior.names)}
        own = [p.name for p in problem.model.parameters]
        self.estimated = tuple((name, columns[name]) for name in own if name in columns)
        self.tied = tuple((tie, columns[tie.to]) for tie in problem.tied)
        self.fixed = tuple((name, float(problem.fixed[name])) for name in own if name in problem.fixed)
        self.perturbed = tuple((p, columns.get(p.parameter.name)) for p in problem.perturbations)

    def __call__(self, physical: Array, cells: Array | None = None) -> tuple[Rows, Array, list[str]]:
        """Which members (B', of B) have an initial state, the states (B', n_state), and why the others have none (B,).

        ``physical`` (B, n) is the control vector, ``cells`` (B, m) what it says of whole fields. Members with a
        parameter outside its bounds have no state, and those that the model refuses.
        """
        failures = out_of_bounds(self.problem.prior, physical)
        alive, cells = _without(failures), np.empty((len(physical), 0)) if cells is None else cells
        if all(failures):
            return alive, np.empty((0, self.size)), failures
        try:
            return alive, self._build(physical[alive], cells[alive]), failures
        except BaseException as error:  # some member has no state: find out which, one by one
            own_fault(error)
            states = []
        for i in np.arange(len(failures))[alive]:
            try:
                states.append(self._build(physical[i : i + 1], cells[i : i + 1]))
            except BaseException as error:  # a model may refuse parameters in any way; the reason is kept
                failures[i] = loss_of(error)
        return _without(failures), np.concatenate([np.empty((0, self.size)), *states]), failures

    def _build(self, physical: Array, cells: Array) -> Array:
        """States (B, n_state); ValueError where one is not a state."""
        theta = {name: physical[:, j].copy() for name, j in self.estimated}
        theta |= {name: np.full(len(physical), value) for name, value in self.fixed}
        theta |= {tie.parameter.name: _followed(tie, physical[:, j]) for tie, j in self.tied}
        try:
            states = floats(initial_states(self.problem.model, theta, len(physical)), "initial_states")
        except KeyError as error:
            if (name := str(error.args[0])) in theta:
                raise
            words = f"initial_state asks for a parameter {name!r}{suggest(name, theta)}{line_of(error)}"
            raise ReturnedError(words) from None
        if states.shape != (len(physical), self.size):
            raise ValueError(f"misshapen initial state: {states.shape}, not {(len(physical), self.size)}")
        if self.perturbed or self.problem.fields:
            states = self._perturb(states.copy(), physical, cells)
        if not np.isfinite(states).all():
            raise ValueError("non-finite initial state")
        return states

    def _perturb(self, states: Array, physical: Array, cells: Array) -> Array:
        """States (B, n_state) with the perturbations of the control vector; ValueError outside a field's bounds."""
        layout = self.problem.model.layout
        fields = {f.name: f for f in layout}
        for prior, columns in self.problem.columns_of_fields:
            where = layout[prior.field.name]
            _require_base(states[:, where], prior.field.name, prior.relative)
            states[:, where] = prior.applied(states[:, where], cells[:, columns])
            _require_inside(states[:, where], prior.field)
        for perturbation, column in self.perturbed:
            fixed = self.problem.fixed
            value = fixed[perturbation.parameter.name] if column is None else physical[:, column, None]
            if perturbation.pattern:
                value = value * np.array(perturbation.pattern)
                value = np.exp(value) if perturbation.relative else value
            where = layout[perturbation.field]
            _require_base(states[:, where], perturbation.field, perturbation.relative)
            states[:, where] = states[:, where] * value if perturbation.relative else states[:, where] + value
        for name in {perturbation.field for perturbation, _ in self.perturbed}:
            _require_inside(states[:, layout[name]], fields[name])
        return states


def _require_base(states: Array, name: str, relative: bool) -> None:
    """Raise ValueError where a field is to vary by a factor and is zero."""
    if relative and not states.any():
        raise ValueError(
            f"{name} begins at 0, of which no share is a spread: give initial_state.{name}.std in its unit"
        )


def _require_inside(values: Array, block: Field) -> None:
    """ValueError where a perturbed field leaves its bounds."""
    low, high = block.bounds
    if not np.all((values > low) & (values < high)):
        raise ValueError(f"perturbed initial {block.name} outside ({low:g}, {high:g}) {block.unit}")


def _followed(tie: Tie, values: Array) -> Array:
    """Values (B,) of a tied parameter; ValueError outside its bounds."""
    p, (low, high), followed = tie.parameter, tie.parameter.bounds, tie.factor * values
    if not np.all((followed >= low) & (followed <= high)):
        raise ValueError(f"{p.name} outside [{low:g}, {high:g}] {p.unit}")
    return np.asarray(followed)


NOT_FINITE = "non-finite prediction"  # of a member that gives other readings, perhaps


def _without(failures: list[str]) -> Rows:
    return np.flatnonzero([not reason for reason in failures]) if any(failures) else EVERYONE


@dataclass(frozen=True)
class Reading:
    """Quantities read from a path: ``quantities`` (T,) each, H and, where it is needed, its rate; what becomes of
    ``limits`` of the model.

    ``batched``: the quantities take a :class:`~en4dvar.model.forward.Batch` as well and give (B, T).
    """

    quantities: tuple[Callable[[Any], Array], ...]
    limits: tuple[ValidityLimit, ...] = ()
    batched: bool = False

    def observe(self, outcomes: Sequence[Outcome], n_times: int) -> tuple[Array, Array, list[str]]:
        """Quantities (Q, B, T) of B outcomes, how far and since when they are beyond the limits (B, V, 2), both NaN
        where a member failed, and reasons (B,). Where some of a member's are NaN and none is infinite,
        it keeps the others.
        """
        if (isinstance(outcomes, Batch) and outcomes.whole) or not any(isinstance(o, Failure) for o in outcomes):
            try:
                read = self._all(outcomes)
                if read[0].shape[1:] == (len(outcomes), n_times) and np.isfinite(read[0]).all():
                    return *read, [""] * len(outcomes)
            except BaseException as error:  # of some member: find out which, one by one
                own_fault(error)
        values = np.full((len(self.quantities), len(outcomes), n_times), np.nan)
        beyond = np.full((len(outcomes), len(self.limits), 2), np.nan)
        reasons = [""] * len(outcomes)
        for i, outcome in enumerate(outcomes):
            if isinstance(outcome, Failure):
                reasons[i] = outcome.reason
                continue
            try:
                predictions = self._all([outcome])
            except BaseException as error:  # H belongs to the user as well
                reasons[i] = loss_of(error)
                continue
            if not np.isfinite(predictions[0]).all():
                reasons[i] = NOT_FINITE
            if not np.isinf(predictions[0]).any():
                values[:, i], beyond[i] = predictions[0][:, 0], predictions[1][0]
        return values, beyond, reasons

    def _all(self, outcomes: Sequence[Any]) -> tuple[Array, Array]:
        def each(read: Callable[[Any], Any]) -> Any:
            return read(outcomes) if isinstance(outcomes, Batch) and self.batched else [read(path) for path in outcomes]

        values = [each(read) for read in self.quantities]
        beyond = [(each(methodcaller("largest", of.name)), each(methodcaller("beyond", of))) for of in self.limits]
        shape = (len(self.limits), 2, len(outcomes))
        return np.array(values, dtype=np.float64), np.array(beyond, dtype=np.float64).reshape(shape).transpose(2, 0, 1)


@dataclass(frozen=True)
class Readout:
    """(…, K + P M) of a path: the K readings of all parts, then the curves of the P parts that have one.

    ``operators`` are those of the ``parts``, or their rates; ``rows`` (K,) says at which instant each reading was
    taken, ``along`` (M,) those that a curve is read at.
    """

    operators: tuple[Callable[[Any], Array], ...]
    parts: tuple[Part, ...]
    rows: Rows
    along: Rows

    def __call__(self, path: Any) -> Array:
        predictions = []
        curves = []
        for operator, part in zip(self.operators, self.parts, strict=True):
            values = operator(path)
            rows = self.rows if isinstance(self.rows, slice) else self.rows[part.where]
            if part.places is None:
                predictions.append(values[..., rows])
            else:
                predictions.append(part.places.read(values, rows))
            if part.has_path:
                at = values[..., self.along] if part.places is None else values[..., self.along, :]
                curves.append(part.read_along(at))
        return np.concatenate([*predictions, *curves], axis=-1)


def operators_of(parts: Sequence[Part], needs_rates: str = "") -> tuple[Callable[[Any], Array], ...]:
    """The operators of the parts or, where something ``needs_rates``, by its name, their rates.

    Raises :class:`ConfigError` where the model does not provide a rate.
    """
    operators = list[Callable[[Any], Array]]()
    for part in parts:
        operator, name = part.observable.operator, part.observable.name
        if needs_rates and not gives_rate(operator):
            raise ConfigError(f"{needs_rates} needs the rate of {name}, which the model does not provide")
        read, what = operator, name
        if needs_rates and isinstance(operator, RateOperator):
            read, what = operator.rate, f"the rate of {name}"
        operators.append(partial(read_along, read, what, part.places is not None))
    return tuple(operators)


def batched(problem: InverseProblem) -> bool:
    """True if all operators take a :class:`~en4dvar.model.forward.Batch`."""
    return all(getattr(part.observable.operator, "batched", False) for part in problem.parts)
