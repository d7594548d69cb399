"""From the ``model:`` section to a forward model: registered (``en4dvar.models``), in a package or in a file.

Its labels and symbols are tried before any work: matplotlib reads them when everything else is done.
"""

import re
from collections.abc import Mapping
from inspect import getattr_static
from numbers import Real
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from en4dvar.config.context import check
from en4dvar.config.document import Document
from en4dvar.model.forward import Alternative, ForwardModel, Observable, PathQuantity, StateField, ValidityLimit
from en4dvar.model.state import OF_READINGS, Parameter, StateLayout
from en4dvar.plumbing import user_file
from en4dvar.plumbing.errors import ConfigError, En4dvarError, Fault, retold
from en4dvar.plumbing.files import PathError
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.tables import table
from en4dvar.plumbing.units import UnitError, convert
from en4dvar.plumbing.user_code import RefusedError, imported, loading

GREEK = (
    "alpha|beta|gamma|delta|epsilon|varepsilon|zeta|eta|theta|vartheta|iota|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|"
    "upsilon|phi|varphi|chi|psi|omega|Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Phi|Psi|Omega|infty|ell"
)
FUNCTIONS = "exp|ln|log|max|min"
_LETTER = rf"(?:[A-Za-z0-9]|\\(?:{GREEK})(?![A-Za-z]))"
_ROMAN = r"\\mathrm\{[A-Za-z0-9]+\}"
_GROUP = rf"\{{(?:[A-Za-z0-9](?:[, ]*[A-Za-z0-9])*|{_ROMAN}|\\(?:{FUNCTIONS}))\}}"
_BESIDE = rf"[_^](?:{_LETTER}|{_ROMAN}|{_GROUP})"
_ATOM = rf"(?:{_LETTER}(?:{_BESIDE})?|\\dot\{{[A-Za-z]\}}|\\(?:{FUNCTIONS})(?![A-Za-z])|[|/()+=,-])"
FORMULA = rf"\$(?:{_ATOM} ?)+\$"
_SIMPLE = re.compile(rf"[^$\\]*|{FORMULA}", re.ASCII)


def symbol_fault(text: str) -> str:
    """The reason why ``text`` cannot be written in a figure, "" where it can."""
    if not text.isprintable():
        return "it holds characters that are not printed"
    if _SIMPLE.fullmatch(text):  # matplotlib takes time to import
        return ""
    if len(re.findall(r"(?<!\\)\$", text)) % 2:
        return r"a $ is left over; write \$ for the sign itself"
    from matplotlib.mathtext import MathTextParser

    try:
        MathTextParser("path").parse(text)
    except (ValueError, RuntimeError) as error:  # Unknown symbol: \x, found '\'  (at char 0), (line:1, col:1)
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return re.sub(r"\s+\(at char.*", "", lines[-1]) if lines else "matplotlib cannot read it"
    return ""


GROUP = "en4dvar.models"
COMMAND = "command"  # the model that a section with this key means where it names none
HANDED = "python"  # instead of a name: a model that a script handed over, which no file can make again
OWN = "./my_model.py:MyModel, or package:MyModel"


