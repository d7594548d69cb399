"""What parameters have to do with each other, in the prior and from data set to data set.

``prior_correlation:``, which of them are correlated, and ``prior:``, an ensemble of them; ``shared:`` of a prior with
the ``groups:``, which have one value in several data sets; the ``population:`` section.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self, cast

import numpy as np
from pydantic import Field

from en4dvar.config.context import Context, Faults, Made
from en4dvar.config.document import Document
from en4dvar.config.parameters import Entry, Uncertain
from en4dvar.config.schema import Name, Section
from en4dvar.estimation.population import HyperPrior
from en4dvar.inputs.members import read_members, read_square
from en4dvar.model.state import Array, Parameter, TransformName
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, retold
from en4dvar.plumbing.hints import matches, shown, suggest
from en4dvar.plumbing.units import UnitError, parse_quantity
from en4dvar.priors.dependence import Dependence, KernelName, correlation_of_places
from en4dvar.priors.prior import PriorTerm

KINDS = ("correlation", "matrix", "file", "kernel")
Patterns = str | tuple[str, ...]
Grouped = Mapping[str, Mapping[str, Patterns]]  # kind → group → patterns of names

A_FILE = Made(lambda text, context: context.path(text), Annotated[str, Field(min_length=1)])
Position = float | tuple[float, ...]


class PriorCorrelation(Section):
    """Parameters that are correlated: of two the number, of more a matrix, a file of it, or a function of distance."""

    between: Annotated[tuple[str, ...], Field(min_length=2)]
    """Names of the parameters, each with a prior of its own."""
    correlation: Annotated[float, Field(gt=-1, lt=1)] | None = None
    """Of two parameters: of their values where normal, of their logarithms where lognormal, else of the scores."""
    matrix: tuple[tuple[float, ...], ...] | None = None
    """Rows of the correlation matrix, in the order of the names."""
    file: Annotated[Path | None, A_FILE] = None
    """CSV file of the correlation matrix, without header, relative to the configuration's folder."""
    kernel: KernelName | None = None
    """Correlation as a function of distance, for parameters with places: needs ``at`` and ``length``."""
    at: tuple[Position, ...] | None = None
    """Place of each parameter: a number, or a list of coordinates."""
    length: Annotated[float, Field(gt=0)] | None = None
    """Correlation length of the kernel, in the unit of the places."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        if sum(key in keys for key in KINDS) != 1:
            faults.add((), f"give one of {', '.join(KINDS)}")
        for key in ("at", "length"):
            if (key in keys) != ("kernel" in keys):
                faults.add((key,) if key in keys else (), "at and length belong to a kernel, and a kernel needs both")

    def of_all(self, read: Callable[[Path], Array]) -> Array:
        """The matrix (m, m). Raises :class:`ConfigError`, :class:`DataError`."""
        if self.correlation is not None:
            if len(self.between) != 2:
                raise ConfigError(f"one correlation is that of two parameters, not of {len(self.between)}; give matrix")
            return np.array([[1.0, self.correlation], [self.correlation, 1.0]])
        if self.file is not None:
            return read(self.file)
        if self.kernel is not None:
            places = [np.atleast_1d(np.asarray(place, dtype=float)) for place in self.at or ()]
            if len(places) != len(self.between) or len({len(place) for place in places}) != 1:
                count = len(self.between)
                raise ConfigError(f"at: give {count} places, one a parameter, all with the same number of coordinates")
            return correlation_of_places(self.kernel or "", np.stack(places), self.length or 1.0)
        rows = self.matrix or ()
        if len({len(row) for row in rows}) != 1:
            raise ConfigError("the rows of the matrix have different lengths")
        return np.array(rows)


class PriorFile(Section):
    """Priors from an ensemble in a file: of the parameters that say ``{prior: ensemble}``."""

    ensemble: Annotated[Path, A_FILE]
    """posterior.nc of an earlier run, other netCDF with a variable a parameter, or a CSV file with a column each."""


def joined(blocks: Sequence[Dependence]) -> tuple[Dependence, ...]:
    """Those that share names as one. Raises :class:`ConfigError` as :func:`_one_block`."""
    from scipy.sparse.csgraph import connected_components  # not needed to import the package

    share = [[not {*block.names}.isdisjoint(other.names) for other in blocks] for block in blocks]
    count, which = connected_components(np.array(share), directed=False)
    return tuple(_one_block([blocks[i] for i in np.flatnonzero(which == k).tolist()]) for k in range(count))


def _one_block(parts: Sequence[Dependence]) -> Dependence:
    """Zero where nothing is said. Raises :class:`ConfigError`: a pair of which two say something, or no correlation
    matrix.
    """
    if len(parts) == 1:
        return parts[0]
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    matrix, said = np.eye(len(names)), np.eye(len(names), dtype=bool)
    for part in parts:
        columns = [names.index(name) for name in part.names]
        where = np.ix_(columns, columns)
        again = said[where] & ~np.eye(len(columns), dtype=bool)
        if again.any():
            i, j = np.argwhere(again)[0]
            raise ConfigError(f"the correlation of {part.names[i]} and {part.names[j]} is given twice")
        matrix[where], said[where] = part.matrix, True
    return Dependence(names, matrix)


def resolved(
    entries: Sequence[Entry],
    ensemble: PriorFile | None,
    correlations: Sequence[PriorCorrelation],
    others: Sequence[str],
    apart: Mapping[str, str],
    document: Document,
) -> tuple[tuple[Entry, ...], tuple[Dependence, ...]]:
    """The entries with the priors that an ensemble makes, and what the priors have to do with each other.

    ``others``: names that are estimated besides the entries; ``apart``: why a parameter is correlated with no other.
    Raises :class:`ConfigError`: every fault, located in the file.
    """
    faults: list[Fault] = []
    asking = [e for e in entries if isinstance(e, Uncertain) and e.spec.prior == "ensemble"]
    dependence: tuple[Dependence, ...] = ()
    made: dict[str, Entry] = {}
    if asking or ensemble is not None:
        with document.collecting(faults):
            dependence, made = _of_ensemble(asking, ensemble, apart)
    estimated = [e.parameter.name for e in entries if isinstance(e, Uncertain)] + list(others)
    alone = {**apart, **{e.parameter.name: "its correlations are those of the ensemble" for e in asking}}
    parts = []
    for k, section in enumerate(correlations):
        with document.collecting(faults, "prior_correlation", k):
            for name in section.between:
                if name in alone:
                    raise ConfigError(f"{name} cannot be correlated: {alone[name]}")
                if name not in estimated:
                    raise ConfigError(f"{name!r} is not a parameter with a prior{suggest(name, estimated)}")
            parts.append(Dependence(section.between, section.of_all(read_square)))
    if not faults:
        with document.collecting(faults, "prior_correlation"):
            dependence += joined(parts) if parts else ()
            return tuple(made.get(e.parameter.name, e) for e in entries), dependence
    raise ConfigError(faults)


def _of_ensemble(
    asking: Sequence[Uncertain], ensemble: PriorFile | None, apart: Mapping[str, str]
) -> tuple[tuple[Dependence, ...], dict[str, Entry]]:
    """The Gaussian of the members' mean and covariance in transformed space. Raises :class:`ConfigError` with paths."""
    if ensemble is None:
        first = asking[0].parameter.name
        raise ConfigError("no ensemble is given; write 'prior: {ensemble: FILE}'", f"parameters.{first}")
    if not asking:
        raise ConfigError("no parameter takes its prior from it; write e.g. 'G: {prior: ensemble}'", "prior")
    for entry in asking:
        if reason := apart.get(entry.parameter.name):
            raise ConfigError(f"cannot be part of an ensemble: {reason}", f"parameters.{entry.parameter.name}")
    units = {e.parameter.name: (e.parameter.unit, e.spec.unit or "") for e in asking}
    with retold(DataError, ConfigError, "", "prior.ensemble"):
        members = read_members(ensemble.ensemble, units)
    count, n = len(next(iter(members.values()))), len(asking)
    if count < n + 2:
        words = f"{count} members are too few for {n} parameters; at least {n + 2}"
        raise ConfigError(f"{ensemble.ensemble}: {words}", "prior.ensemble")
    made: dict[str, Entry] = {}
    columns = []
    for entry in asking:
        name = entry.parameter.name
        try:
            term, scores = term_of_members(entry.parameter, members[name], entry.spec.map)
        except ConfigError as error:
            raise ConfigError(str(error).removeprefix(f"prior of {name}: "), f"parameters.{name}") from None
        made[name] = replace(entry, of_members=term)
        columns.append(scores)
    y = np.stack(columns, axis=1)
    matrix = np.atleast_2d(np.corrcoef(y.T))
    np.fill_diagonal(matrix, 1.0)
    with retold(ConfigError, ConfigError, f"{ensemble.ensemble}: ", "prior.ensemble"):
        return (Dependence(tuple(made), matrix, y),), made


