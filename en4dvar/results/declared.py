"""Variables and attributes of a result file, each declared once: name, dimensions, unit, meaning, and its values. The
declarations say what is written, what is asked of a file that is read, and the reference page of the documentation.

A name may hold a placeholder, as in ``{parameter}_centre``. Such a variable exists once for each item of a scope (each
parameter, each series), whose names take the places of all placeholders in its name and its dimensions.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Parameter, Shown
from en4dvar.plumbing.caution import Caution, parsed
from en4dvar.results.netcdf import Group, Groups, Variable, netcdf_attributes

MEMBER = "chain draw"
_PLACEHOLDER = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class Item:
    """A parameter, a series or the like that has variables: ``held``, the object that their values are taken from;
    ``names`` in place of placeholders; ``label``, in prose; ``about``: ``units``, ``symbol`` and so on.
    """

    held: Any
    names: Mapping[str, str]
    label: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)


ONCE = Item(None, {})
Scopes = Mapping[str, Callable[[Any], Iterable[Item]]]
"""For each placeholder that can begin a name, the items that a subject has of it."""


@dataclass(frozen=True)
class UnitRule:
    """The unit of a variable and how it is shown: ``words`` for the reference page, ``attributes`` of a subject and an
    item, and ``keys`` of them that are in every file.
    """

    words: str
    attributes: Callable[[Any, Item], Mapping[str, Any]]
    keys: tuple[str, ...] = ("units",)


@dataclass(frozen=True)
class When:
    """The condition under which a variable is written, in words and as a test of a subject and an item."""

    words: str
    holds: Callable[[Any, Item], bool]


OWN = UnitRule("its own", lambda _, item: item.about, ("units", "display_units", "symbol"))
NUMBER = UnitRule("1", lambda _, item: {"units": "1"})
ALWAYS = When("", lambda _, item: True)


@dataclass(frozen=True)
class Declared:
    """A variable. ``meaning``: its ``long_name``, with ``{label}`` for that of the item. ``values``: of a subject and,
    where the name has a placeholder, of an item. ``needed``: no result is without it. ``fill`` and ``single`` as of
    :class:`~en4dvar.results.netcdf.Variable`.
    """

    name: str
    dims: str
    meaning: str
    values: Callable[..., Any]
    unit: UnitRule = NUMBER
    when: When = ALWAYS
    needed: bool = False
    fill: bool = True
    single: bool = False

    @cached_property
    def scope(self) -> str:
        """The placeholder that begins the name, or "" of a variable that exists once."""
        first = _PLACEHOLDER.search(self.name)
        return first.group(1) if first else ""

    def of(self, subject: Any, item: Item) -> Variable:
        values = self.values(subject) if item is ONCE else self.values(subject, item)
        about = {**self.unit.attributes(subject, item), "long_name": self.meaning.format(label=item.label)}
        dims = tuple(self.dims.format(**item.names).split())
        return Variable(dims, np.asarray(values), netcdf_attributes(about), self.fill, self.single)


@dataclass(frozen=True)
class Attribute:
    """An attribute of a group; where ``value`` gives None there is none, and of a mapping each item is one."""

    name: str
    meaning: str
    value: Callable[[Any], Any]
    needed: bool = False


Table = Sequence[Declared]


def lay_out(table: Table, subject: Any, scopes: Scopes) -> dict[str, Variable]:
    variables = {}
    for declared in table:
        for item in scopes[declared.scope](subject) if declared.scope else (ONCE,):
            if declared.when.holds(subject, item):
                variables[declared.name.format(**item.names)] = declared.of(subject, item)
    return variables


def group_of(
    variables: Mapping[str, Variable], coordinates: Mapping[str, Variable], about: Iterable[Attribute], subject: Any, /,
    **more: Any,
) -> Group:  # fmt: skip
    """A group of variables with the coordinates that belong to their dimensions, and attributes of the subject."""
    dims = dict.fromkeys(dim for variable in variables.values() for dim in variable.dims)
    own = {dim: coordinates[dim] for dim in dims if dim in coordinates}
    return Group(variables, own, netcdf_attributes(attributes_of(about, subject) | more))


def attributes_of(table: Iterable[Attribute], subject: Any) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for declared in table:
        value = declared.value(subject)
        if isinstance(value, Mapping):
            values |= value
        elif value is not None:
            values[declared.name] = value
    return values


def text(words: Iterable[str]) -> npt.NDArray[np.object_]:
    """Words as an array, also where there are none."""
    return np.array(list(words), dtype=object)


def shown_as(p: Shown) -> dict[str, Any]:
    """Unit and appearance of a parameter, an observable, a field or a quantity of the path."""
    return {"units": p.unit, "display_units": p.display_unit, "symbol": p.symbol}


def parameter_of(name: str, about: Mapping[str, Any]) -> Parameter:
    """The parameter of which a variable with the attributes ``about`` holds values."""
    label, symbol = str(about.get("label") or about["long_name"]), str(about["symbol"])
    return Parameter(name, str(about["units"]), label=label, symbol=symbol, display_unit=str(about["display_units"]))


class Names(dict[str, str]):
    """Parameter → how a page writes it; one that is not among them is written as in the configuration."""

    def __missing__(self, name: str) -> str:
        return name

    def of(self, parameters: Iterable[str], between: str = ", ") -> str:
        return between.join(self[name] for name in parameters)


NAMES = Names()


@dataclass(frozen=True)
class Stored:
    """What a file holds: a thin view of its ``groups``."""

    groups: Groups

    def group(self, name: str) -> Group:
        """A group of the file, e.g. ``"prior_predictive"``."""
        return self.groups[f"/{name}"]

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Of the root."""
        return self.groups["/"].attrs

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Why not to trust it, or read it with care: code, severity, words, advice; the worst first."""
        return parsed(self.attributes["warnings"])


def zero_of(time: Variable) -> float:
    """What the clock of the data shows at the model's time zero, in the unit of the times of readings."""
    return float(time.attrs.get("time_zero", 0.0))


@dataclass(frozen=True)
class Axis:
    """Of the series ``name``; ``alone``: it is the only one."""

    name: str
    alone: bool = True

    @property
    def time(self) -> str:
        """Dimension, and coordinate, of its readings."""
        return self.own("time")

    def own(self, what: str) -> str:
        """A variable that a file of a single observable has once."""
        return what if self.alone else f"{self.name}_{what}"


def axes_of(names: Sequence[str]) -> tuple[Axis, ...]:
    return tuple(Axis(name, len(names) == 1) for name in names)
