"""An on-disk cache of compiled kernels that notices a change in any source file the kernel is made of.

numba stamps a cached kernel with the modification time of the file of its outermost function only; an edit (or an
upgrade) of a module it calls would leave stale machine code in use.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any


def _digest(folder: Path, *more: Path) -> str:
    content = b"".join(path.read_bytes() for path in (*sorted(folder.glob("*.py")), *more))
    return sha256(content).hexdigest()


def stamp_with_sources(dispatcher: Any, folder: Path, *more: Path) -> None:
    """Replace the cache stamp of ``dispatcher`` (compiled with ``cache=True``) by the content of all modules in
    ``folder`` and ``more``.
    """
    dispatcher._cache._cache_file._source_stamp = _digest(folder, *more)
