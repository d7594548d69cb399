"""The languages of a program's files: templates of Jinja, templates and instructions of PEST and PEST++.

A template is the input file with ``{{ name }}`` where a parameter belongs (Jinja's language, in its sandbox), and
numbers are written with all their digits. One whose first line is ``ptf`` and a sign is in PEST's language, as are
instructions, which read numbers out of output files: Doherty, J., "PEST: Model-Independent Parameter Estimation, User
Manual Part I", and the manual of PEST++, sections on template and instruction files. A parameter space is as wide as
its delimiters say, and holds as many digits as fit. The instructions are ``ln``, ``@marker@`` (primary and secondary),
``w``, ``tn``, ``!name!`` and ``!dum!``, ``[name]a:b``, ``(name)a:b`` and, at the start of a line, ``&``; anything else
is an error.
"""

import functools
import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from jinja2 import StrictUndefined, TemplateError
from jinja2.meta import find_undeclared_variables
from jinja2.sandbox import ImmutableSandboxedEnvironment

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import retold
from en4dvar.plumbing.files import in_bytes, read_text
from en4dvar.plumbing.hints import suggest

_ITEM = r"[lL](?P<lines>[1-9]\d*)|(?P<blank>[wW])|[tT](?P<column>[1-9]\d*)|!(?P<free>[^!]+)!"
_ITEM += r"|[\[(](?P<fixed>[^\])]+)[\])](?P<first>[1-9]\d*):(?P<last>[1-9]\d*)"
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[ed]([+-]?\d+))?", re.IGNORECASE)
_NO_LETTER = re.compile(r"([+-]?(?:\d+\.\d*|\.\d+))([+-]\d{3})")  # Fortran leaves out the E of 1.5E-101


class ProgramError(Exception):
    """A program ended badly, or what it left cannot be read; the words are the reason of a member that failed."""


def _number(text: str) -> re.Match[str] | None:
    return _NUMBER.fullmatch(text.strip()) or _NO_LETTER.fullmatch(text.strip())


def plain(text: str) -> str:
    """A number as Python writes it; any other text as it is.

    >>> plain("1.5D-01"), plain("1.5-101"), plain("no number")
    ('1.5e-01', '1.5e-101', 'no number')
    """
    number = _number(text)
    return f"{number[1]}e{number[2] or 0}" if number else text


def is_pest(text: str, kind: Literal["tf", "if"]) -> bool:
    """Whether the first line says that this is a template or instructions of PEST, with a sign, the delimiter."""
    return re.match(rf"[pj]{kind} \S", text, re.IGNORECASE) is not None


def identifier(name: str) -> str:
    """The name of a parameter of PEST as it is here: lower case, and ``_`` for what is neither letter nor digit.

    >>> identifier("K1"), identifier("hk:i-0"), identifier("1st")
    ('k1', 'hk_i_0', '_1st')
    """
    plain = re.sub(r"\W", "_", name.strip().lower())
    return plain if plain.isidentifier() else f"_{plain}"


def parameters_of(text: str) -> set[str]:
    """Names of the parameters of a template, each as :func:`identifier` has it. Raises :class:`ProgramError`."""
    for number, line in enumerate(text.splitlines()[1:], 2):
        if line.count(_sign(text)) % 2:
            raise ProgramError(f"line {number}: one {_sign(text)} without another")
    return {identifier(space[1]) for space in _spaces(text).finditer(text.partition("\n")[2])}


def spaces_filled(text: str, parameters: Mapping[str, float]) -> str:
    """The input file; each space holds its parameter in its own width. Raises :class:`ProgramError`."""
    values = {identifier(name): value for name, value in parameters.items()}

    def number(space: re.Match[str]) -> str:
        return fitted(values[identifier(space[1])], len(space[0])).rjust(len(space[0]))

    return _spaces(text).sub(number, text.partition("\n")[2])


def fitted(value: float, width: int) -> str:
    """A number in at most ``width`` characters, with as many digits as fit. Raises :class:`ProgramError`.

    It has a decimal point wherever one fits, for Fortran reads digits without one as decimals: 1e-05 as 1e-08 by E10.3.

    >>> fitted(0.1, 20), fitted(1e-5, 20), fitted(2 / 3, 8), fitted(-123456.789, 7), fitted(0.00012345, 6)
    ('0.1', '1.0e-05', '0.666667', '-1.23e5', '1.2e-4')
    """
    shorter = [form for digits in range(17, 0, -1) for form in (f"{value:.{digits}g}", f"{value:.{digits - 1}e}")]
    for points in ((".0", "."), ("",)):
        for text in (repr(float(value)), *shorter):
            mantissa, e, exponent = text.partition("e")
            for point in points:
                pointed = f"{mantissa}{point}" if mantissa.lstrip("-").isdecimal() else mantissa
                for power in (exponent, exponent.removeprefix("+").replace("-0", "-").removeprefix("0")):
                    if len(form := f"{pointed}{e}{power}") <= width:
                        return form
    raise ProgramError(f"{value!r} does not fit into {width} characters of a template")


