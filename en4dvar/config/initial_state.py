"""The ``initial_state:`` section: fields of the model's state that join the control vector as perturbations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, Fault
from en4dvar.forward import ForwardModel
from en4dvar.hints import suggest
from en4dvar.prior import PriorTerm
from en4dvar.problem import StatePerturbation
from en4dvar.state import Field, Parameter
from en4dvar.units import UnitError, parse_quantity

Perturbed = tuple[PriorTerm, StatePerturbation]


def read_initial_state(
    raw: Mapping[str, Any], model: ForwardModel, document: Document, faults: list[Fault]
) -> tuple[Perturbed, ...]:
    """Prior and perturbation of each field named, in the order of the file; faults are appended."""
    taken = {p.name for p in model.parameters}
    fields = {f.name: f for f in model.layout if f.name not in taken}
    found: list[Perturbed] = []
    for name, given in raw.items():
        path = ("initial_state", name)
        if name in taken:
            faults.append(document.fault(path, f"{name} is a parameter: give it a prior in parameters", at_key=True))
        elif name not in fields:
            message = f"unknown field {name!r} of the state{suggest(name, fields)}"
            faults.append(document.fault(path, message, at_key=True))
        elif spread := check(schema.InitialSpread, given, path, document, faults):
            try:
                found.append(perturbation(fields[name], spread.std))
            except (UnitError, ConfigError) as error:
                faults.append(document.fault((*path, "std"), str(error)))
    return tuple(found)


def perturbation(field: Field, std: str | float) -> Perturbed:
    """N(0, std²) added to the field, or, for a std in %, a factor whose logarithm is N(0, std²).

    Raises
    ------
    UnitError: a unit that is not the field's. ConfigError: a std that is not positive.
    """
    name, text = f"initial_{field.name}", str(std).strip()
    relative = text.endswith("%") and field.unit != "%"
    value = parse_quantity(text if relative else std, "1" if relative else field.unit)
    if not value > 0:
        raise ConfigError(f"must be positive, not {std}")
    if relative:
        label = f"initial {field.name} relative to the model's"
        parameter = Parameter(name, "1", "lognormal", (0.0, float("inf")), label)
        return PriorTerm.lognormal(parameter, 1.0, value), StatePerturbation(parameter, field.name, relative=True)
    parameter = Parameter(name, field.unit, label=f"initial {field.name} beyond the model's")
    return PriorTerm.normal(parameter, 0.0, value), StatePerturbation(parameter, field.name)