def term_of_members(parameter: Parameter, values: Array, kind: str | None) -> tuple[PriorTerm, Array]:
    """The Gaussian of members (N,) in the coordinate ``kind``, and the members standardised (N,). Raises
    :class:`ConfigError`: members outside of the parameter's bounds or of the range of its map, or all alike.
    """
    low, high = parameter.bounds
    kind = kind or parameter.transform
    outside = (values < low) | (values > high)
    if outside.any():
        where = f"outside of [{low:g}, {high:g}] {parameter.unit}, e.g. {values[outside][0]:g}"
        raise ConfigError(f"{int(outside.sum())} of {len(values)} members lie {where}")
    bounds = parameter.bounds if kind == "logit" else (-math.inf, math.inf)
    shape = PriorTerm(parameter, cast(TransformName, kind), 0.0, 1.0, bounds)
    try:
        x = shape.from_physical(values)
    except ValueError as error:
        raise ConfigError(f"{error}, as map: {kind} has it") from None
    term = replace(shape, mean=float(x.mean()), std=float(x.std(ddof=1)))
    return term, np.asarray((x - term.mean) / term.std)


GroupName = Annotated[str, Field(pattern=r"^[^\s\x00-\x1f\x7f][^\x00-\x1f\x7f]*$", max_length=100)]


