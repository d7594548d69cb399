"""Numbers of MATLAB files, also inside structs and cell arrays, under the names MATLAB has for them.

What is in a struct or a cell array is ``film.R``, ``expts(2).R``, ``R{3}``; column and row of a matrix are ``M(:,2)``
and ``M(2,:)``.

Those of version 5 are read by scipy, those of version 7.3, which are HDF5, by h5py, in a process of their own: either
library can be taken down by one flipped bit. Sizes are looked at before numbers are read. Of HDF5 nothing outside of
the file is opened: external and soft links are not followed, data kept in other files are not read, and no filter is
used but those that HDF5 brings along.
MathWorks, *MAT-File Format* (R2019b), *MAT-File Versions*; the layout of HDF5 is that of ``save(…, '-v7.3')``.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.inputs.text_table import WIDEST
from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import MOST_OBJECTS, Allowed, decoded_whole, require_plain
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import open_plain
from en4dvar.plumbing.hints import matches

MAT = Allowed(seconds=60, memory=8_000_000_000, size=256_000_000_000)
LONGEST = 4_000_000_000  # bytes of a file of version 5, which is read whole
HEADER = 128  # bytes
DEEPEST = 4  # structs inside structs
FILTERS = {1, 2, 3}  # deflate, shuffle, Fletcher's checksum
MOST = 1 << 25  # numbers in all vectors of a file: 256 MiB, whatever a small compressed file may unpack to
MOST_IN_MATRICES = 1 << 22  # in all matrices of a file: what is larger is a film, not a table
SHOWN = 12  # columns of a matrix that are told one by one
_INDEX = re.compile(r"\((\d+)\)|\{(\d+)\}")
_OF_MATRIX = re.compile(r"(.+)\((?::,([1-9]\d{0,8})|([1-9]\d{0,8}),:)\)")
WORDS = {"char": "text", "cell": "a cell array", "function_handle": "a function"}
KINDS = {"char": "text", "sparse": "a sparse matrix", "function": "a function", "object": "an object"}

Found = Iterator[tuple[str, Array | str]]


@dataclass(frozen=True)
class Variables:
    """What a file holds, by name: real vectors (K,) and matrices (n, m), and in words what else there is."""

    elements: Mapping[str, Array | str]

    @cached_property
    def vectors(self) -> dict[str, Array]:
        """(K,) each."""
        return {name: it for name, it in self.elements.items() if not isinstance(it, str) and it.ndim == 1}

    @cached_property
    def matrices(self) -> dict[str, Array]:
        """(n, m) each."""
        return {name: it for name, it in self.elements.items() if not isinstance(it, str) and it.ndim == 2}

    @property
    def scalars(self) -> dict[str, float]:
        """Finite vectors of one number."""
        return {name: float(it[0]) for name, it in self.vectors.items() if it.size == 1 and np.isfinite(it[0])}

    @property
    def others(self) -> dict[str, str]:
        """In words what is no vector."""
        words = {name: it for name, it in self.elements.items() if isinstance(it, str)}
        return words | {name: array_words(matrix.shape) for name, matrix in self.matrices.items()}

    def vector(self, name: str) -> Array | None:
        """A vector by its name, also of a matrix; None where there is none."""
        match = _OF_MATRIX.fullmatch(name)
        if name in self.vectors or match is None or match[1] not in self.matrices:
            return self.vectors.get(name)
        matrix, index = self.matrices[match[1]], int(match[2] or match[3]) - 1
        of = matrix.T if match[2] else matrix
        return of[index] if index < len(of) else None

    def matching(self, pattern: str) -> tuple[str, ...]:
        """The names that a pattern with ``*`` stands for, columns and rows of matrices among them."""
        names = list(self.vectors)
        for name, matrix in self.matrices.items():
            if max(matrix.shape) <= WIDEST:
                names += [f"{name}(:,{k + 1})" for k in range(matrix.shape[1])]
                names += [f"{name}({k + 1},:)" for k in range(matrix.shape[0])]
        return tuple(name for name in names if matches(name, pattern))

    def of(self, part: str) -> "Variables":
        """What is not inside an array, and of arrays the element ``part`` under names without the index."""
        named = ((*indexed(name), it) for name, it in self.elements.items())
        return Variables({**self.elements, **{name: it for name, i, it in named if i and i == part}})

    def of_first(self) -> "Variables":
        """Each array by its first element, under names without the index."""
        kept: dict[str, Array | str] = {}
        for name, it in self.elements.items():
            kept.setdefault(indexed(name)[0], it)
        return Variables(kept)

    def columns(self) -> dict[str, Array]:
        """Vectors of more than one number, the columns of narrow matrices, and the rows of flat ones."""
        columns = {name: vector for name, vector in self.vectors.items() if vector.size > 1}
        for name, matrix in self.matrices.items():
            if matrix.shape[1] <= SHOWN:
                columns |= {f"{name}(:,{k + 1})": column for k, column in enumerate(matrix.T)}
            elif matrix.shape[0] <= SHOWN:
                columns |= {f"{name}({k + 1},:)": row for k, row in enumerate(matrix)}
        return columns


def array_words(shape: Sequence[int]) -> str:
    """What an array that is no vector is called."""
    return f"an array of {' x '.join(map(str, shape))}"


def indexed(name: str) -> tuple[str, str]:
    """``expts(2).R`` as ``expts.R`` and ``2``, ``C{3}`` as ``C`` and ``3``; by the first index, "" without one."""
    match = _INDEX.search(name)
    return (name[: match.start()] + name[match.end() :], match[1] or match[2]) if match else (name, "")


def mat_variables(path: Path) -> Variables:
    """What a ``.mat`` file holds. Raises :class:`DataError`."""
    return decoded_whole(variables_of, path, allowed=MAT, kind="a MATLAB file")


def variables_of(path: Path) -> Iterator[Variables]:
    """As :func:`mat_variables`, in the child that decodes."""
    with open_plain(path) as file:
        head = file.read(HEADER)
    if not head.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        raise DataError(f"{path}: not a MATLAB v5 file (no such header); save it in MATLAB with save(..., '-v7')")
    hdf = head.startswith(b"MATLAB 7.3") or head[124:] in (b"\x00\x02IM", b"\x02\x00MI")
    yield Variables(dict((_Hdf if hdf else _Classic)(path).variables()))


class _Reader:
    """How much of a file has been read. What takes more raises :class:`DataError`."""

    def __init__(self, path: Path):
        self.path = path
        self.numbers = self.in_matrices = self.objects = 0

    def named(self, name: str) -> str:
        """One more variable, field or element."""
        self.objects += 1
        if self.objects > MOST_OBJECTS:
            raise DataError(f"{self.path}: more than {MOST_OBJECTS} variables, fields and elements")
        if not name.isprintable():
            raise DataError(f"{self.path}: the name of a variable is damaged")
        return name

    def left_out(self, shape: tuple[int, ...]) -> str:
        """What an array is called that is not read; "" where it is, and counts."""
        count = math.prod(shape)
        vector = count == max(shape)
        if not vector and (len(shape) > 2 or self.in_matrices + count > MOST_IN_MATRICES):
            return array_words(shape)
        self.in_matrices += 0 if vector else count
        self.count(count)
        return ""

    def count(self, numbers: int) -> None:
        self.numbers += numbers
        if self.numbers > MOST:
            raise DataError(f"{self.path}: more than {MOST} numbers in vectors")


class _Classic(_Reader):
    """Version 5."""

    def variables(self) -> Found:
        from scipy.io import loadmat, whosmat
        from scipy.io.matlab import MatlabOpaque, varmats_from_mat

        require_plain(self.path, LONGEST)
        with open_plain(self.path) as file:
            variables = varmats_from_mat(file)  # each as a file of its own
        for name, alone in variables:
            if not name or name.startswith("__"):
                continue
            if name != "None":  # which scipy calls an object of a newer class, and cannot tell its size
                ((_, shape, kind),) = whosmat(alone)
                large = kind not in ("cell", "struct") and math.prod(shape) > MOST_IN_MATRICES
                words = KINDS.get(kind) or (_Reader(self.path).left_out(shape) if large else "")
                if words:
                    yield self.named(name), words
                    continue
            value = loadmat(alone, uint16_codec="latin-1")[name]  # a codec that every byte has a letter in
            own = value["s0"][0].decode("latin-1") if isinstance(value, MatlabOpaque) else name
            yield from self._value(value, own, 0)

    def _value(self, it: Any, name: str, depth: int) -> Found:
        from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

        self.named(name)
        if isinstance(it, MatlabFunction | MatlabObject | MatlabOpaque):
            yield name, "a function" if isinstance(it, MatlabFunction) else "an object"
        elif not isinstance(it, np.ndarray):
            if it is not None:
                yield name, "a sparse matrix"
        elif depth and it.shape == (1, 0):
            return  # an element that never had a value
        elif it.dtype.hasobject:
            yield name, "a struct" if it.dtype.names else "a cell array"
            for k, element in enumerate(it.ravel(order="F") if depth < DEEPEST else (), 1):
                if it.dtype.names:
                    of = name if it.size == 1 else f"{name}({k})"
                    for field in it.dtype.names:
                        yield from self._value(element[field], f"{of}.{field}", depth + 1)
                else:
                    yield from self._value(element, f"{name}{{{k}}}", depth + 1)
        elif it.dtype.kind in "Uc":
            yield name, "text" if it.dtype.kind == "U" else "complex"
        else:
            values = np.asarray(it, dtype=np.float64)
            yield name, self.left_out(it.shape) or (values.ravel() if values.size == max(values.shape) else values)


class _Hdf(_Reader):
    """Version 7.3."""

    def variables(self) -> Found:
        import h5py

        with h5py.File(self.path, "r") as self.file:
            for name in self.file:
                if not name.startswith("#"):  # what references point to
                    yield from self._child(self.file, name, name, 0)

    def _child(self, group: Any, key: str, name: str, depth: int) -> Found:
        import h5py

        if isinstance(group.get(key, getlink=True), h5py.HardLink):
            yield from self._object(group[key], name, depth)
        else:
            yield name, "a link, which is not followed"

    def _object(self, it: Any, name: str, depth: int) -> Found:
        import h5py

        self.named(name)
        if isinstance(it, h5py.Group):
            yield from self._struct(it, name, depth + 1)
        elif isinstance(it, h5py.Dataset):
            yield from self._dataset(it, name, depth)

    def _struct(self, group: Any, name: str, depth: int) -> Found:
        if "MATLAB_sparse" in group.attrs:
            yield name, "a sparse matrix"
            return
        yield name, "a struct"
        if depth > DEEPEST:
            return
        for field in list(group):
            child = group.get(field, getlink=False)
            if _refers(child) and _class(child) != "cell":  # a struct array: of each field one reference an element
                yield from self._elements(child, lambda k, field=field: f"{name}({k}).{field}", depth)
            else:
                yield from self._child(group, field, f"{name}.{field}", depth)

    def _elements(self, references: Any, named: Any, depth: int) -> Found:
        self.count(math.prod(references.shape))
        self._check(references, named(1))
        for k, reference in enumerate(references[()].ravel(), 1):  # HDF5 has MATLAB's order with axes swapped
            if reference:
                yield from self._object(self.file[reference], named(k), depth)

    def _dataset(self, it: Any, name: str, depth: int) -> Found:
        kind, shape = _class(it), it.shape or ()
        if kind in WORDS:
            yield name, WORDS[kind]
            if kind == "cell" and _refers(it) and depth < DEEPEST:
                yield from self._elements(it, lambda k: f"{name}{{{k}}}", depth + 1)
        elif it.dtype.kind not in "iuf" or not shape:
            yield name, "complex" if it.dtype.names else "an object"
        elif "MATLAB_empty" in it.attrs:
            yield name, np.empty(0)
        elif words := self.left_out(shape[::-1]):
            yield name, words
        else:
            self._check(it, name)
            values = np.asarray(it[()], dtype=np.float64)
            yield name, values.ravel() if values.size == max(shape) else values.T

    def _check(self, it: Any, name: str) -> None:
        """Raise :class:`DataError` where a dataset is too large, or not in this file."""
        _Reader(self.path).count(math.prod(it.chunks or ()))
        if it.external is not None or it.is_virtual:
            raise DataError(f"{self.path}: the numbers of {name} are in another file, which is not opened")
        properties = it.id.get_create_plist()
        used = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
        if not used <= FILTERS:
            raise DataError(f"{self.path}: {name} is packed by a filter that MATLAB does not use")


def _class(it: Any) -> str:
    kind = it.attrs.get("MATLAB_class", b"")
    return kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)


def _refers(it: Any) -> bool:
    import h5py

    return isinstance(it, h5py.Dataset) and h5py.check_ref_dtype(it.dtype) is not None
