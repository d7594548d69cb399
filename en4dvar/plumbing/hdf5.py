"""HDF5 files that are all there: no data of theirs lies in another file, no link leads into one.

A variable of netCDF may be kept in any file of the machine (external storage, virtual data sets), and a group may be
one of another file: whoever reads and hands on such a file hands on what it names. The netCDF library neither tells nor
refuses, so the links and data sets are looked through first, with the HDF5 library that it has loaded.
"""

import ctypes
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MOST_OBJECTS = 100_000
DEEPEST = 30
_HARD, _SOFT = 0, 1  # H5L_type_t; 64 and above are links into other files
_GROUP, _DATASET = 2, 5  # H5I_type_t
_CONTIGUOUS_TO_CHUNKED = (0, 1, 2)  # H5D_layout_t; 3 is virtual
_Visit = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64, ctypes.c_char_p, ctypes.POINTER(ctypes.c_int), ctypes.c_void_p)


class ForeignDataError(ValueError):
    """Something of the file lies in another one."""


def require_whole(path: Path) -> None:
    """Raises :class:`ForeignDataError` where something of an HDF5 file lies in another one; files that are none pass.

    Where the library of netCDF cannot be asked (Windows), nothing is looked at.
    """
    hdf5 = _library()
    if hdf5 is None:
        return
    with _closing(hdf5.H5Fclose, hdf5.H5Fopen(bytes(path), 0, 0)) as file:
        if file >= 0:
            _Search(hdf5).group(file, "", 0)


class _Search:
    def __init__(self, hdf5: Any):
        self.hdf5, self.objects = hdf5, 0

    def group(self, group: int, path: str, depth: int) -> None:
        links: list[tuple[bytes, int]] = []

        def visit(_: int, name: bytes, about: Any, __: Any) -> int:
            links.append((name, about[0]))  # both versions of the structure begin with the kind of link
            return int(len(links) > MOST_OBJECTS)

        self.hdf5.iterate(group, 0, 0, None, _Visit(visit), None)
        for name, kind in links:
            self._link(group, name, f"{path}/{name.decode('utf-8', 'replace')}", kind, depth)

    def _link(self, group: int, name: bytes, path: str, kind: int, depth: int) -> None:
        self.objects += 1
        if self.objects > MOST_OBJECTS or depth > DEEPEST:
            raise ForeignDataError(f"more than {MOST_OBJECTS} objects, or groups {DEEPEST} deep")
        if kind not in (_HARD, _SOFT):
            raise ForeignDataError(f"{path} is a link into another file, which is not opened")
        if kind == _SOFT:
            return  # to another name of this file, which is looked at where it stands
        with _closing(self.hdf5.H5Oclose, self.hdf5.H5Oopen(group, name, 0)) as held:
            if held < 0:
                return
            is_a = self.hdf5.H5Iget_type(held)
            if is_a == _GROUP:
                self.group(held, path, depth + 1)
            elif is_a == _DATASET:
                self._dataset(held, path)

    def _dataset(self, held: int, path: str) -> None:
        with _closing(self.hdf5.H5Pclose, self.hdf5.H5Dget_create_plist(held)) as how:
            if how < 0:
                return
            layout = self.hdf5.H5Pget_layout(how)
            if layout not in _CONTIGUOUS_TO_CHUNKED or self.hdf5.H5Pget_external_count(how) != 0:
                raise ForeignDataError(f"the numbers of {path} are in another file, which is not opened")


@contextmanager
def _closing(close: Any, identifier: int) -> Iterator[int]:
    try:
        yield identifier
    finally:
        if identifier >= 0:
            close(identifier)


@functools.cache
def _library() -> Any:
    """The HDF5 that netCDF4 is linked to; None where its functions are not to be had."""
    import netCDF4._netCDF4 as loaded

    hid, name, integer = ctypes.c_int64, ctypes.c_char_p, ctypes.c_int
    arguments: dict[str, tuple[Any, list[Any]]] = {
        "H5Fopen": (hid, [name, ctypes.c_uint, hid]),
        "H5Fclose": (integer, [hid]),
        "H5Oopen": (hid, [hid, name, hid]),
        "H5Oclose": (integer, [hid]),
        "H5Iget_type": (integer, [hid]),
        "H5Dget_create_plist": (hid, [hid]),
        "H5Pget_layout": (integer, [hid]),
        "H5Pget_external_count": (integer, [hid]),
        "H5Pclose": (integer, [hid]),
    }
    try:
        hdf5: Any = ctypes.CDLL(loaded.__file__)
        iterate = "H5Literate1" if hasattr(hdf5, "H5Literate1") else "H5Literate"  # through the links of a group
        arguments[iterate] = integer, [hid, integer, integer, ctypes.c_void_p, _Visit, ctypes.c_void_p]
        for function, (result, taken) in arguments.items():
            getattr(hdf5, function).restype, getattr(hdf5, function).argtypes = result, taken
        hdf5.iterate = getattr(hdf5, iterate)
        hdf5.H5open()
        hdf5.H5Eset_auto2(hid(0), None, None)
    except (OSError, AttributeError):
        return None
    return hdf5