class PopulationSection(Section, HyperPrior):
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

    def check(self, entries: Sequence[Entry], groups: Grouped, document: Document) -> None:
        """Raises :class:`ConfigError`: a parameter that is not estimated, or of which each data set has a prior; an
        unknown kind of group."""
        faults: list[Fault] = []
        estimated = {e.parameter.name: e for e in entries if isinstance(e, Uncertain)}
        for i, name in enumerate(self.of):
            with document.collecting(faults, "population", "of", i):
                if name not in estimated:
                    raise ConfigError(f"{name}: not estimated, it has no prior{suggest(name, estimated)}")
                if estimated[name].needs_data:
                    raise ConfigError(f"{name}: its prior depends on the data set, a population has one")
        of_kind = groups.get(self.by or "", {})
        for group in self.known:
            with document.collecting(faults, "population", "known", *([group] if self.by else [])):
                if self.by is None:
                    raise ConfigError("of groups, which need 'by'")
                if self.by in groups and group not in of_kind:
                    raise ConfigError(f"no such group{suggest(group, of_kind)}")
        if self.by is not None and self.by not in groups:
            words = f"no kind of 'groups:' is called {shown(self.by)}{suggest(self.by, groups)}"
            faults.append(document.fault(("population", "by"), words))
        stated = [("reference", (), self.reference), *(("known", (g,), values) for g, values in self.known.items())]
        for key, above, values in stated:
            for name, text in values.items():
                with document.collecting(faults, "population", key, *above, name):
                    self._check_value(name, text, estimated, key)
        if faults:
            raise ConfigError(faults)

    def _check_value(self, name: str, text: str, estimated: Mapping[str, Entry], key: str) -> None:
        """Raises :class:`ConfigError`, :class:`UnitError`: what ``reference`` or ``known`` says of a parameter."""
        if name not in self.of and (key, name) != ("reference", SOURCE):
            neither = "neither 'source' nor" if key == "reference" else "not"
            raise ConfigError(f"{shown(name)}: {neither} among 'of'{suggest(name, self.of)}")
        if name not in estimated:
            return
        value, std = reference_value(text, estimated[name].parameter.unit)
        low, high = estimated[name].parameter.bounds
        if key == "known" and not std > 0:
            raise ConfigError(f"{shown(text)}: how well is it known? as '7.7 ± 0.2 kPa'")
        if key == "known" and not low < value < high:
            raise ConfigError(f"{shown(text)}: beyond the bounds of {name}")