class NoSettings(BaseModel):
    """The ``model:`` section of a class without ``Settings``: the name alone."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def find_model(name: str) -> type[ForwardModel]:
    """The model ``name``: registered, ``package:Class`` or ``/path/file.py:Class``. Raises :class:`ConfigError`."""
    model: Any
    what = f"model {shown(name)}"
    with retold(ValueError, ConfigError, f"{what} cannot be loaded: "), loading(f"{what} cannot be loaded"):
        if user_file.is_file_reference(name):
            model = user_file.load(name, what)
        elif ":" in name:
            module, _, attribute = name.partition(":")
            model = getattr(imported(what, module), attribute)
        else:
            registered = installed(GROUP)
            if name not in registered:
                raise ConfigError(f"unknown {what}{suggest(name, registered)}; or write {OWN}")
            model = registered[name].load()
    if not (isinstance(model, type) and issubclass(model, ForwardModel)):
        raise ConfigError(f"{shown(name)} is not a subclass of en4dvar.ForwardModel")
    _require_buildable(model, name)
    return model


def _require_buildable(kind: Any, name: str) -> None:
    """Raise :class:`ConfigError` where a class with settings cannot be made of them."""
    why, settings = f"{name!r} cannot come from YAML", getattr(kind, "Settings", NoSettings)
    if hasattr(kind, "Settings") != hasattr(kind, "from_settings"):
        lacking = "from_settings" if hasattr(kind, "Settings") else "Settings"
        raise ConfigError(f"{why}: Settings and from_settings go together, it lacks {lacking}")
    if not (isinstance(settings, type) and issubclass(settings, BaseModel)):
        raise ConfigError(f"{why}: its Settings are {shown(settings)}; make them a subclass of pydantic.BaseModel")
    made = getattr_static(kind, "from_settings", None)
    if made is not None and not isinstance(made, classmethod | staticmethod):
        raise ConfigError(f"{why}: write @classmethod above its from_settings(cls, settings)")


def settings_of(kind: type[ForwardModel]) -> type[BaseModel]:
    """The settings that the ``model:`` section of a class may hold besides its name."""
    settings: type[BaseModel] = getattr(kind, "Settings", NoSettings)
    return settings


def build_model(kind: type[ForwardModel], settings: BaseModel) -> ForwardModel:
    """The model of validated settings. Raises :class:`ConfigError` where the class does not fit together."""
    with loading(f"{kind.__name__} cannot be made"):
        if hasattr(kind, "from_settings"):
            return checked(kind.from_settings(settings), f"{kind.__name__}.from_settings")
        try:
            return checked(kind())
        except TypeError as error:
            hint = "; a class that takes arguments needs Settings and from_settings" if "required" in str(error) else ""
            raise ConfigError(f"{error}{hint}") from error


DECLARED: Mapping[str, type] = {  # attributes of a model that are tuples, and of what
    "parameters": Parameter,
    "observables": Observable,
    "optional_parameters": Parameter,
    "validity": ValidityLimit,
    "alternatives": Alternative,
    "path_quantities": PathQuantity,
    "path_parameters": str,
}


def _require_declared(model: ForwardModel) -> None:
    """Raise :class:`ConfigError` where an attribute is missing or of another type."""
    for name, item in DECLARED.items():
        value = getattr(model, name, None)
        if not (isinstance(value, tuple | list) and all(isinstance(each, item) for each in value)):
            raise _undeclared(model, name, f"a tuple of {item.__name__}")
    if not model.observables:
        raise _undeclared(model, "observables", "one Observable at least")
    if not isinstance(getattr(model, "layout", None), StateLayout):
        raise _undeclared(model, "layout", "StateLayout((Field(…), …))")
    for name in ("defaults", "known_by", "unforeseen"):
        if not isinstance(getattr(model, name), Mapping):
            raise _undeclared(model, name, "a dict")
    for name in model.path_parameters:
        if name not in model.layout.names:
            words = f"{type(model).__name__}: path_parameters: {shown(name)} is not in the layout"
            raise ConfigError(f"{words}{suggest(name, model.layout.names)}")
    for observable in model.observables:
        if not callable(observable.operator):
            words = f"the operator of {observable.name} is {shown(observable.operator)}, which cannot be called"
            raise ConfigError(f"{type(model).__name__}: {words}; give a StateField, or a function of a trajectory")


def _undeclared(model: ForwardModel, name: str, right: str) -> ConfigError:
    has = f"{name} is {shown(getattr(model, name))}" if hasattr(model, name) else f"it has no {name}"
    return ConfigError(f"{type(model).__name__}: {has}; give {right}")


def checked(model: Any, who: str = "") -> ForwardModel:
    """The model itself, which ``who`` made. Raises :class:`ConfigError` where it is none, or what it declares does not
    fit together.
    """
    if not isinstance(model, ForwardModel):
        raise ConfigError(f"{who} returned {shown(model)}; return the model, such as cls(…)")
    _require_declared(model)
    observables = model.observables
    for what, declared in (("parameters", model.parameters), ("observables", observables)):
        names = [thing.name for thing in declared]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"{type(model).__name__}: two {what} are called {twice[0]!r}; each needs its own name")
    things = (*model.parameters, *observables)
    for thing in things:
        for what, text in (("symbol", thing.symbol), ("label", thing.label)):
            if reason := symbol_fault(text):
                raise ConfigError(f"the {what} {shown(text)} of {thing.name} cannot be written in a figure: {reason}")
    units = [(thing.name, thing.unit, thing.display_unit) for thing in things]
    for what, unit, display_unit in (("its times", model.time_unit, model.time_display_unit), *units):
        with retold(UnitError, ConfigError, f"{type(model).__name__}: unit and display unit of {what}: "):
            convert(1.0, unit, display_unit)
    _require_defaults(model)
    for observable in observables:
        _require_read(model, observable)
    return model


def _require_read(model: ForwardModel, observable: Observable) -> None:
    """Raise :class:`ConfigError` where a field that the observable reads is not there, or has another unit."""
    operator, who = observable.operator, f"the observable {observable.name!r}"
    if not isinstance(operator, StateField):
        return
    for field in (operator.name, operator.rate_of):
        if field is not None and field not in model.layout.names:
            words = f"{who} reads {field!r}, which is not in the layout"
            raise ConfigError(f"{words}{suggest(field, model.layout.names)}")
    unit = next(field.unit for field in model.layout.fields if field.name == operator.name)
    with retold(UnitError, ConfigError, f"{who}: "):
        if type(operator) is StateField and unit != "1" and convert(1.0, observable.unit, unit) != 1.0:
            words = f"{who} reads {operator.name!r}, which is in {unit}, not {observable.unit}"
            raise ConfigError(f"{words}; give it that unit, and display_unit for tables and figures")


def _require_defaults(model: ForwardModel) -> None:
    own = {p.name: p for p in (*model.optional_parameters, *model.parameters)}
    known, who = {p.name: p for p in OF_READINGS} | own, f"{type(model).__name__}: defaults: "
    for name, value in model.defaults.items():
        if name not in known:
            raise ConfigError(f"{who}{shown(name)} is not one of its parameters{suggest(name, own)}")
        low, high = known[name].bounds
        if not (isinstance(value, Real) and low <= value <= high):
            words = f"give a number from {low:g} to {high:g} {known[name].unit}"
            raise ConfigError(f"{who}{name} is {shown(value)}; {words}")


Built = tuple[ForwardModel, dict[str, Any]]


def read_model(raw: Any, base: Path, document: Document, faults: list[Fault]) -> Built | None:
    """The model and its resolved section (defaults filled in), or None with the faults appended. Paths in a model's
    settings are relative to ``base``, given to pydantic as validation context ``{"base": base}``.
    """
    if not isinstance(raw, dict):
        return None  # told with the other keys of the file
    name = raw.get("name", COMMAND if COMMAND in raw else None)
    kind: Any = None
    with document.collecting(faults, "model", "name"), retold(PathError, ConfigError):
        if not isinstance(name, str):
            raise ConfigError("name the model, e.g. name: ./my_model.py:MyModel")
        if name == HANDED:
            raise ConfigError(f"{shown(raw.get('object'))} was handed over by a Python script; run that script again")
        if user_file.is_file_reference(name):
            name = user_file.absolute(name, base)
        kind = find_model(name)
    if kind is None:
        return None
    options = {key: value for key, value in raw.items() if key != "name"}
    try:
        with loading(f"the settings of {name} cannot be read"):
            settings: BaseModel | None = check(settings_of(kind), options, ("model",), document, faults, {"base": base})
        if settings is None:
            return None
        model = build_model(kind, settings)
    except RefusedError:
        raise
    except (En4dvarError, ValueError) as error:
        faults.append(document.fault(("model",), str(error)))
        return None
    return model, {"name": name, **settings.model_dump(mode="json", by_alias=True)}


def model_listing() -> str:
    """Every registered model, built with its default settings: observables and parameters with units. A model that
    cannot be loaded or whose settings have no defaults is listed with the reason.
    """
    return "\n\n".join(map(_listed, installed(GROUP)))


def _listed(name: str) -> str:
    try:
        return _description(name)
    except (En4dvarError, ValueError) as error:  # of one package; the others are listed
        return f"{name}: {error}"


def _description(name: str) -> str:
    kind: Any = find_model(name)
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
