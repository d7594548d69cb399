"""What varies at knots: a parameter that is constant between them, or the state itself. A random walk of a parameter is

    x_0 ~ N(mean, std²),     x_k = x_{k−1} + c_k,     c_k ~ N(0, q²)

in the transformed space of the parameter, whose prior is that of x_0. The changes c_k are parameters of the control
vector like any other, independent of each other and of x_0, so that J, its minimisation, the ensemble and the evidence
are what they are without; the values of the pieces are their sums. Where q is estimated it is a parameter as well, with
a half-normal prior, and the c_k / q ~ N(0, 1) take the place of the c_k, so that all are still independent.

The weak constraint: the state itself changes at knots by what the model does not know, its model error. A field of it
is multiplied by exp(c), or c is added to it, c ~ N(0, q²); these changes are parameters of the control vector too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array, Field, Parameter
from en4dvar.plumbing.units import convert
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
        """With changes N(0, std²) in the transformed space of ``first``. Raises :class:`ConfigError`.

        ``estimated``: ``std`` is that of the half-normal prior of their standard deviation.
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
        """Priors of the quantities that join the control vector."""
        return (*([self.spread] if self.spread else []), *self.changes)

    @property
    def parameter(self) -> Parameter:
        """The parameter that varies."""
        return self.first.parameter

    @property
    def name(self) -> str:
        """Name of the parameter."""
        return self.parameter.name

    @property
    def label(self) -> str:
        """The varying quantity in words."""
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
        """Physical values (…, m + 1) of the pieces, from those of the parameter and of its changes, (…,) by name.

        NaN where the parameter is outside of the range of its transform.
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
        """Name of the field that varies."""
        return self.field.name

    @property
    def label(self) -> str:
        """The varying quantity in words."""
        return f"{self.name} of the state"

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        """Priors of the quantities that join the control vector."""
        return self.changes

    @property
    def own(self) -> Field:
        """Where the state of a run keeps the changes."""
        return Field(f"{self.name}_changes", len(self.knots))

    def values(self, theta: Mapping[str, Array]) -> Array:
        """Changes (N, m) from those of the control vector, (N,) by name."""
        return np.stack([theta[term.parameter.name] for term in self.changes], axis=-1)

    def applied(self, model: ForwardModel, x: Array, change: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
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
    unit = "" if model.time_display_unit == "1" else f" {model.time_display_unit}"
    return f"{convert(knot, model.time_unit, model.time_display_unit):.6g}{unit}"


def _change(model: ForwardModel, first: PriorTerm, k: int, knot: float) -> Parameter:
    """The change at the k-th knot, counted from one."""
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
