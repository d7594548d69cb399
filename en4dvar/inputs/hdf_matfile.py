"""Vectors, matrices and scalars of MATLAB v7.3 files, which are HDF5.

Nothing outside of the file is opened: external and soft links are not followed, data kept in other files are not read,
and no filter is used but those that HDF5 brings along. Sizes are looked at before anything is read.
MathWorks, *MAT-File Versions*; the layout is that of ``save(…, '-v7.3')``.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.inputs.variables import MOST, MOST_IN_MATRICES, Variables, array_words, gathered
from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import Allowed, decoded_whole
from en4dvar.plumbing.errors import DataError

HDF = Allowed(seconds=60, memory=8_000_000_000, size=256_000_000_000)
DEEPEST = 4  # structs inside structs
MOST_OBJECTS = 100_000
FILTERS = {1, 2, 3}  # deflate, shuffle, Fletcher's checksum
WORDS = {"char": "text", "cell": "a cell array", "function_handle": "a function"}

Found = Iterator[tuple[str, Array | str]]


def hdf_variables(path: Path) -> Variables:
    """What a ``.mat`` file of version 7.3 holds. Raises :class:`DataError`."""
    return decoded_whole(variables_of_hdf, path, allowed=HDF)


def variables_of_hdf(path: Path) -> Iterator[Variables]:
    """As :func:`hdf_variables`, in the child that decodes."""
    try:
        import h5py
    except ImportError:
        raise DataError(
            f"{path}: a MATLAB v7.3 (HDF5) file, which needs: pip install h5py; or save it again in "
            "MATLAB with save(..., '-v7')"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            yield gathered(_Reader(file).variables())
    except MemoryError:
        raise
    except _Refused as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # h5py tells damage by OSError, RuntimeError, KeyError, ValueError, …
        words = " ".join(str(error).split())[:200]
        raise DataError(f"{path}: not a MATLAB v7.3 file that can be read ({words})") from None


class _Refused(Exception):
    """Why the file is not read."""


class _Reader:
    def __init__(self, file: Any):
        self.file, self.numbers, self.in_matrices, self.objects = file, 0, 0, 0

    def variables(self) -> Found:
        for name in self.file:
            if not name.startswith("#"):  # what references point to
                yield from self._child(self.file, name, name, 0)

    def _child(self, group: Any, key: str, name: str, depth: int) -> Found:
        """What stands under ``key`` of a group."""
        import h5py

        if isinstance(group.get(key, getlink=True), h5py.HardLink):
            yield from self._object(group[key], name, depth)
        else:
            yield name, "a link, which is not followed"

    def _object(self, it: Any, name: str, depth: int) -> Found:
        import h5py

        self.objects += 1
        if self.objects > MOST_OBJECTS:
            raise _Refused(f"more than {MOST_OBJECTS} variables, fields and elements")
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
        fields = list(group)
        for field in fields:
            child = group.get(field, getlink=False)
            if _refers(child) and _class(child) != "cell":  # a struct array: of each field one reference an element
                yield from self._elements(child, lambda k, field=field: f"{name}({k}).{field}", depth)
            else:
                yield from self._child(group, field, f"{name}.{field}", depth)

    def _elements(self, references: Any, named: Any, depth: int) -> Found:
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
        else:
            yield name, self._numbers(it, name, shape[::-1])

    def _numbers(self, it: Any, name: str, shape: tuple[int, ...]) -> Array | str:
        """The numbers of a dataset, or in words why they are not read."""
        count = math.prod(shape)
        vector = count == max(shape)
        if not vector and (len(shape) > 2 or self.in_matrices + count > MOST_IN_MATRICES):
            return array_words(shape)
        self.in_matrices += 0 if vector else count
        self._check(it, name)
        values = np.asarray(it[()], dtype=np.float64)
        return values.ravel() if vector else values.T

    def _check(self, it: Any, name: str) -> None:
        """Raise :class:`_Refused` where a dataset is too large, or not in this file."""
        self.numbers += math.prod(it.shape)
        if max(self.numbers, math.prod(it.chunks or ())) > MOST:
            raise _Refused(f"more than {MOST} numbers in vectors")
        if it.external is not None or it.is_virtual:
            raise _Refused(f"the numbers of {name} are in another file, which is not opened")
        properties = it.id.get_create_plist()
        used = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
        if not used <= FILTERS:
            raise _Refused(f"{name} is packed by a filter that MATLAB does not use")


def _class(it: Any) -> str:
    kind = it.attrs.get("MATLAB_class", b"")
    return kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)


def _refers(it: Any) -> bool:
    import h5py

    return isinstance(it, h5py.Dataset) and h5py.check_ref_dtype(it.dtype) is not None
