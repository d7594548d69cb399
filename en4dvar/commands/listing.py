"""The models there are, for ``en4dvar models``."""

from typing import Any

from en4dvar.config.models import GROUP, build_model, find_model, settings_of
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.tables import table


def model_listing() -> str:
    """Every registered model, built with its default settings: observables and parameters with units.

    A model that cannot be loaded or whose settings have no defaults is listed with the reason.
    """
    return "\n\n".join(map(_description, installed(GROUP)))


def _description(name: str) -> str:
    try:
        kind: Any = find_model(name)
    except En4dvarError as error:
        return f"{name}: {error}"
    title = (kind.__doc__ or "").strip().split("\n", 1)[0]
    settings = settings_of(kind)
    needed = [field for field, info in settings.model_fields.items() if info.is_required()]
    options = ", ".join(settings.model_fields)
    if needed:
        return f"{name}: {title}\n  parameters depend on settings without default: {', '.join(needed)}"
    model = build_model(kind, settings())
    rows = [("  observable", "unit", "", "")]
    rows += [(f"  {o.name}", o.display_unit, "", o.label) for o in model.observables]
    rows += [("  parameter", "unit", "bounds", "")]
    rows += map(_row, model.parameters)
    if model.optional_parameters:
        rows += [("  may be named as parameters too", "", "", ""), *map(_row, model.optional_parameters)]
    return f"{name}: {title}\n{table(rows)}\n  settings: {options}"


def _row(p: Parameter) -> tuple[str, str, str, str]:
    return f"  {p.name}", p.display_unit, f"{p.bounds[0]:g} … {p.bounds[1]:g}", p.label
