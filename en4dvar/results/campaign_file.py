"""``posterior.nc`` of a campaign: the results of its data sets side by side along the dimension ``dataset``.

It is written by streaming, a block of data sets at a time. Dimensions follow the results of the data sets, in the
ArviZ schema, with ``dataset`` in front; ``time`` becomes ``observation`` (padded with NaN to the longest data set) and
the observation times a variable, as of several series ``y_time`` and ``y_observation``; so is ``G_piece``, where the
pieces of a parameter begin that varies at knots of each data set. Scalars that judge a fit become variables of
``sample_stats``. The paths between the observations, the iterations, the descents and the modes stay in
``datasets.pack``.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from en4dvar.plumbing.errors import OutputError
from en4dvar.results import netcdf
from en4dvar.results.checkpoint import digest
from en4dvar.results.pack import Alike, Content, Pack, PackedLayout, opened, unpacked, unpacked_together

GROUPS = (
    "prior", "posterior", "prior_predictive", "posterior_predictive", "observed_data", "observation_errors",
    "constant_data", "sample_stats", "log_likelihood",
)  # fmt: skip
_PATHS = frozenset(f"/{name}" for name in GROUPS)
LEFT_OUT = {"path_time", "iteration", "mode", "descent"}
OWN = (  # dimensions whose coordinates are those of each data set, and what they are called instead
    (re.compile(r"(^|_)time(?=$|_column$)"), r"\1observation"),
    (re.compile("_piece$"), "_piece_number"),
)
PARAMETER = "parameter"
FAILURES = "failed_datasets"  # root attribute: JSON of name → reason
MADE_OF = "datasets_sha256"  # root attribute: digest of the results in the file
BLOCK = 1 << 22  # bytes of results that are written at once


class DamagedError(OutputError):
    """Results that cannot be read any more; ``names`` are those of their data sets."""

    def __init__(self, names: Sequence[str], reason: str):
        super().__init__(reason)
        self.names = names


@dataclass
class _Layout:
    """What the file must have room for: the results as a whole, of which one is in memory at a time."""

    widest: netcdf.Groups = field(default_factory=dict)  # of the (first) data set with most parameters, or that has it
    n_parameters: int = -1
    sizes: dict[str, dict[str, int]] = field(default_factory=lambda: {group: {} for group in GROUPS})
    scalars: dict[str, dict[str, Any]] = field(default_factory=lambda: {group: {} for group in GROUPS})
    seen: set[tuple[PackedLayout, tuple[str, ...]]] = field(default_factory=set)

    def add(self, content: bytes) -> None:
        """One that varies in time has the more parameters the longer the window, one that was sampled more scalars."""
        result = opened(content)
        kind = result.layout, tuple(key for attributes in result.attributes for key in attributes)
        if kind in self.seen:  # as most are: there is nothing new in it
            return
        self.seen.add(kind)
        sizes, n_parameters = result.layout.sizes, result.layout.sizes["/sample_stats"][PARAMETER]
        groups, wider = unpacked(content, _PATHS), n_parameters > self.n_parameters
        first, other = (groups, self.widest) if wider else (self.widest, groups)
        self.widest = {path: _with(group, other.get(path, netcdf.Group())) for path, group in first.items()}
        self.n_parameters = max(n_parameters, self.n_parameters)
        said = dict(zip(sizes, result.attributes, strict=True))
        for name, kinds in self.scalars.items():
            for dim, size in sizes[f"/{name}"].items():
                self.sizes[name][dim] = max(size, self.sizes[name].get(dim, 0))
            for key, value in said[f"/{name}"].items():
                kinds.setdefault(key, str if isinstance(value, str) else np.dtype(float))


def _with(group: netcdf.Group, other: netcdf.Group) -> netcdf.Group:
    """A group and what it lacks of another one."""
    return netcdf.Group({**other.variables, **group.variables}, {**other.coords, **group.coords}, group.attrs)


def save_campaign(
    path: Path, pack: Pack, sources: Mapping[str, str], attributes: Mapping[str, Any], failures: Mapping[str, str]
) -> Path:
    """Write the campaign's file; one that is there already, of the same results, is left as it is. ``sources``: name of
    the data set → its name in the ``pack``, in order, not empty; ``failures``: name of one without a posterior → why.

    Raises :class:`DamagedError`: results cannot be read. :class:`OutputError`: the file cannot be written.
    """
    digests = [pack.entries[stem].content_digest for stem in sources.values()]
    made_of = digest(json.dumps([digests, [*sources], failures]).encode())
    if _said(path, damaged=True).get(MADE_OF) == made_of:
        return path
    layout = _layout(pack, sources)
    told = {FAILURES: json.dumps(failures, ensure_ascii=False), MADE_OF: made_of}
    with netcdf.netcdf_file(path) as partial, netCDF4.Dataset(partial, "w", format="NETCDF4") as target:
        target.setncatts({**attributes, **told})
        _define(target, layout, len(sources))
        for begin, names, contents in _blocks(pack, sources):
            alike = unpacked_together(contents, _PATHS)
            for group in GROUPS:
                _write(target[group], begin, names, alike)
    return path


def _layout(pack: Pack, sources: Mapping[str, str]) -> _Layout:
    layout, damaged = _Layout(), dict[str, str]()
    for name, stem in sources.items():
        try:
            layout.add(pack.content(stem))
        except (OutputError, KeyError, ValueError) as error:  # the last two: written by somebody else
            damaged[name] = str(error)
    if damaged:
        raise DamagedError([*damaged], "\n".join(damaged.values()))
    return layout


def _blocks(pack: Pack, sources: Mapping[str, str]) -> Iterator[tuple[int, list[str], list[Content]]]:
    """Place of the first, names and contents of as many data sets as are written at once."""
    sizes = itertools.accumulate(pack.entries[stem].content_size for stem in sources.values())
    placed = zip(itertools.count(), sources.items(), sizes, strict=False)
    for _, block in itertools.groupby(placed, key=lambda place: place[2] // BLOCK):
        held = list(block)
        contents = [opened(pack.content(stem, check=False)) for _, (_, stem), _ in held]  # it was for the layout
        yield held[0][0], [name for _, (name, _), _ in held], contents


def failed_datasets(path: Path) -> dict[str, str]:
    """Name of the data set without a posterior → reason, from a campaign's file; empty where there is no such file."""
    return {str(k): str(v) for k, v in json.loads(_said(path).get(FAILURES) or "{}").items()}


