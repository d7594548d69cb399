"""Which gel, day or concentration each bubble is of: by its folder, or as a column of a table says."""

import glob
import json
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from en4dvar.inputs.parts import ANY, VARIABLES, DataFile, Layout, cell, opened, table_of
from en4dvar.inputs.text_table import cells_of, delimiter_of, numbered_lines, sheet_lines
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import expanded, readable
from en4dvar.plumbing.hints import listed, shown
from en4dvar.plumbing.units import is_unit

FOLDER = "folder"
_UNIT = re.compile(r"(.+?)[ _]*[\[(/ _] *([^\W\d_]+|%) *[\])]?")
_NUMBER = re.compile(r"\d+([.,]\d+)?")
_LETTERS = re.compile(r"[^\W\d_]*")


@dataclass(frozen=True)
class Grouped:
    """``kind`` of group and, of each group, the names of its data sets; ``of`` is empty where there are no groups."""

    kind: str = FOLDER
    of: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """The kind as a key in YAML."""
        return self.kind if self.kind.isidentifier() else _json(self.kind)

    @property
    def patterns(self) -> dict[str, str]:
        """Of each group, as YAML: how the names of its bubbles begin, where all and no other ones do, or else these."""
        told = {}
        for group, names in self.of.items():
            begins = {other: [name.startswith(f"{group}_") for name in its] for other, its in self.of.items()}
            alone = all(begins.pop(group)) and not any(map(any, begins.values()))
            told[_json(group)] = _json(f"{glob.escape(group)}_*" if alone else [*map(glob.escape, names)])
        return told


class Together(NamedTuple):
    """Of several bubbles: the ``names`` of the parameters that vary from one to the other of one gel or ``liquid``, and
    the ``common`` ones. How much bubbles of one gel differ is known better than the gel itself.
    """

    names: Sequence[str]
    common: Sequence[str]
    liquid: bool
    groups: Grouped


def ends_with(kind: str, sizes: Mapping[str, int], names: Iterable[str]) -> str:
    """What the run estimates at its end of groups of a kind and their numbers of bubbles; of one gel without groups,
    which data sets whose ``names`` begin in two ways may not be of.
    """
    if not sizes:
        count = Counter(_LETTERS.match(name)[0] for name in names)  # type: ignore[index]
        begin = " or ".join(f"{letters} ({of_it})" for letters, of_it in count.items())
        asked = (
            f"; names begin with {begin}: if these are two gels, write a table gels.csv of two columns, file and gel, "
            "with a line for each file, and add --groups gels.csv to this command"
        )
        return "at its end the run estimates their one gel" + asked * (len(count) == 2 and min(count.values()) > 1)
    told = ", ".join(f"{name} ({count})" for name, count in sizes.items())
    return f"at its end the run estimates each {kind}, and compares them: {told}"


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


NO_GROUPS = Grouped()


def grouped(files: Mapping[str, DataFile], data: str | Path, asked: str | None, layout: Layout) -> Grouped:
    """Of the data sets ``files``: as ``asked`` says, a column of the data, or a table and perhaps one of its columns,
    as ``gels.csv`` or ``gels.csv:gel``; without, by their folders.

    Raises :class:`DataError`: no such table or column, no row or several groups for a data set, one group only.
    """
    if asked is None:
        return _by_folder(files, data)
    path, _, column = asked.rpartition(":")
    if not path or not expanded(path).is_file():
        path, column = asked, ""
    if expanded(path).is_file():
        kind, each = _by_table(files, expanded(path), column)
    elif path.lower().endswith((".csv", ".txt", ".tsv", ".xlsx")):
        raise DataError(f"{path}: no such table of groups")
    else:
        kind, each = asked, {name: _in_data(file, asked, layout) for name, file in files.items()}
    title, unit = parted(kind) if is_unit(parted(kind)[1]) else (kind, "")
    of: dict[str, list[str]] = {}
    for name, group in each.items():
        of.setdefault(f"{group} {unit}" if unit and _NUMBER.fullmatch(group) else group, []).append(name)
    if len(of) < 2:
        raise DataError(f"{asked}: all data sets are of {shown(next(iter(of)))}: nothing can be compared")
    return Grouped(re.sub(r"[^\w.+ -]|^\W+", "", readable(title)) or "group", of)


