"""Vectors and scalars of MATLAB v5 files."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.errors import DataError

COMPRESSED = 15  # miCOMPRESSED of the MAT-file format, level 5


def mat_vectors(path: Path) -> tuple[dict[str, Any], dict[str, float], dict[str, str]]:
    """Real vectors of a ``.mat`` file, its finite scalars, and in words what else it holds."""
    from scipy.io import loadmat

    raw = path.read_bytes()  # scipy's reader may take the whole process down with a damaged file
    if not raw.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        raise DataError(f"{path}: not a MATLAB v5 file (no such header); save it in MATLAB with save(..., '-v7')")
    if raw.startswith(b"MATLAB 5.0") and _damaged(raw):
        raise DataError(f"{path}: not a MATLAB v5 file (a compressed variable is damaged)")
    try:
        content = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    except NotImplementedError:
        raise DataError(f"{path}: a MATLAB v7.3 (HDF5) file; save it again in MATLAB with save(..., '-v7')") from None
    except PermissionError:
        raise
    except Exception as error:  # a damaged file may raise anything (zlib, struct, the reader's own)
        raise DataError(f"{path}: not a MATLAB v5 file ({error})") from None
    vectors = {k: v for k, v in content.items() if _is_vector(v)}
    scalars = {k: float(v.flat[0]) for k, v in vectors.items() if v.size == 1 and np.isfinite(v.flat[0])}
    return vectors, scalars, {k: _in_words(v) for k, v in content.items() if k not in vectors}


def _damaged(content: bytes) -> bool:
    """Whether a compressed variable of a v5 file does not unpack to its end with the right checksum."""
    order = "<" if content[126:128] == b"IM" else ">"
    at = 128
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        at += 8
        if kind == 0:
            break  # padding
        if kind == COMPRESSED:
            packed = zlib.decompressobj()
            rest = content[at : at + size]
            try:
                while rest and not packed.eof:
                    packed.decompress(rest, 1 << 20)
                    rest = packed.unconsumed_tail
            except zlib.error:
                return True
            if not packed.eof:
                return True
        at += size
    return False


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.size == max(value.shape, default=0)


def _in_words(value: Any) -> str:
    """What a variable of a ``.mat`` file is that is no vector."""
    kinds = {"V": "a struct", "O": "a cell array", "U": "text", "S": "text", "b": "logical", "c": "complex"}
    size = " x ".join(map(str, np.shape(value)))
    kind = np.asarray(value).dtype.kind
    return kinds.get(kind, f"an array of {size}")
