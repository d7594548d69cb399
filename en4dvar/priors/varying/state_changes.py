"""The weak constraint: the state itself changes at knots by what the model does not know, its model error.

At a knot a field of the state is multiplied by exp(c), or c is added to it, c ~ N(0, q²). As those of a parameter that
varies, the changes are parameters of the control vector.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array, Field, Parameter
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying.random_walk import clock


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
    def of(
        cls, model: ForwardModel, field: Field, knots: Sequence[float], std: float, relative: bool
    ) -> "StateChanges":
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
