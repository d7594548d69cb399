"""Groups of variables ⇄ NETCDF4 files, several times faster than through xarray, whose import takes as long as an
estimate; :func:`tree_of` and :func:`dataset_of` show them through it.

All definitions come before all data: HDF5 then lays out its metadata once. The encoding is xarray's own (NaN as fill
value of floats, truth values as bytes with ``dtype: bool``, text as variable-length strings). A file is made in memory:
a worker far away can do it, and a file system is touched once.

The last line of a file is its seal: format, version and SHA-256 of everything before it. HDF5 has no checksum of its
own: of files with one flipped bit most are read without a word, and some send its library into an endless loop. So the
line, which every reader of netCDF ignores, is checked before the library gets to see the file.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import netCDF4
import numpy as np

from en4dvar.plumbing.decoding import Allowed, DecodeError, decoded, require_whole
from en4dvar.plumbing.errors import DataError, OutputError, retold
from en4dvar.plumbing.files import atomic_path, open_plain

if TYPE_CHECKING:
    import xarray as xr

_LOCK = threading.Lock()  # the netCDF library is not safe to use from several threads
_MORE = 1 << 18  # bytes; more than the library had left to write
_INITIAL_SIZE = 1 << 19  # bytes beside those of large variables; grows as needed
_LARGE = 1 << 24  # bytes of a variable


class MissingError(OutputError, KeyError):
    """A file with a good seal, which anybody can make, lacks what a result has."""

    __str__ = Exception.__str__


class Said(dict[str, Any]):
    """Attributes of a file that is read. Raises :class:`MissingError` for one that is not there."""

    def __missing__(self, key: str) -> Any:
        raise MissingError(f"not a result of en4dvar: no attribute {key!r}")


@contextmanager
def understood(path: Path) -> Iterator[None]:
    """Within, what a file with a good seal holds is read; whatever is wrong with it is an :class:`OutputError`."""
    try:
        yield
    except MissingError as error:
        raise OutputError(f"{path}: {error}") from error
    except OutputError:
        raise
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OutputError(f"{path}: not a result of en4dvar: {reason[:300]}") from error


@dataclass(frozen=True)
class Variable:
    """Values along named dimensions: floats, integers, truth values or text. ``fill``: NaN means a missing value.
    ``single``: floats are stored in single precision; fields are large, so they are converted as they are written.
    """

    dims: tuple[str, ...]
    values: np.ndarray[Any, Any]
    attrs: Mapping[str, Any]
    fill: bool = True
    single: bool = False

    @property
    def stored(self) -> np.ndarray[Any, Any]:
        """The values as a file holds them."""
        return self.values.astype(np.float32) if self.single else self.values


@dataclass(frozen=True)
class Group:
    """Variables, and coordinates of its dimensions, by name."""

    variables: Mapping[str, Variable] = field(default_factory=dict)
    coords: Mapping[str, Variable] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name in self.variables or name in self.coords

    def __getitem__(self, name: str) -> Variable:
        """A variable or a coordinate. Raises :class:`MissingError`."""
        if name not in self:
            raise MissingError(f"not a result of en4dvar: no variable {name!r}")
        return self.variables[name] if name in self.variables else self.coords[name]

    @property
    def every(self) -> dict[str, Variable]:
        return {**self.variables, **self.coords}

    @property
    def sizes(self) -> dict[str, int]:
        return {dim: size for v in self.every.values() for dim, size in zip(v.dims, v.values.shape, strict=True)}

    def check(self) -> None:
        """Raise :class:`ValueError` where variables disagree on a dimension's length, or one is a coordinate too."""
        if both := self.variables.keys() & self.coords.keys():
            raise ValueError(f"{', '.join(sorted(both))}: both a variable and a coordinate")
        sizes = self.sizes
        for name, v in self.every.items():
            if v.values.shape != tuple(sizes[dim] for dim in v.dims):
                raise ValueError(f"{name} has the shape {v.values.shape}, its dimensions have other sizes")


