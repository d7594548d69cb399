"""The section ``model: {command: "./solver {input} {output}", …}``: how a program is called, what goes in and out."""

import itertools
import math
import os
import re
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from en4dvar.model.programs import languages
from en4dvar.model.programs.languages import TIMES, ProgramError, check_template, input_name
from en4dvar.plumbing.described import Described, text_for
from en4dvar.plumbing.errors import retold
from en4dvar.plumbing.files import POSIX, expanded
from en4dvar.plumbing.hints import beside, suggest
from en4dvar.plumbing.units import Quantity, parse_unit

OUTPUT = "output"  # the file that {output} names
STDOUT = "stdout"  # what the program prints, as a file
LOGARITHM = "log10("  # how a term log10(name) of a combination begins
OWN_NAMES = ("input", "output", "here", "python", TIMES)
_NAME = re.compile(r"\{([A-Za-z_]\w*)\}")
_QUOTED = re.compile(r"""\\.|'[^']*'|"(?:\\.|[^"\\])*\"""")
_OF_A_SHELL = re.compile(r"([\d&]?>|<|&&|\|).*|.*;|&")  # words that no program is meant to get
_WRITTEN = re.compile(r">+\s*\S+")  # into a file, by a shell
WAYS = ("column", "key", "pattern", "instructions")


def _pattern(text: str) -> str:
    with retold(re.error, ValueError, "is not a regular expression: "):
        groups = re.compile(text).groups
    if groups != 1:
        raise ValueError(f"has {groups} groups; put the number, and nothing else, in parentheses")
    return text


def _from_one(column: int | str | None) -> int | str | None:
    if column == "" or (isinstance(column, int) and column < 1):
        raise ValueError(f"columns are counted from 1, or named; not {column!r}")
    return column


def _inside(name: str) -> str:
    if Path(name).is_absolute() or ".." in Path(name).parts or not name:
        raise ValueError("name a file of the scratch directory, without .. and not from the root")
    return name


def _base(info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("base", Path.cwd())).absolute()


def _file(text: Any, info: ValidationInfo) -> Any:
    """A file beside the configuration, as an absolute path. Raises ValueError where it is not there."""
    if not isinstance(text, str | Path):
        return text
    path = _base(info) / expanded(str(text))
    if not path.is_file():
        raise ValueError(f"{path}: {beside(path)}")
    return path.absolute()


Unit = Annotated[str, text_for(parse_unit)]
File = Annotated[Path, BeforeValidator(_file, json_schema_input_type=str)]


def _several(files: Any) -> Any:
    return (files,) if isinstance(files, str | Path) else files


def _named(files: Any) -> Any:
    """Input file → template; of templates alone the name of the file follows."""
    files = _several(files)
    return {input_name(Path(str(path))): path for path in files} if isinstance(files, list | tuple) else files


Files = Annotated[tuple[File, ...], BeforeValidator(_several, json_schema_input_type=str | tuple[str, ...])]

Templates = Annotated[
    dict[Annotated[str, AfterValidator(_inside)], File],
    BeforeValidator(_named, json_schema_input_type=str | tuple[str, ...] | dict[str, str]),
]
Instructions = dict[Annotated[str, AfterValidator(_inside)], Files]


