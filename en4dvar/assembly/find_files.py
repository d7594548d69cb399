"""Data files: what paths, folders and patterns name, and which data sets are in them."""

import glob
import itertools
import os
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from pathlib import Path

from en4dvar.inputs.asked import ANY, SUFFIXES, Column, DataFile, Layout
from en4dvar.inputs.parts import parts_of
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import PathError, expanded, readable
from en4dvar.plumbing.hints import natural


def with_parts(
    files: Mapping[str, Path], value: Column, layout: Layout = ANY, time: str | None = None
) -> dict[str, DataFile]:
    """Every data set that the files hold, see :func:`~en4dvar.inputs.parts.parts_of`."""
    by_name: dict[str, DataFile] = {}
    for name, path in files.items():
        try:
            parts = parts_of(path, value, layout, time)
        except DataError:  # told with its reason where it is read
            parts = ()
        for part in parts or ("",):
            by_name[readable(f"{name}_{part}") if part else name] = DataFile(path, part)
    return by_name


def find_files(base: Path, texts: Sequence[str]) -> dict[str, Path]:
    """:func:`data_files` of paths, folders and patterns relative to ``base``. Of a folder without data files those of
    its subfolders are taken, and each is named after its subfolder and itself. Raises :class:`DataError`.
    """
    paths: list[Path] = []
    grouped: set[Path] = set()
    for text in texts:
        with retold(PathError, DataError):
            path = base / expanded(text)
        if glob.has_magic(text) and not os.path.exists(path):
            matches = sorted(map(Path, glob.glob(str(path), recursive=True)), key=natural)
            if not matches:
                raise DataError(f"{path}: no file matches")
            paths += matches
        elif os.path.isdir(path):
            held = _data_files(path)
            if not held:
                folders = sorted((p for p in _beside(path) if p.is_dir() and p.name[0] != "."), key=natural)
                held = [file for folder in folders for file in _data_files(folder)]
                grouped.update(held)
            if not held:
                raise DataError(f"{path}: the folder holds no data file ({', '.join(SUFFIXES)})")
            paths += held
        else:
            paths.append(path)
    again = [path for path, count in Counter(os.path.abspath(p) for p in paths).items() if count > 1]
    if again:
        raise DataError(f"{again[0]}: occurs more than once in data.path")
    return dict(zip(_unique_names(paths, grouped), paths, strict=True))


def _beside(folder: Path) -> list[Path]:
    with retold(OSError, DataError, f"{folder}: cannot be read: "):
        return list(folder.iterdir())


def _data_files(folder: Path) -> list[Path]:
    held = [p for p in _beside(folder) if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    return sorted(held, key=natural)


def _unique_names(paths: list[Path], grouped: Set[Path]) -> list[str]:
    stems = Counter(p.stem for p in paths)
    names: dict[str, None] = {}
    for path in paths:
        name = path.stem if stems[path.stem] == 1 and path not in grouped else f"{path.parent.name}_{path.stem}"
        same = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
        names[next(n for n in same if n not in names)] = None
    return list(map(readable, names))
