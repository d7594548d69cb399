"""Template and instruction files of PEST and PEST++, as their users have them.

Doherty, J., "PEST: Model-Independent Parameter Estimation, User Manual Part I", sections on template and instruction
files. A parameter space is as wide as its delimiters say, and holds as many digits as fit. Of the instructions these
are known: ``ln``, ``@marker@`` (primary and secondary), ``w``, ``!name!`` and ``!dum!``, ``[name]a:b``, ``(name)a:b``,
``tn``, ``&``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from en4dvar.programs.errors import ProgramError

LONGEST = 40  # characters of a number that are tried


def is_template(text: str) -> bool:
    """Whether the first line says that this is a template of PEST."""
    return text[:4].lower() in ("ptf ", "jtf ")


def is_instructions(text: str) -> bool:
    """Whether the first line says that these are instructions of PEST."""
    return text[:4].lower() in ("pif ", "jif ")


def parameters_of(text: str) -> set[str]:
    """Names of the parameters of a template, lower case as PEST has them."""
    return {found[1].strip().lower() for found in _spaces(text).finditer(text.partition("\n")[2])}


def filled(text: str, parameters: Mapping[str, float]) -> str:
    """The input file; each space holds its parameter in its own width. Raises :class:`ProgramError`."""
    values = {name.lower(): value for name, value in parameters.items()}

    def number(found: re.Match[str]) -> str:
        return fitted(values[found[1].strip().lower()], len(found[0])).rjust(len(found[0]))

    return _spaces(text).sub(number, text.partition("\n")[2])


def fitted(value: float, width: int) -> str:
    """A number in at most ``width`` characters, with as many digits as fit. Raises :class:`ProgramError`.

    >>> fitted(0.1, 20), fitted(2 / 3, 8), fitted(-123456.789, 7)
    ('0.1', '0.666667', '-123457')
    """
    if len(repr(value)) <= width:
        return repr(value)
    for digits in range(17, 0, -1):
        text = f"{value:.{digits}g}"
        for form in (text, text.replace("e-0", "e-").replace("e+0", "e+")):
            if len(form) <= width:
                return form
    raise ProgramError(f"{value!r} does not fit into {width} characters of a template")


def _spaces(text: str) -> re.Pattern[str]:
    sign = re.escape(text[4:5])
    return re.compile(f"{sign}([^{sign}\n]+){sign}")


def observations_of(instructions: str) -> list[str]:
    """Names of the observations that instructions read, in order."""
    return [name for line in _lines(instructions) for item in _items(line, instructions) if (name := _named(item))]


def read(instructions: str, output: str, where: str) -> dict[str, float]:
    """Observation → value, read from the text of an output file; ``where`` names that in messages.

    Raises :class:`ProgramError`.
    """
    lines, found = output.splitlines(), dict[str, float]()
    row, column = -1, 0
    for instruction in _lines(instructions):
        items = list(_items(instruction, instructions))
        if items and items[0] == "&":
            items = items[1:]
        elif items:
            row, column = _next_row(items[0], lines, row, where)
            items = items[1:]
        for item in items:
            name = _named(item)
            if name or item.startswith("!"):
                text, column = _value(item, lines[row], column)
                if name:
                    found[name] = _number(text, name, f"{where}:{row + 1}")
            else:
                column = _moved(item, lines[row], column, f"{where}:{row + 1}")
    return found


def _lines(instructions: str) -> list[str]:
    return [line.strip() for line in instructions.splitlines()[1:] if line.strip()]


def _items(line: str, instructions: str) -> Iterator[str]:
    """The items of a line of instructions; blanks between marker delimiters belong to the marker."""
    sign = re.escape(instructions[4:5])
    return (found[0] for found in re.finditer(f"{sign}[^{sign}]*{sign}|\\S+", line))


def _named(item: str) -> str:
    """The observation that an item reads, "" where it reads none."""
    found = re.fullmatch(r"!([^!]+)!|[\[(]([^\])]+)[\])]\d+:\d+", item)
    name = (found[1] or found[2]).lower() if found else ""
    return "" if name == "dum" else name


def _next_row(item: str, lines: list[str], row: int, where: str) -> tuple[int, int]:
    """Where the first item of a line of instructions leads: row and column."""
    if counted := re.fullmatch(r"[lL](\d+)", item):
        row += int(counted[1])
        if row >= len(lines):
            raise ProgramError(f"{where}: has {len(lines)} lines, but line {row + 1} is to be read")
        return row, 0
    marker = item[1:-1]
    for at in range(row + 1, len(lines)):
        if marker in lines[at]:
            return at, lines[at].index(marker) + len(marker)
    raise ProgramError(f"{where}: no {marker!r} below line {row + 1}")


def _moved(item: str, line: str, column: int, where: str) -> int:
    """The column behind an item that reads nothing: ``w``, ``tn`` or a secondary marker."""
    if item.lower() == "w":
        found = re.compile(r"\s+").search(line, column)
        if found is None:
            raise ProgramError(f"{where}: no blank behind column {column}")
        return found.end()
    if re.fullmatch(r"[tT]\d+", item):
        return int(item[1:])
    marker = item[1:-1]
    if (at := line.find(marker, column)) < 0:
        raise ProgramError(f"{where}: no {marker!r} behind column {column}")
    return at + len(marker)


def _value(item: str, line: str, column: int) -> tuple[str, int]:
    """The text of a number and the column behind it."""
    if fixed := re.fullmatch(r"([\[(]).*[\])](\d+):(\d+)", item):
        first, last = int(fixed[2]) - 1, int(fixed[3])
        if fixed[1] == "[":
            return line[first:last], last
        found = re.compile(r"\S+").search(line, first)
        return (found[0], found.end()) if found and found.start() < last else ("", last)
    found = re.compile(r"[^\s,]+").search(line, column)
    return (found[0], found.end()) if found else ("", column)


def _number(text: str, name: str, where: str) -> float:
    try:
        return float(text.strip().lower().replace("d", "e"))
    except ValueError:
        raise ProgramError(f"{where}: {text.strip() or 'nothing'!r} is not a number for {name}") from None
