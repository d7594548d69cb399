"""The groups of a result file: an :class:`~en4dvar.diagnosis.analysis.Analysis` laid out in the ArviZ schema."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.results.declared import attributes_of, group_of, lay_out
from en4dvar.results.netcdf import Group
from en4dvar.results.scalars import ATTRIBUTES
from en4dvar.results.scopes import SCOPES
from en4dvar.results.variables import COORDINATES, GROUPS, OPTIONAL


def build_groups(a: Analysis, attributes: Mapping[str, Any]) -> dict[str, Group]:
    """All groups of an analysis by path; ``attributes`` are added to the root's and win over the defaults."""
    coordinates = lay_out(COORDINATES, a, SCOPES)
    groups = {"/": group_of({}, {}, {**attributes_of(ATTRIBUTES["/"], a), **attributes})}
    for path, table in GROUPS.items():
        variables = lay_out(table, a, SCOPES)
        if variables or path not in OPTIONAL:
            groups[path] = group_of(variables, coordinates, attributes_of(ATTRIBUTES.get(path, ()), a))
    return groups