SOURCE = "source"  # of a reference: where it is from
_REFERENCE = re.compile(r"\s*([-+.\deE]+)\s*(?:(?:±|\+/?-)\s*([.\d][.\deE+-]*))?\s*(.*)")


def reference_value(text: str, unit: str) -> tuple[float, float]:
    """Value and std (NaN: not stated) in ``unit`` of a text such as ``7.7 ± 1.1 kPa``. Raises :class:`UnitError`."""
    match = _REFERENCE.fullmatch(text)
    if match is None:
        raise UnitError(f"{shown(text)} is no value such as '7.7 ± 1.1 kPa'")
    value = parse_quantity(f"{match[1]} {match[3]}".strip(), unit)
    return value, parse_quantity(f"{match[2]} {match[3]}".strip(), unit) if match[2] else math.nan


ALL, NONE = "all", "none"
Groups = dict[Name, Annotated[dict[GroupName, Patterns], Field(min_length=1)]]


@dataclass(frozen=True)
class Sharing:
    """``kinds``: shared parameter → kind of group, or ``all``; ``groups``: kind → group → patterns of names."""

    kinds: Mapping[str, str]
    groups: Grouped
    document: Document

    @classmethod
    def of(
        cls, entries: Sequence[Entry], groups: Grouped, correlated: bool, several_series: bool, document: Document
    ) -> Self:
        """The parameters that a file asks to be shared. Raises :class:`ConfigError`: every entry that cannot be."""
        asked = {e.parameter.name: e for e in entries if isinstance(e, Uncertain) and e.spec.shared not in (None, NONE)}
        kinds = {name: str(entry.spec.shared) for name, entry in asked.items()}
        wrong: list[tuple[str, str, str]] = []
        for name, kind in kinds.items():
            if kind not in (known := [ALL, NONE, *groups]):
                wrong.append((name, "shared", f"no kind of 'groups:' is called {shown(kind)}{suggest(kind, known)}"))
            if asked[name].needs_data:
                words = "its prior depends on the data set, but what is shared has one prior"
                wrong.append((name, "shared", words))
        if kinds:
            first = next(iter(kinds))
            varying = [e.parameter.name for e in entries if isinstance(e, Uncertain) and e.spec.varies is not None]
            wrong += [(name, "varies", "not where parameters are shared by data sets") for name in varying]
            wrong += [(first, "shared", "not with correlated priors")] * correlated
            words = "not where a data set has several series: a joint estimate takes one series of each"
            wrong += [(first, "shared", words)] * several_series
        if wrong:
            raise ConfigError([document.fault(("parameters", name, key), words) for name, key, words in wrong])
        return cls(kinds, groups, document)

    def of_dataset(self, name: str) -> dict[str, str]:
        """Shared parameter → group of a data set, "" for all. Raises :class:`ConfigError`: it is in none or several."""
        return {parameter: "" if kind == ALL else self.group_of(kind, name) for parameter, kind in self.kinds.items()}

    def group_of(self, kind: str, name: str) -> str:
        """Group of a data set. Raises :class:`ConfigError`: it is in none or several."""
        groups = [
            group
            for group, patterns in self.groups[kind].items()
            if any(matches(name, pattern) for pattern in ([patterns] if isinstance(patterns, str) else patterns))
        ]
        if len(groups) == 1:
            return groups[0]
        where = f"in several of them: {', '.join(groups)}" if groups else "in none of them"
        raise ConfigError([self.document.fault(("groups", kind), f"data set {name!r} is {where}")])
