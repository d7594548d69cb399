"""Which parameters have one value in several data sets: ``shared:`` of a prior, and the ``groups:`` of data sets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated

from pydantic import Field

from en4dvar.config.document import Document
from en4dvar.config.parameters import Entry, Uncertain
from en4dvar.config.schema import Name
from en4dvar.errors import ConfigError, Fault
from en4dvar.hints import shown, suggest

ALL = "all"
Patterns = str | tuple[str, ...]
Groups = dict[Name, Annotated[dict[Name, Patterns], Field(min_length=1)]]


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
        return {parameter: "" if kind == ALL else self._group(kind, name) for parameter, kind in self.kinds.items()}

    def _group(self, kind: str, name: str) -> str:
        found = [
            group
            for group, patterns in self.groups[kind].items()
            if any(fnmatchcase(name, one) for one in ([patterns] if isinstance(patterns, str) else patterns))
        ]
        if len(found) == 1:
            return found[0]
        where = f"in several of them: {', '.join(found)}" if found else "in none of them"
        raise ConfigError([self.document.fault(("groups", kind), f"data set {name!r} is {where}")])


def sharing_of(
    entries: Sequence[Entry],
    groups: Mapping[str, Mapping[str, Patterns]],
    correlated: bool,
    several_series: bool,
    document: Document,
) -> Sharing:
    """What a file asks to be shared. Raises :class:`ConfigError`: every entry that cannot be."""
    asked = {e.parameter.name: e for e in entries if isinstance(e, Uncertain) and e.spec.shared is not None}
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
        known = [ALL, *groups]
        yield document.fault(where, f"no kind of 'groups:' is called {shown(kind)}{suggest(kind, known)}")
    if entry.needs_data:
        yield document.fault(where, "its prior depends on the data set ('maximum'), but what is shared has one prior")
