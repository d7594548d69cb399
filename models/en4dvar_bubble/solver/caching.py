"""An on-disk cache of compiled kernels that notices a change in any source file the kernel is made of.

numba stamps a cached kernel with the modification time of the file of its outermost function only; an edit (or an
upgrade) of a module it calls would leave stale machine code in use.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile


class SignatureFiles(IndexDataCacheFile):
    """A file of machine code for each signature and stamp, there before the index names it.

    numba numbers the files and writes the index first. Of processes that start at once, one could then load what
    another has compiled for another signature; and a kill in between would leave an index that is of the sources of
    today with machine code of those before.
    """

    def save(self, key: Any, data: Any) -> None:
        digest = sha256(repr((self._source_stamp, key)).encode()).hexdigest()[:16]
        name = f"{self._index_name.removesuffix('.nbi')}.{digest}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


def _digest(folder: Path, *more: Path) -> str:
    content = b"".join(path.read_bytes() for path in (*sorted(folder.glob("*.py")), *more))
    return sha256(content).hexdigest()


def stamp_with_sources(dispatcher: Any, folder: Path, *more: Path) -> None:
    """Replace the cache stamp of ``dispatcher`` (compiled with ``cache=True``) by the content of all modules in
    ``folder`` and ``more``.
    """
    cache = dispatcher._cache
    cache._cache_file = SignatureFiles(cache.cache_path, cache._impl.filename_base, _digest(folder, *more))
