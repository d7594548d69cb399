"""Parameters of several data sets: ``shared:`` of a prior with the ``groups:``, and the ``population:`` section."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from en4dvar.config.document import Document
from en4dvar.config.parameters import Entry, Uncertain
from en4dvar.config.schema import Name, Section, section_of
from en4dvar.estimation.population import HyperPrior
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.units import UnitError, parse_quantity

if TYPE_CHECKING:

    class _HyperPrior(HyperPrior, Section): ...

else:
    _HyperPrior = section_of(HyperPrior)


GroupName = Annotated[str, Field(pattern=r"^[^\s\x00-\x1f\x7f][^\x00-\x1f\x7f]*$", max_length=100)]


class PopulationSection(_HyperPrior):
    """Mean and spread of parameters over the data sets of the run, estimated at its end."""

    of: Annotated[tuple[str, ...], Field(min_length=1)]
    """Parameters that vary from data set to data set about a common median, e.g. [k, c]."""
    by: Name | None = None
    """A kind of group under ``groups``: each group has a population of its own, and they are compared."""
    reference: Annotated[dict[Name, str], Field(default_factory=dict)]
    """Values of others to compare with, e.g. {k: 7.7 ± 1.1 N/m, source: data sheet}; they change no number."""
    known: Annotated[dict[GroupName, dict[Name, str]], Field(default_factory=dict)]
    """Medians that a group is known to have, e.g. {standard: {k: 7.7 ± 0.2 N/m}}: they calibrate what all groups
    have in common, such as scale and density."""

    @property
    def hyper(self) -> HyperPrior:
        """The prior of mean and spread."""
        return HyperPrior(**{field.name: getattr(self, field.name) for field in fields(HyperPrior)})


def check_population(
    section: PopulationSection, entries: Sequence[Entry], groups: Mapping[str, Mapping[str, object]], document: Document
) -> None:
    """Raises :class:`ConfigError`: every parameter that is not estimated, or whose prior depends on the data set; an
    unknown kind of group.
    """
    faults: list[Fault] = []
    estimated = {e.parameter.name: e for e in entries if isinstance(e, Uncertain)}
    for i, name in enumerate(section.of):
        with document.collecting(faults, "population", "of", i):
            if name not in estimated:
                raise ConfigError(f"{name}: not estimated, it has no prior{suggest(name, estimated)}")
            if estimated[name].needs_data:
                raise ConfigError(f"{name}: its prior depends on the data set ('maximum'), a population has one")
    of_kind = groups.get(section.by or "", {})
    for group in section.known:
        with document.collecting(faults, "population", "known", *([group] if section.by else [])):
            if section.by is None:
                raise ConfigError("of groups, which need 'by'")
            if section.by in groups and group not in of_kind:
                raise ConfigError(f"no such group{suggest(group, of_kind)}")
    if section.by is not None and section.by not in groups:
        words = f"no kind of 'groups:' is called {shown(section.by)}{suggest(section.by, groups)}"
        faults.append(document.fault(("population", "by"), words))
    stated = [("reference", (), section.reference), *(("known", (g,), values) for g, values in section.known.items())]
    for key, above, values in stated:
        for name, text in values.items():
            with document.collecting(faults, "population", key, *above, name):
                _check_value(name, text, section, estimated, key)
    if faults:
        raise ConfigError(faults)


def _check_value(name: str, text: str, section: PopulationSection, estimated: Mapping[str, Entry], key: str) -> None:
    """Raises :class:`ConfigError`, :class:`UnitError`: what is said of a parameter as ``reference`` or as ``known``."""
    if name not in section.of and (key, name) != ("reference", SOURCE):
        neither = "neither 'source' nor" if key == "reference" else "not"
        raise ConfigError(f"{shown(name)}: {neither} among 'of'{suggest(name, section.of)}")
    if name not in estimated:
        return
    value, std = reference_value(text, estimated[name].parameter.unit)
    low, high = estimated[name].parameter.bounds
    if key == "known" and not std > 0:
        raise ConfigError(f"{shown(text)}: how well is it known? as '7.7 ± 0.2 kPa'")
    if key == "known" and not low < value < high:
        raise ConfigError(f"{shown(text)}: beyond the bounds of {name}")


SOURCE = "source"  # of a reference: where it is from
_REFERENCE = re.compile(r"\s*([-+.\deE]+)\s*(?:(?:±|\+/?-)\s*([.\deE+-]+))?\s*(.*)")


def reference_value(text: str, unit: str) -> tuple[float, float]:
    """Value and std in ``unit`` of a text such as ``7.7 ± 1.1 kPa``; NaN where no std is stated.

    Raises :class:`UnitError`.
    """
    match = _REFERENCE.fullmatch(text)
    if match is None:
        raise UnitError(f"{shown(text)} is no value such as '7.7 ± 1.1 kPa'")
    value = parse_quantity(f"{match[1]} {match[3]}".strip(), unit)
    return value, parse_quantity(f"{match[2]} {match[3]}".strip(), unit) if match[2] else math.nan


ALL, NONE = "all", "none"
Patterns = str | tuple[str, ...]
Groups = dict[Name, Annotated[dict[GroupName, Patterns], Field(min_length=1)]]


@dataclass(frozen=True)
class Sharing:
    """``kinds``: shared parameter → kind of group, or ``all``; ``groups``: kind → group → patterns of names."""

    kinds: Mapping[str, str]
    groups: Mapping[str, Mapping[str, Patterns]]
    document: Document

    def __bool__(self) -> bool:
        return bool(self.kinds)

    def of_dataset(self, name: str) -> dict[str, str]:
        """Shared parameter → group of a data set, "" for all. Raises :class:`ConfigError`: it is in none or several."""
        return {parameter: "" if kind == ALL else self.group_of(kind, name) for parameter, kind in self.kinds.items()}

    def group_of(self, kind: str, name: str) -> str:
        """Group of a data set. Raises :class:`ConfigError`: it is in none or several."""
        groups = [
            group
            for group, patterns in self.groups[kind].items()
            if any(fnmatchcase(name, pattern) for pattern in ([patterns] if isinstance(patterns, str) else patterns))
        ]
        if len(groups) == 1:
            return groups[0]
        where = f"in several of them: {', '.join(groups)}" if groups else "in none of them"
        raise ConfigError([self.document.fault(("groups", kind), f"data set {name!r} is {where}")])


def sharing_of(
    entries: Sequence[Entry],
    groups: Mapping[str, Mapping[str, Patterns]],
    correlated: bool,
    several_series: bool,
    document: Document,
) -> Sharing:
    """The parameters that a file asks to be shared. Raises :class:`ConfigError`: every entry that cannot be."""
    asked = {e.parameter.name: e for e in entries if isinstance(e, Uncertain) and e.spec.shared not in (None, NONE)}
    kinds = {name: str(entry.spec.shared) for name, entry in asked.items()}
    faults = [fault for name, entry in asked.items() for fault in _faults(name, entry, groups, document)]
    if kinds:
        faults += [
            document.fault(("parameters", e.parameter.name, "varies"), "not where parameters are shared by data sets")
            for e in entries
            if isinstance(e, Uncertain) and e.spec.varies is not None
        ]
    if kinds and correlated:
        faults.append(document.fault(("parameters", next(iter(kinds)), "shared"), "not with correlated priors"))
    if kinds and several_series:
        words = "not where a data set has several series: a joint estimate takes one series of each"
        faults.append(document.fault(("parameters", next(iter(kinds)), "shared"), words))
    if faults:
        raise ConfigError(faults)
    return Sharing(kinds, groups, document)


def _faults(name: str, entry: Uncertain, groups: Mapping[str, object], document: Document) -> Iterator[Fault]:
    where, kind = ("parameters", name, "shared"), str(entry.spec.shared)
    if kind != ALL and kind not in groups:
        known = [ALL, NONE, *groups]
        yield document.fault(where, f"no kind of 'groups:' is called {shown(kind)}{suggest(kind, known)}")
    if entry.needs_data:
        yield document.fault(where, "its prior depends on the data set ('maximum'), but what is shared has one prior")