class ParameterOf(Described):
    """A parameter of the program."""

    unit: Unit = "1"
    """Unit of the number that the program gets."""
    lower: float = -math.inf
    """Lowest value that the program takes, in that unit."""
    upper: float = math.inf
    """Highest value that the program takes, in that unit."""
    label: str = ""
    """What it is called in tables and figures."""
    scale: Annotated[float, Field(allow_inf_nan=False)] = 1.0
    """The program gets scale · value + offset."""
    offset: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    """The program gets scale · value + offset."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.lower < self.upper:
            raise ValueError(f"lower ({self.lower:g}) must lie below upper ({self.upper:g})")
        return self


class OutputOf(Described):
    """Where the values of an observable are: one of column, key, pattern, instructions."""

    unit: Unit = "1"
    """Unit of the numbers that the program writes."""
    file: Annotated[str, AfterValidator(_inside)] = OUTPUT
    """File in the scratch directory; default the one that {output} names; stdout is what the program prints."""
    column: Annotated[int | str | None, AfterValidator(_from_one)] = None
    """Column of a table: its header, or its number from 1."""
    key: Annotated[str, Field(min_length=1)] | None = None
    """Path into a JSON file, with dots."""
    pattern: Annotated[str, AfterValidator(_pattern)] | None = None
    """Regular expression with one group; every match is a value."""
    instructions: File | Instructions | None = None
    """Instruction file of PEST (.ins) for ``file``; of several files OUTPUT: instructions. Every observation is a
    value, in order."""
    observations: tuple[str, ...] | None = None
    """Which of the instructions' observations, in the order of the readings; default all."""
    delimiters: str = ""
    """Characters that separate numbers as blanks and commas do, for instructions."""
    combinations: tuple[Annotated[dict[str, float], Field(min_length=1)], ...] = ()
    """Linear combinations of parameters, each a value behind those of the instructions: {k: 1, log10(h): -2}."""
    time: Annotated[int | str | None, AfterValidator(_from_one)] = None
    """Column or key of the times that the values belong to; without it there is one value for each observation."""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        ways = [way for way in WAYS if getattr(self, way) is not None]
        if len(ways) != 1:
            raise ValueError(f"give one of {', '.join(WAYS)}; given: {', '.join(ways) or 'none'}")
        if self.time is not None and ways[0] not in ("column", "key"):
            raise ValueError(f"time goes with column or key, not with {ways[0]}")
        if self.observations is not None and self.instructions is None:
            raise ValueError("observations are those of instructions, and there are none")
        if self.instructions is None and (self.delimiters or self.combinations):
            raise ValueError("delimiters and combinations go with instructions, and there are none")
        names: list[str] = []
        for path in itertools.chain.from_iterable(self.instruction_files.values()):
            text = languages.text_of(path)
            if not languages.is_pest(text, "if"):
                raise ValueError(f"{path}: the first line of PEST's instructions is pif and a sign, e.g. pif @")
            with retold(ProgramError, ValueError):
                names += languages.observations_of(text, str(path))
        if double := [name for name, count in Counter(names).items() if count > 1]:
            raise ValueError(f"two of the instructions read {double[0]!r}")
        known = set(names)
        if lacking := [name for name in self.observations or () if name.lower() not in known]:
            raise ValueError(f"the instructions read no {lacking[0]!r}{suggest(lacking[0], known)}")
        return self

    @property
    def instruction_files(self) -> dict[str, tuple[Path, ...]]:
        """Output file → its instruction files; none where values are found another way."""
        own = self.instructions
        return {self.file: (own,)} if isinstance(own, Path) else own or {}


def _with_unit(text: Any) -> Any:
    return {"unit": text} if isinstance(text, str | int | float) else text


UnitOrSection = Annotated[ParameterOf, BeforeValidator(_with_unit, json_schema_input_type=str | ParameterOf)]


def _placed(command: str, info: ValidationInfo) -> str:
    """The command with absolute paths of what lies beside the configuration. Raises ValueError: no such program, or a
    word of a shell where none reads it."""
    base, shell = _base(info), bool(info.data.get("shell"))
    known = {"here": shlex.quote(str(base)), "python": shlex.quote(sys.executable)}
    command = fill(command, known)
    first, *others = split(command, shell)
    if shell:
        return command
    if sign := next((word for word in _QUOTED.sub("_", command).split() if _OF_A_SHELL.fullmatch(word)), ""):
        raise ValueError(
            f"the program would get {sign} as an argument; write shell: true, or '{sign}' if that is meant"
        )
    if Path(first).name != first:
        path = base / expanded(first)
        if not path.is_file():
            raise ValueError(f"{path}: {beside(path)}")
        if not os.access(path, os.X_OK):
            raise ValueError(f"{path}: is not executable; chmod +x it, or begin with the program that runs it")
        first = str(path.absolute())
    elif shutil.which(first) is None:
        raise ValueError(f"no program {first!r} on the PATH; for one beside this file write ./{first}")
    return shlex.join((first, *others))


def _named_well(parameters: dict[str, ParameterOf]) -> dict[str, ParameterOf]:
    for name in parameters:
        if not name.isidentifier() or name in OWN_NAMES:
            raise ValueError(f"{name!r} cannot be the name of a parameter")
    return parameters


def _folder(folder: Path, info: ValidationInfo) -> Path:
    path = _base(info) / expanded(str(folder))
    if not path.is_dir():
        raise ValueError(f"{path}: no such folder")
    return path