def _spaces(text: str) -> re.Pattern[str]:
    sign = re.escape(_sign(text))
    return re.compile(f"{sign}([^{sign}\n]+){sign}")


def _sign(text: str) -> str:
    """The delimiter that the first line names. Raises :class:`ProgramError`."""
    sign = text.partition("\n")[0][4:].strip()
    if len(sign) != 1 or sign.isalnum() or sign in "!()[]:&":
        raise ProgramError(f"the first line names {sign or 'nothing'!r} as the delimiter; write e.g. {text[:3]} ~")
    return sign


@functools.lru_cache(maxsize=64)
def parsed(instructions: str, source: str = "instructions") -> tuple[list[re.Match[str]], ...]:
    """The items of each line of an instruction file, ``source`` by name, with those of the lines that continue it.
    Raises :class:`ProgramError` at what is no instruction.
    """
    sign = re.escape(_sign(instructions))
    words = re.compile(f"{sign}[^{sign}]*{sign}|[^\\s{sign}]+|{sign}.*")
    known = re.compile(f"{_ITEM}|{sign}(?P<marker>[^{sign}]+){sign}")
    lines: list[list[re.Match[str]]] = []
    names: set[str] = set()
    for number, text in enumerate(instructions.splitlines()[1:], 2):
        where, items = f"{source}:{number}", words.findall(text)
        if items[:1] == ["&"] and lines:
            del items[0]
        elif items:
            lines.append([])
        for word in items:
            item = known.fullmatch(word)
            if item and item["first"] and int(item["first"]) > int(item["last"]):
                raise ProgramError(f"{where}: the columns of {word} do not increase")
            if lines[-1] and (item is None or item["lines"]):
                raise ProgramError(f"{where}: {word!r} is no instruction of PEST")
            if item is None or not (lines[-1] or item["lines"] or item["marker"]):
                words_of = "a line of instructions begins with a marker or l1, l2, …; not with"
                raise ProgramError(f"{where}: {words_of} {word!r}")
            if (name := _named(item)) in names:
                raise ProgramError(f"{where}: {name} is read twice")
            names |= {name} - {""}
            lines[-1].append(item)
    return tuple(lines)


def observations_of(instructions: str, source: str = "instructions") -> list[str]:
    """Names of the observations that instructions read, in order. Raises :class:`ProgramError`."""
    return [name for items in parsed(instructions, source) for item in items if (name := _named(item))]


def read(
    instructions: str, output: str, where: str, source: str = "instructions", delimiters: str = ""
) -> dict[str, float]:
    """Observation → value, read from the text of an output file.

    ``where`` names that in messages, ``source`` the instructions. ``delimiters``: characters that separate numbers as
    blanks and commas do, PEST++'s ``additional_ins_delimiters``.

    What is no number is NaN. Raises :class:`ProgramError`, also where none is a number.
    """
    cursor = _Cursor(output.splitlines(), where, re.escape(delimiters))
    values: dict[str, float] = {}
    wrong = ""
    for items in parsed(instructions, source):
        cursor.advance(items[0])
        k = 1
        while k < len(items):
            item, following = items[k], items[k + 1 : k + 2]
            if item["free"] or item["fixed"]:
                text = cursor.observed(item, following[0]["marker"] if following else None)
                if name := _named(item):
                    number = _number(text)
                    values[name] = math.nan if number is None else float(plain(text))
                    wrong = wrong or f"{cursor.place}: {text.strip() or 'nothing'!r} is not a number for {name}"
            elif not cursor.moved(item):
                if not all(before["marker"] for before in items[:k]):
                    raise ProgramError(f"{cursor.place}: no {item['marker']!r} behind column {cursor.column}")
                cursor.advance(items[0])  # the markers belong to a line further down
                k = 0
            k += 1
    if values and all(map(math.isnan, values.values())):
        raise ProgramError(wrong)
    return values


def _named(item: re.Match[str]) -> str:
    """The observation that an item reads, "" where it reads none."""
    name = (item["free"] or item["fixed"] or "").lower()
    return "" if name == "dum" else name


