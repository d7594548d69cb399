"""``start:`` of ``assimilation:`` where it is given: the values of parameters at which the iterations start."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from en4dvar.config.document import Document
from en4dvar.config.parameters import Entry, Uncertain
from en4dvar.config.schema import GivenStart
from en4dvar.inputs.members import read_members
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.units import UnitError, parse_quantity


def values_of(start: GivenStart, entries: Sequence[Entry], document: Document) -> dict[str, float]:
    """The value of each parameter that the start names, or of all where it is a file, in the parameters' units.

    Raises :class:`ConfigError`: a parameter that is not estimated, a unit that does not fit, a file that is no result.
    """
    units = {e.parameter.name: e.parameter.unit for e in entries if isinstance(e, Uncertain)}
    where = ("assimilation", "start", "from")
    if isinstance(start.place, Path):
        try:
            members = read_members(start.place, {name: (unit, "") for name, unit in units.items()})
        except DataError as error:
            raise ConfigError([document.fault(where, str(error))]) from None
        return {name: float(np.median(values)) for name, values in members.items()}
    values, faults = {}, []
    for name, text in start.place.items():
        try:
            if name not in units:
                raise UnitError(f"not estimated, it has no prior{suggest(name, units)}")
            values[name] = parse_quantity(text, units[name])
        except UnitError as error:
            faults.append(document.fault((*where, name), str(error)))
    if faults:
        raise ConfigError(faults)
    return values