def datasets_in(path: Path) -> list[str]:
    """The data sets in a campaign's file, in order; none where there is no such file, or it cannot be read."""
    return list(_said(path, damaged=True).get("dataset", ()))


def _said(path: Path, damaged: bool = False) -> dict[str, Any]:
    """Attributes of the root, and the names of the data sets; nothing where there is no file or, if it may be
    ``damaged``, where it cannot be read. Raises :class:`OutputError`.
    """
    try:
        return dict(netcdf.read_sealed(said_in, path)) if path.is_file() else {}
    except OutputError:
        if not damaged:
            raise
        return {}


def said_in(path: Path) -> Iterator[tuple[str, Any]]:
    """As they are read."""
    with netcdf.opened_netcdf(path) as file:
        yield from ((name, str(getattr(file, name))) for name in file.ncattrs())
        yield "dataset", list(map(str, file["posterior"]["dataset"][...].tolist()))


def _define(target: netCDF4.Dataset, layout: _Layout, n_datasets: int) -> None:
    """Groups, dimensions, variables and coordinates, as of the widest data set, and the scalars of all."""
    for name in GROUPS:
        source, group = layout.widest[f"/{name}"], target.createGroup(name)
        group.createDimension("dataset", n_datasets)
        kept = {key: v for key, v in source.every.items() if not LEFT_OUT & {*v.dims, key}}
        for dim in sorted({dim for variable in kept.values() for dim in variable.dims}):
            group.createDimension(dimension(dim), layout.sizes[name][dim])
        about = {"units": "1", "long_name": "data set"}
        netcdf.define_variable(group, "dataset", np.dtype(object), ("dataset",), about, missing=False)
        for key, variable in kept.items():
            own = key not in variable.dims or dimension(key) != key  # of each data set
            dims = tuple(map(dimension, variable.dims))
            kind, dims = variable.values.dtype, ("dataset", *dims) if own else dims
            made = netcdf.define_variable(group, key, kind, dims, netcdf.attributes_of(variable), missing=own)
            if not own:
                made[...] = variable.values
        for key, kind in layout.scalars[name].items():
            variable_name = f"{key}_total" if key in group.variables else key  # a parameter's share keeps its name
            about = {"units": "1", "long_name": key.replace("_", " "), "attribute": key}
            netcdf.define_variable(group, variable_name, np.dtype(kind), ("dataset",), about, missing=True)