class _Cursor:
    """Where instructions have come to in the ``lines`` of an output file: ``row``, ``column``."""

    def __init__(self, lines: Sequence[str], where: str, delimiters: str):
        self.lines, self.where = lines, where
        self.row, self.column = -1, 0
        self.blank = re.compile(f"[\\s{delimiters}]+")
        self.token = re.compile(f"[^\\s,{delimiters}]+")

    @property
    def place(self) -> str:
        """File and line, for messages."""
        return f"{self.where}:{self.row + 1}"

    def advance(self, item: re.Match[str]) -> None:
        """Down to the line that the first item leads to. Raises :class:`ProgramError`."""
        if item["lines"]:
            self.row, self.column = self.row + int(item["lines"]), 0
            if self.row >= len(self.lines):
                raise ProgramError(f"{self.where}: has {len(self.lines)} lines, but line {self.row + 1} is to be read")
            return
        marker = item["marker"]
        for row in range(self.row + 1, len(self.lines)):
            if marker in self.lines[row]:
                self.row, self.column = row, self.lines[row].index(marker) + len(marker)
                return
        raise ProgramError(f"{self.where}: no {marker!r} below line {self.row + 1}")

    def moved(self, item: re.Match[str]) -> bool:
        """Along the line, by ``w``, ``tn`` or a secondary marker, False where there is none. Raises
        :class:`ProgramError`.
        """
        line = self.lines[self.row]
        if item["blank"]:
            blank = self.blank.search(line, self.column)
            if blank is None:
                raise ProgramError(f"{self.place}: no blank behind column {self.column}")
            self.column = blank.end()
            return True
        if item["column"]:
            self.column = int(item["column"])
            return True
        at = line.find(item["marker"], self.column)
        if at >= 0:
            self.column = at + len(item["marker"])
        return at >= 0

    def observed(self, item: re.Match[str], until: str | None) -> str:
        """The text of an observation, which ends at the marker ``until`` if one follows; the cursor goes behind it."""
        line = self.lines[self.row]
        if item["free"]:
            token = self.token.search(line, self.column)
            text, end = (token[0], token.end()) if token else ("", self.column)
            if until and (cut := text.find(until)) > 0:
                text, end = text[:cut], end - len(text) + cut
        else:
            first, end = int(item["first"]) - 1, int(item["last"])
            text = line[first:end]
            if item[0].startswith("("):  # the whole of what begins or lies in the columns
                token = next((t for t in self.token.finditer(line) if t.end() > first and t.start() < end), None)
                text, end = (token[0], token.end()) if token else ("", end)
        self.column = end
        return text


TIMES = "times"
LONGEST = 256_000_000  # characters of an input file
SUFFIXES = (".j2", ".tpl", ".template")
_ENVIRONMENT = ImmutableSandboxedEnvironment(undefined=StrictUndefined, keep_trailing_newline=True)


def input_name(template: Path) -> str:
    """The name of the file that a template becomes: without the suffix that says it is one."""
    return template.stem if template.suffix in SUFFIXES else template.name


def names_in(text: str, template: Path) -> set[str]:
    """What is filled into the ``text`` of a template; of PEST as :func:`identifier` has it. Raises ValueError."""
    if is_pest(text, "tf"):
        with retold(ProgramError, ValueError, f"{template}: "):
            return parameters_of(text)
    try:
        return find_undeclared_variables(_ENVIRONMENT.parse(text))
    except TemplateError as error:
        line = getattr(error, "lineno", None)
        raise ValueError(f"{template}{f':{line}' if line else ''}: {error}") from None


def check_template(template: Path, names: Collection[str]) -> None:
    """Raise ValueError, in words, where a template cannot be read or names an unknown parameter."""
    text = text_of(template)
    names = {identifier(name) for name in names} if is_pest(text, "tf") else names
    for name in sorted(names_in(text, template)):
        if name not in names and name != TIMES:
            raise ValueError(f"{template}: {name!r} is no parameter of the model{suggest(name, names)}")


def filled(text: str, template: str, parameters: Mapping[str, float], times: Array) -> str:
    """The input file of a member, of the ``text`` of a ``template`` by name; ``times`` (K,) are where it is observed.

    Raises :class:`ProgramError`.
    """
    if is_pest(text, "tf"):
        return spaces_filled(text, parameters)
    values: dict[str, Any] = {name: float(value) for name, value in parameters.items()}
    parts, left = list[str](), LONGEST
    for part in _compiled(text).generate(values | {TIMES: times.tolist()}):
        parts.append(part)
        if (left := left - len(part)) < 0:
            raise ProgramError(f"{template}: makes an input file of more than {in_bytes(LONGEST)}")
    return "".join(parts)


def text_of(file: Path) -> str:
    """A template or instructions. Raises ValueError."""
    with retold(OSError, ValueError, f"{file}: "):
        return read_text(file)


_compiled = functools.cache(_ENVIRONMENT.from_string)