def _by_folder(files: Mapping[str, DataFile], data: str | Path) -> Grouped:
    """Subfolders of ``data``; none where there are not several."""
    top, groups = (Path.cwd() / expanded(str(data))).absolute(), dict[str, list[str]]()
    for name, file in files.items():
        if file.path.absolute().parent.parent != top:
            return NO_GROUPS
        groups.setdefault(readable(file.path.parent.name), []).append(name)
    return Grouped(FOLDER, groups) if len(groups) > 1 else NO_GROUPS


def parted(column: str) -> tuple[str, str]:
    """A column's name without what may be the unit that it ends with, and this: of ``G [kPa]`` or ``conc_%``."""
    match = _UNIT.fullmatch(column)
    return (match[1], match[2]) if match else (column, "")


def _by_table(files: Mapping[str, DataFile], path: Path, column: str) -> tuple[str, dict[str, str]]:
    """The column of groups, and data set → group."""
    if path.absolute() in [file.path.absolute() for file in files.values()]:
        raise DataError(f"{path}: lies among the data files, and would be read as one; move it out of their folder")
    names, *rows = _lines(path)
    rows_in = [{name: _rows_of(name, file, rows, i) for name, file in files.items()} for i in range(len(names))]
    of_files = max(range(len(rows_in)), key=lambda i: sum(map(bool, rows_in[i].values())))
    if lacking := [name for name, its in rows_in[of_files].items() if not its]:
        raise DataError(
            f"{path}: no row for {listed(lacking, 5)}; a row needs, in one and the same column, the name of the data "
            f"file, as {files[lacking[0]].path.name}, and in another its group; a file of no bubble is to be moved away"
        )
    others = [name for i, name in enumerate(names) if i != of_files and name]
    if column not in others and (column or len(others) != 1):
        said = f"no column {column!r} of groups" if column else f"{len(others)} columns could be the groups"
        words = " or ".join(shlex.quote(f"{path}:{name}") for name in others[:5])
        raise DataError(f"{path}: {said}; say {words or 'one more'}")
    at = names.index(column or others[0])
    each = {name: _only({cell(row, at) for row in its}, f"{path}: {name}") for name, its in rows_in[of_files].items()}
    return names[at], each


def _lines(path: Path) -> list[Sequence[str]]:
    """Cells of a table whose first line names the columns. Raises :class:`DataError`."""
    with opened(path, ANY) as kind:
        if kind in VARIABLES:
            raise DataError(f"{path}: groups are read from a table (CSV, Excel)")
        lines = sheet_lines(path, "") if kind == "xlsx" else numbered_lines(path)
    if not lines:
        raise DataError(f"{path}: the file holds no data")
    delimiter = delimiter_of(lines[0][1], path)
    return [cells_of(line, delimiter) for _, line in lines]


def _rows_of(name: str, file: DataFile, rows: Sequence[Sequence[str]], at: int) -> list[Sequence[str]]:
    """Those that name a data set: by its part of a file, or by its file."""
    path = file.path
    words = (file.part,) if file.part else (path.name, path.stem, f"{path.parent.name}/{path.name}")
    return [row for row in rows if cell(row, at).replace("\\", "/") in (name, *words)]


def _in_data(file: DataFile, column: str, layout: Layout) -> str:
    """What the column of its own table says of a data set."""
    wanted = [column] if layout.by is None else [column, layout.by]
    with opened(file.path, layout) as kind:
        if kind in VARIABLES:
            raise DataError(f"{file.path}: the groups of elements of a .mat file are given in a table, as gels.csv")
        table = table_of(file.path, kind, layout, wanted)
    at, by = table.position(column), table.position(wanted[-1])
    of_it = {cell(row, at) for _, row in table.rows if layout.by is None or cell(row, by) == file.part}
    return _only(of_it, f"{file.path}: {file.part}" if file.part else str(file.path))


def _only(groups: set[str], where: str) -> str:
    if len(groups) == 1 and (group := next(iter(groups))):
        return readable(group)
    told = listed(sorted(groups - {""})) or "empty"
    raise DataError(f"{where}: one group is needed for a data set, not {told}")