class CommandSettings(Described):
    """A program as forward model: how it is called, what goes in, what comes out."""

    shell: bool = False
    """Run the command by /bin/sh instead of splitting it into words."""
    command: Annotated[str, Field(min_length=1), AfterValidator(_placed)]
    """Program and arguments, split as by a shell but run without one. {input} and {output} are names of files, {NAME} a
    parameter, {here} the folder of this file, {python} this Python. It runs in a scratch directory of its own."""
    parameters: Annotated[dict[str, UnitOrSection], Field(min_length=1), AfterValidator(_named_well)]
    """Name → unit, or a section: what is filled in."""
    outputs: Annotated[dict[str, OutputOf], Field(min_length=1)]
    """Observable → where its values are."""
    templates: Templates = Field({})
    """Input files with {{ NAME }} for a parameter, {{ times }} for the observation times, or of PEST (ptf ~); the first
    one is {input}. Suffixes .j2, .tpl and .template are left out of the name; or write NAME: template."""
    files: Files = ()
    """Further files that are copied into the scratch directory."""
    time_unit: Unit = "s"
    """Unit of times."""
    environment: dict[str, str] = Field({})
    """Environment variables, beside those of this process."""
    time_limit: Annotated[float, Quantity("s"), Field(gt=0)] | None = None
    """Longest that one run may take, e.g. 60 s; past it the program is ended and the member has failed."""
    retries: Annotated[int, Field(ge=0, le=100)] = 0
    """How often a run that failed is tried again; for licences and full disks, not for models that vary."""
    scratch: Annotated[Path, AfterValidator(_folder)] | None = None
    """Folder that holds the scratch directories; default the system's for temporary files."""

    @model_validator(mode="after")
    def _belong_together(self, info: ValidationInfo) -> Self:
        known = {*self.parameters, "input", "output"}
        for name in _NAME.findall(self.command):
            if name not in known:
                raise ValueError(f"command: {{{name}}} is not something that can be filled in{suggest(name, known)}")
        if "{input}" in self.command and not self.templates:
            raise ValueError("command: {input} is the first of templates, and there is none")
        for template in self.templates.values():
            check_template(template, self.parameters)
        for output in self.outputs.values():
            for key in itertools.chain.from_iterable(output.combinations):
                name = key[len(LOGARITHM) : -1] if key.startswith(LOGARITHM) and key.endswith(")") else key
                if name not in self.parameters:
                    raise ValueError(f"combinations: {key!r} is no parameter{suggest(name, self.parameters)}")
        written = [*self.templates, *(file.name for file in self.files), OUTPUT, STDOUT]
        if double := {name for name in written if written.count(name) > 1}:
            raise ValueError(f"templates and files: two of them become {min(double)!r} in the scratch directory")
        written += [Path(output.file).name for output in self.outputs.values()]
        if lacking := left_behind(self.command, _base(info), written):
            where = f"write {{here}}/{lacking}, or name it in files"
            raise ValueError(f"command: {lacking} is not in the scratch directory that each run has; {where}")
        return self


def left_behind(command: str, folder: Path, there: Sequence[str]) -> str:
    """The first word of a command that names a file of ``folder``, and none of those ``there`` where it runs; or "",
    also of several commands, of which one may bring the file, or change the folder.
    """
    if re.search(r"[;\n]|&&", command):
        return ""
    words = [word.strip("'\"") for word in _WRITTEN.sub("", command).split()]
    named = [word for word in words if "." in word and not Path(word).is_absolute() and Path(word).name not in there]
    return next((word for word in named if (folder / word).is_file()), "")


def fill(word: str, values: Mapping[str, str]) -> str:
    """A word of a command with ``{name}`` replaced by what is known; other braces stay."""
    for name, value in values.items():
        word = word.replace(f"{{{name}}}", value)
    return word


def split(command: str, shell: bool) -> tuple[str, ...]:
    """The words of a command. Raises ValueError where quotes are left open or there is none."""
    lexer = shlex.shlex(command, posix=True, punctuation_chars=False)
    lexer.whitespace_split, lexer.commenters = True, ""
    if not POSIX:  # a backslash separates folders
        lexer.escape = ""
    words = (command,) if shell else tuple(lexer)
    if not words or not words[0].strip():
        raise ValueError("write the program and its arguments")
    return words