def netcdf_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Attributes as netCDF can hold them: truth values become 0/1, absent ones "", other objects their text."""

    def plain(value: Any) -> Any:
        if isinstance(value, bool | np.bool_):
            return int(value)
        if value is None:
            return ""
        return value if isinstance(value, str | int | float | np.number | np.ndarray) else str(value)

    return {str(key): plain(value) for key, value in attributes.items()}


def variable(dims: str | tuple[str, ...], values: Any, units: str, long_name: str, **attrs: Any) -> Variable:
    """A variable with what CF asks of it."""
    attributes = netcdf_attributes({"units": units, "long_name": long_name, **attrs})
    return Variable((dims,) if isinstance(dims, str) else dims, np.asarray(values), attributes)


Groups = Mapping[str, Group]
"""By path, the root ``/`` first."""


def to_bytes(groups: Groups) -> SealedBytes:
    """The file of the groups; its last line seals it."""
    sizes = [v.values.nbytes // (1 + v.single) for group in groups.values() for v in group.variables.values()]
    memory = _INITIAL_SIZE + sum(size for size in sizes if size > _LARGE)  # growing takes it twice
    with _LOCK:
        file = netCDF4.Dataset("in-memory.nc", "w", format="NETCDF4", memory=memory)
        try:
            data = [item for path, group in groups.items() for item in _define(file, path, group)]
            for variable, values in data:
                _write(variable, values)
        finally:
            content = file.close()
    return SealedBytes.of(content)


def _write(variable: Any, values: np.ndarray[Any, Any]) -> None:
    """A block of rows at a time: what the library has to convert is never there twice."""
    if values.nbytes <= _LARGE:
        variable[...] = values if values.ndim else values[()]
        return
    rows = max(1, _LARGE * len(values) // values.nbytes)
    for first in range(0, len(values), rows):
        variable[first : first + rows] = values[first : first + rows]


def read_groups(path: Path) -> dict[str, Group]:
    """The groups of a sealed file by path, in memory. Raises :class:`OutputError`: not ours, cut short or altered."""
    return dict(read_sealed(groups_in, path))


def read_sealed(reader: Callable[..., Iterator[Any]], path: Path, *arguments: Any) -> list[Any]:
    """What ``reader(path, *arguments)``, a function of a module, gives of a sealed file.

    Anybody can seal a file, and there are some over which the library crashes or never ends. So what this process has
    not written itself is read by another one, within limits. Raises :class:`OutputError`.
    """
    if check_seal(path):
        return list(reader(path, *arguments))
    size = path.stat().st_size
    allowed = Allowed(60 + size // 10_000_000, 4_000_000_000 + 4 * size, size)
    try:
        return list(decoded(reader, path, *arguments, allowed=allowed))
    except (DataError, DecodeError) as error:
        raise OutputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


@contextmanager
def opened_netcdf(path: Path) -> Iterator[netCDF4.Dataset]:
    """A file that is all there. Raises :class:`OutputError`."""
    unreadable = retold((RuntimeError, OSError), OutputError, f"{path}: not a readable netCDF file: ")
    with unreadable, understood(path), _LOCK:
        require_whole(path)
        with netCDF4.Dataset(path) as file:
            file.set_auto_maskandscale(False)
            yield file


def groups_in(path: Path) -> Iterator[tuple[str, Group]]:
    """The groups of a file by their paths. Raises :class:`OutputError`."""
    with opened_netcdf(path) as file:
        yield from _read(file)


def _read(group: Any) -> Iterator[tuple[str, Group]]:
    attributes = Said(group.__dict__)
    listed = [str(attributes.pop("coordinates", ""))]  # xarray lists here those that are no dimension
    held = {}
    for name, variable in group.variables.items():
        held[name], also = _read_variable(variable)
        listed.append(also)
    aside = {*group.dimensions, *" ".join(listed).split()}
    variables, coords = ({name: v for name, v in held.items() if (name in aside) == part} for part in (False, True))
    read = Group(variables, coords, attributes)
    read.check()
    yield group.path, read
    for child in group.groups.values():
        yield from _read(child)


def _read_variable(variable: Any) -> tuple[Variable, str]:
    """With the names of coordinates that xarray lists beside it."""
    about = Said(variable.__dict__)
    fill, listed = about.pop("_FillValue", None) is not None, str(about.pop("coordinates", ""))
    values = np.asarray(variable[...], dtype=object if variable.dtype is str else None)
    if about.get("dtype") == "bool":
        del about["dtype"]
        values = values.astype(bool)
    return Variable(variable.dimensions, values, about, fill), listed


@contextmanager
def netcdf_file(path: Path) -> Iterator[Path]:
    """A partial file for the netCDF library; on leaving it is sealed and put in place. Raises :class:`OutputError`."""
    with atomic_path(path) as partial:
        try:
            yield partial
        except (RuntimeError, OSError) as error:  # of the operating system's reason the library tells "HDF error"
            # Fail as the library did, with the operating system's reason: disk or quota full, a device that is broken
            with partial.open("ab") as file:
                file.write(bytes(_MORE))
                file.flush()
                os.fsync(file.fileno())
            raise OutputError(f"{path}: cannot be written: {error}") from None
        seal_file(partial)


def attributes_of(variable: Variable) -> dict[str, Any]:
    """With what tells that a variable holds truth values, which netCDF knows as bytes."""
    return {**variable.attrs, **({"dtype": "bool"} if variable.values.dtype == bool else {})}


def _define(file: netCDF4.Dataset, path: str, content: Group) -> Iterator[tuple[Any, Any]]:
    """Define a group; yields its variables with the values to be written."""
    group = file if path == "/" else file.createGroup(path)
    group.setncatts(dict(content.attrs))
    if beside := [name for name, v in content.coords.items() if v.dims != (name,)]:  # xarray's list of coordinates
        group.setncattr("coordinates", " ".join(beside))
    for name, size in content.sizes.items():
        group.createDimension(name, size)
    for name, variable in (*content.variables.items(), *content.coords.items()):
        kind = np.dtype(np.float32) if variable.single else variable.values.dtype
        missing = variable.fill and name in content.variables
        target = define_variable(group, name, kind, variable.dims, attributes_of(variable), missing)
        unlike = {"O": object, "U": object, "b": np.int8}.get(kind.kind)  # what the file holds in their place
        yield target, variable.values.astype(unlike) if unlike else variable.values


def define_variable(
    group: Any, name: str, kind: np.dtype[Any], dims: tuple[str, ...], attributes: Mapping[str, Any], missing: bool
) -> Any:
    """A variable of a file for values of a ``kind``, text and truth values too; ``missing``: floats may be, as NaN."""
    stored = str if kind.kind in "OU" else np.dtype(np.int8) if kind.kind == "b" else kind
    made = group.createVariable(name, stored, dims, fill_value=np.nan if missing and kind.kind == "f" else None)
    made.set_auto_maskandscale(False)
    made.setncatts(attributes)
    return made


def tree_of(groups: Groups) -> xr.DataTree:
    import xarray as xr

    return xr.DataTree.from_dict({path: dataset_of(group) for path, group in groups.items()})


def dataset_of(group: Group) -> xr.Dataset:
    import xarray as xr

    def shown(v: Variable) -> xr.Variable:
        return xr.Variable(v.dims, v.stored, v.attrs, {} if v.fill else {"_FillValue": None})

    variables, coords = ({name: shown(v) for name, v in part.items()} for part in (group.variables, group.coords))
    return xr.Dataset(variables, coords, group.attrs)


FORMAT = "en4dvar-result"
VERSION = "1"
WRITTEN: set[str] = set()
"""Last words of the files that this process has sealed itself."""
_LENGTH = len(f"\n{FORMAT} {VERSION} sha256 {'0' * 64}\n")


@dataclass(frozen=True)
class SealedBytes:
    """A result file in memory: ``content``, which may be large and is never copied, and its last line."""

    content: bytes | memoryview
    line: bytes
    sha256: str

    @classmethod
    def of(cls, content: bytes | memoryview) -> Self:
        """``content`` with its last line, and the digest of both."""
        digest = hashlib.sha256(content)
        line = _line(digest.hexdigest())
        digest.update(line)
        return cls(content, line, digest.hexdigest())

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (bytes(self.content), self.line, self.sha256)

    def write(self, path: Path) -> Path:
        """Write the file atomically. Raises :class:`OutputError`."""
        WRITTEN.add(self.line.decode("ascii"))
        with atomic_path(path) as partial:
            partial.write_bytes(self.content)
            with partial.open("ab") as file:
                file.write(self.line)
        return path


def seal_file(path: Path) -> None:
    """Add the last line to a file that is written piece by piece. Raises :class:`OSError`."""
    with path.open("r+b") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0, os.SEEK_END)
        file.write(_line(digest))
        WRITTEN.add(_line(digest).decode("ascii"))


def check_seal(path: Path) -> bool:
    """Compare a whole file with its seal; returns whether this process has written it. Raises :class:`OutputError`."""
    try:
        with open_plain(path) as file:
            line, digest = _last_line(file, path), hashlib.sha256()
            left = file.tell() - _LENGTH
            file.seek(0)
            while left > 0 and (block := file.read(min(left, 1 << 20))):
                digest.update(block)
                left -= len(block)
    except FileNotFoundError:
        raise OutputError(f"{path}: no such file") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if line != _line(digest.hexdigest()):
        raise OutputError(f"{path}: damaged or altered since it was written (its checksum does not match)")
    return line.decode("ascii") in WRITTEN


def _last_line(file: BinaryIO, path: Path) -> bytes:
    """The line of a result; it is looked at first, for what has none may be a terabyte long."""
    file.seek(max(file.seek(0, os.SEEK_END) - _LENGTH, 0))
    line = file.read()
    words = line.decode("ascii", "replace").split()
    if words[:1] != [FORMAT] or len(words) != 4:
        raise OutputError(
            f"{path}: not a complete result of en4dvar: it is cut short, was altered, or comes from an older version"
        )
    if words[1] != VERSION:
        raise OutputError(f"{path}: result format {words[1]}; this version of en4dvar reads {VERSION}")
    return line


def _line(digest: str) -> bytes:
    return f"\n{FORMAT} {VERSION} sha256 {digest}\n".encode("ascii")
