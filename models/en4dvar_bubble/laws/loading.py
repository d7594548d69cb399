"""Finding a law: built in, an entry point, a class of an installed package, or a class in a file of
the user's own, and whether that class can serve as one."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from en4dvar.model.state import DISCREPANCY, OF_READINGS, Parameter
from en4dvar.plumbing import user_file
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.units import parse_unit
from en4dvar.plumbing.user_code import imported, line_of, loading, reason_of
from en4dvar_bubble.laws.base import REGISTRY, ConstitutiveLaw
from en4dvar_bubble.laws.memory import MemoryVariable
from en4dvar_bubble.laws.parameters import columns
from en4dvar_bubble.numbers import NAMES

RESERVED = {"R", "Rdot", "p_b", "S", "T", "C", "T_m", "Z", "R0", "R_eq", "R_max"}
RESERVED |= NAMES | {p.name for p in (*OF_READINGS, *DISCREPANCY)}
"""Names of the state vector, and of parameters of the bubble, its readings and their discrepancy."""
_MEMBERS = 3


def check_law(kind: Any, name: str) -> ConstitutiveLaw:
    """An instance of the class ``kind``. Raises :class:`ConfigError` saying what is wrong with it."""
    if not (isinstance(kind, type) and issubclass(kind, ConstitutiveLaw)):
        raise ConfigError(f"{name}: not a subclass of en4dvar_bubble.ConstitutiveLaw")
    law: ConstitutiveLaw = _run(kind, f"{name}: cannot be created without arguments")
    _check_declared(kind, law, name)
    _probe(law, name)
    return law


def _check_declared(kind: type[ConstitutiveLaw], law: ConstitutiveLaw, name: str) -> None:
    own = [m for m in ("stress", "strain_energy_rate") if getattr(kind, m) is not getattr(ConstitutiveLaw, m)]
    if len(own) == 2:
        raise ConfigError(f"{name}: defines both stress and strain_energy_rate; keep one (the other follows from it)")
    if not own:
        raise ConfigError(
            f"{name}: defines neither stress(stretch, p) nor strain_energy_rate(stretch, p); "
            "a law without a spring is a subclass of en4dvar_bubble.Liquid"
        )
    if law.shear_dependent and law.strain_dependent:
        raise ConfigError(
            f"{name}: defines both viscosity and strained_viscosity; no viscosity depends on shear rate and stretch"
        )
    if not (isinstance(kind.parameters, tuple) and all(isinstance(p, Parameter) for p in kind.parameters)):
        raise ConfigError(f"{name}: parameters must be a tuple of en4dvar.Parameter")
    if not kind.parameters:
        raise ConfigError(f"{name}: parameters is empty")
    require_parameters(kind, name)


def require_parameters(kind: type[ConstitutiveLaw], name: str) -> None:
    """Raise :class:`ConfigError` where a parameter of a law is not the only one of its name, or not in SI."""
    for p in kind.parameters:
        if parse_unit(p.unit).factor != 1:
            raise ConfigError(
                f"{name}: the parameter {p.name} is declared in {p.unit}, but laws compute in SI units; declare the SI "
                f"unit, such as 'Pa' or 'Pa s', and display_unit={p.unit!r} to see {p.unit} in tables and figures"
            )
    names = [p.name for p in kind.parameters]
    for n in names:
        if names.count(n) > 1:
            raise ConfigError(f"{name}: two parameters are called {n!r}")
        if n in RESERVED:
            words = f"the parameter name {n!r} is taken by the bubble model or its readings"
            raise ConfigError(f"{name}: {words}; choose another, e.g. {n + '_law'!r}")


def _probe(law: ConstitutiveLaw, name: str) -> None:
    """Call every method once with three members."""
    stretch, rate = np.array([0.9, 1.1, 2.0, 3.0]), np.array([1.0, 1e3, 1e6, 1e9])
    p = columns(law.example_values(_MEMBERS))
    elastic = "stress" if law.closed_form else "strain_energy_rate"
    _call(getattr(law, elastic), (stretch, p), f"{name}: {elastic}(stretch, p)")
    if law.shear_dependent:
        _call(law.viscosity, (rate, p), f"{name}: viscosity(shear_rate, p)", least=0.0)
    if law.strain_dependent:
        _call(law.strained_viscosity, (stretch, p), f"{name}: strained_viscosity(stretch, p)", least=0.0)
    variables = _run(lambda: law.memory(p), f"{name}: memory(p)")
    if not (isinstance(variables, tuple) and all(isinstance(v, MemoryVariable) for v in variables)):
        raise ConfigError(f"{name}: memory(p) must return a tuple of MemoryVariable")
    for i, variable in enumerate(variables):
        for what, method in (("stiffness", variable.stiffness_at), ("equilibrium", variable.equilibrium_at)):
            _call(method, (stretch,), f"{name}: {what} of memory variable {i + 1}")
        times = np.asarray(variable.relaxation_time, dtype=float)
        if times.shape not in ((), (_MEMBERS, 1)):
            raise ConfigError(f"{name}: relaxation_time of memory variable {i + 1}: shape {times.shape}, not (N, 1)")
        if not np.all(times > 0):
            raise ConfigError(f"{name}: relaxation_time of memory variable {i + 1} must be positive")
        if (k := np.asarray(variable.convection)).ndim or k.dtype.kind not in "fiu":
            raise ConfigError(
                f"{name}: convection of memory variable {i + 1}: {k.dtype} of shape {k.shape}, not a number"
            )


def _call(method: Callable[..., Any], arguments: tuple[Any, ...], where: str, least: float = -np.inf) -> None:
    result = np.asarray(_run(lambda: method(*arguments), where))
    x = arguments[0]
    try:
        fits = np.broadcast_shapes(result.shape, (_MEMBERS, len(x))) == (_MEMBERS, len(x))
    except ValueError:
        fits = False
    if not fits or result.dtype.kind not in "fiu":
        raise ConfigError(
            f"{where}: returned {result.dtype} of shape {result.shape}; for a row ({len(x)},) and parameters of shape "
            f"({_MEMBERS}, 1) it must be real and broadcast to ({_MEMBERS}, {len(x)})"
        )
    if np.any(result < least):
        raise ConfigError(f"{where}: returned {np.nanmin(result):.4g} at the example values; it cannot be negative")


def _run(call: Callable[[], Any], where: str) -> Any:
    try:
        with np.errstate(all="ignore"):
            return call()
    except BaseException as error:
        hint = ""
        if isinstance(error, AttributeError) and isinstance(error.obj, SimpleNamespace):
            hint = f"; p has no {error.name!r}{suggest(error.name, vars(error.obj))}"
        elif isinstance(error, ValueError) and "truth value" in str(error):
            hint = "; the arguments are arrays: write np.where instead of if, np.minimum instead of min"
        raise ConfigError(f"{where}: {reason_of(error)}{hint}{line_of(error)}") from error


GROUP = "en4dvar_bubble.laws"


def get_law(name: str, base: Path | None = None) -> ConstitutiveLaw:
    """The law called ``name``.

    A built-in name; the name of an entry point of group ``en4dvar_bubble.laws``; ``package.module:Class``; or
    ``file.py:Class`` with the path relative to ``base`` (default: the working directory).

    Raises :class:`ConfigError`: no such law, file or class (with a suggestion), the file cannot be executed, the class
    is not a usable law.
    """
    if name in REGISTRY:
        return REGISTRY[name]()
    where, colon, attribute = name.rpartition(":")
    if user_file.is_file_reference(name):
        law = user_file.load(user_file.absolute(name, base), f"law {name!r}")
    elif colon:
        with loading(f"law '{name}' cannot be imported"):
            law = user_file.class_of(imported(f"law '{name}'", where), attribute, where)
    else:
        law = _from_entry_point(name)
    return check_law(law, name)


def qualified(name: str, base: Path | None = None) -> str:
    """``name`` with the path of a ``file.py:Class`` made absolute, so that it means the same from any folder."""
    return user_file.absolute(name, base) if user_file.is_from_file(type(get_law(name, base))) else name


def available() -> dict[str, type[ConstitutiveLaw] | ConfigError]:
    """Every registered law by name, built in or by entry point; an entry point that fails, as its error."""
    laws: dict[str, type[ConstitutiveLaw] | ConfigError] = {}
    for name in installed(GROUP):
        try:
            laws[name] = type(get_law(name))
        except ConfigError as error:
            laws[name] = error
    return dict(sorted((laws | REGISTRY).items()))


def _from_entry_point(name: str) -> Any:
    registered = installed(GROUP)
    if name not in registered:
        known = {law: REGISTRY[law].title if law in REGISTRY else "" for law in sorted({*REGISTRY, *registered})}
        own = "; a class of your own is my_law.py:ClassName" if name.endswith(".py") else ""
        raise ConfigError(f"unknown law {name!r}{own or suggest(name, known)}")
    with loading(f"law {name!r}: entry point {registered[name].value!r} cannot be loaded"):
        return registered[name].load()