def dimension(dim: str) -> str:
    """What a dimension of a data set's result is called here.

    >>> dimension("time"), dimension("y_time"), dimension("mu_piece"), dimension("draw")
    ('observation', 'y_observation', 'mu_piece_number', 'draw')
    """
    for ending, other in OWN:
        dim = ending.sub(other, dim)
    return dim


def _write(group: netCDF4.Group, begin: int, names: Sequence[str], block: Sequence[Alike]) -> None:
    """The values of consecutive data sets; what one lacks stays missing."""
    variables = [alike.groups[group.path].every for alike in block]
    names_here = group[PARAMETER][...].tolist() if PARAMETER in group.variables else []
    places = [_places(names_here, source) for source in variables]
    for variable in group.variables.values():
        if variable.dimensions[:1] != ("dataset",):
            continue
        kind, shape = object if variable.dtype is str else variable.dtype, variable.shape[1:]
        rows = np.full((len(names), *shape), _missing(variable), dtype=kind)
        if variable.name == "dataset":
            rows[:] = names
        elif "attribute" in variable.ncattrs():
            key = variable.getncattr("attribute")
            for alike in block:
                for i, attributes in zip(alike.places, alike.attributes, strict=True):
                    if key in attributes[group.path]:
                        rows[i] = attributes[group.path][key]
        else:
            for alike, own, place in zip(block, variables, places, strict=True):
                if variable.name in own:
                    _place(rows, alike.places, own[variable.name], place)
        if kind is not object or (rows != "").any():  # text that is not written is empty
            variable[begin : begin + len(names)] = rows


def _place(rows: np.ndarray[Any, Any], which: list[int], variable: netcdf.Variable, places: list[int] | None) -> None:
    """Put the values of data sets that are alike into their rows of a variable, each parameter in its place."""
    if rows.shape[1:] == variable.values.shape[1:] and (places is None or PARAMETER not in variable.dims):
        rows[which] = variable.values
    elif variable.values.size:  # no parameter, no value
        sizes = zip(variable.dims, variable.values.shape[1:], strict=True)
        where = (places if places and dim == PARAMETER else slice(n) for dim, n in sizes)
        own = rows[which]
        own[(slice(None), *where)] = variable.values
        rows[which] = own


def _missing(variable: netCDF4.Variable[Any]) -> Any:
    if variable.dtype is str:
        return ""
    return getattr(variable, "_FillValue", netCDF4.default_fillvals[np.dtype(variable.dtype).str[1:]])


def _places(names: list[str], source: Mapping[str, netcdf.Variable]) -> list[int] | None:
    """Where the parameters of a data set stand among those of the campaign, None where they are the same."""
    own = source[PARAMETER].values[0].tolist() if PARAMETER in source else names
    return None if own == names else [names.index(name) for name in own]
