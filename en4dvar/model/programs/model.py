"""The forward model of ``model: {command: "./solver {input} {output}", …}``, and one run of its program.

A run has a scratch directory of its own, its input files, the process, and the files that it leaves: numbers are read
out of them by a column, a key of JSON, a pattern, or PEST's instructions.
"""

import csv
import itertools
import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from en4dvar.model.function_model import FunctionModel
from en4dvar.model.programs import languages
from en4dvar.model.programs.languages import ProgramError
from en4dvar.model.programs.settings import LOGARITHM, OUTPUT, STDOUT, CommandSettings, OutputOf, fill, split
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.children import Child, TimeLimitError, require_going_on, scratch, status_named, within
from en4dvar.plumbing.decoding import LONGEST_TEXT, Allowed, decoded_whole, matches, text_of
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import POSIX
from en4dvar.plumbing.hints import listed, short
from en4dvar.plumbing.tables import COMMENT, is_number
from en4dvar.plumbing.user_code import Code, require_permission

COUNTED = {  # what helps where a way of reading gives too few values, or too many
    "": "name the column of times",
    "pattern": "the pattern is to match once for each value, and nowhere else",
    "instructions": "say by observations which of them are used",
}


def read(
    output: OutputOf, folder: Path, times: Array, texts: Mapping[Path, str], seconds: float | None = None
) -> Array:
    """The values at ``times`` (K,) of an observable, in the scratch directory; a pattern may take ``seconds``.

    ``texts``: those of the instruction files.

    With a column or key of times, values are interpolated linearly at those that are asked for; without it there is one
    value a time. A value that is missing or no number is NaN, a reading that the run does not give.

    Raises :class:`ProgramError`.
    """
    file = output.file
    if output.pattern is not None:
        # by another process: a pattern may take years, in which nothing else of this one would run
        allowed = Allowed(min(Allowed.seconds, math.ceil(seconds or Allowed.seconds)), size=LONGEST_TEXT)
        values = _numbers(decoded_whole(matches, folder / file, output.pattern, allowed=allowed), file)
    elif output.instructions:
        values = _instructed(output, folder, texts)
    else:
        text, find = text_of(folder / file), _key if output.column is None else _column
        values = find(text, output.key if output.column is None else output.column, file)
        if output.time is not None:
            return _at(times, find(text, output.time, file), values, file)
    if len(values) != len(times):
        way = "pattern" if output.pattern is not None else "instructions" if output.instructions else ""
        raise ProgramError(f"{file}: {len(values)} values for {len(times)} times; {COUNTED[way]}")
    return values


def _instructed(output: OutputOf, folder: Path, texts: Mapping[Path, str]) -> Array:
    values: dict[str, float] = {}
    for file, paths in output.instruction_files.items():
        text = text_of(folder / file)
        for path in paths:
            values |= languages.read(texts[path], text, file, path.name, output.delimiters)
    names = list(values) if output.observations is None else [name.lower() for name in output.observations]
    return np.array([values[name] for name in names])


def _at(times: Array, own: Array, values: Array, file: str) -> Array:
    if len(own) != len(values) or len(own) < 1:
        raise ProgramError(f"{file}: {len(own)} times for {len(values)} values")
    if len(wrong := np.flatnonzero(~(np.diff(own) > 0)) + 1):
        told = f"{own[wrong[0]]:g} follows {own[wrong[0] - 1]:g}"
        raise ProgramError(f"{file}: times must increase, but the one of value {wrong[0] + 1} does not: {told}")
    slack = 1e-9 * max(abs(own[0]), abs(own[-1]))
    if times[0] < own[0] - slack or times[-1] > own[-1] + slack:
        needed = f"{times[0]:g} to {times[-1]:g} are needed"
        raise ProgramError(f"{file}: times from {own[0]:g} to {own[-1]:g}, but {needed}")
    return np.asarray(np.interp(times, own, values))


def _column(text: str, column: str | int | None, file: str) -> Array:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(COMMENT)]
    if not lines:
        raise ProgramError(f"{file}: is empty")
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    rows = list(csv.reader(lines, delimiter=delimiter)) if delimiter in lines[0] else [line.split() for line in lines]
    header = [cell.strip() for cell in rows[0]]
    if isinstance(column, int):  # a line of names has no number
        at, first = column - 1, 0 if any(is_number(languages.plain(cell)) for cell in header) else 1
    elif column in header:
        at, first = header.index(column), 1
    else:
        raise ProgramError(f"{file}: no column {column!r}; the columns are: {listed(header)}")
    if at >= max(len(row) for row in rows[first:] or [header]):
        raise ProgramError(f"{file}: no column {column}")
    return _numbers([row[at] if at < len(row) else "" for row in rows[first:]], file)


def _key(text: str, key: str | int | None, file: str) -> Array:
    with retold(ValueError, ProgramError, f"{file}: not JSON: "):
        node: Any = json.loads(text)
    for part in str(key).split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, ValueError, TypeError):
            raise ProgramError(f"{file}: no key {key!r}, for there is no {part!r}") from None
    return _numbers(node if isinstance(node, list) else [node], file)


def _numbers(texts: list[Any], file: str) -> Array:
    """What is no number is NaN, a reading that is missing. Raises :class:`ProgramError` where none is a number."""
    plain = [languages.plain(text) if isinstance(text, str) else text for text in texts]
    values = np.array([float(value) if is_number(value) else math.nan for value in plain])
    if len(texts) and np.isnan(values).all():
        comma = is_number(languages.plain(str(texts[0]).replace(",", ".")))
        advice = "; let the program write decimal points, e.g. by environment: {LC_ALL: C}" if comma else ""
        raise ProgramError(f"{file}: {short(str(texts[0]))!r} is no number{advice}")
    return values


LAST_WORDS = 300  # characters of the standard error in a reason
LONGEST_ERRORS = 10_000  # bytes of it that are looked at
T = TypeVar("T")


@dataclass(frozen=True)
class Program:
    """A command as a function of parameters and times; the same numbers for the same arguments, wherever it runs.

    ``words``: program and arguments, in which ``{input}``, ``{output}`` and ``{NAME}`` of a parameter are filled in; a
    single one where a shell runs it. The first of the templates is ``{input}``. ``texts``: what templates and
    instruction files held when it was made.
    """

    words: tuple[str, ...]
    settings: CommandSettings
    texts: Mapping[Path, str]

    def __call__(self, parameters: Mapping[str, float], times: Array) -> dict[str, Array]:
        """Observable → values (K,). Raises :class:`ProgramError`: the last attempt failed, with its reason."""
        for _ in range(self.settings.retries):
            with suppress(ProgramError):
                return self._attempt(parameters, times)
        return self._attempt(parameters, times)

    def _attempt(self, parameters: Mapping[str, float], times: Array) -> dict[str, Array]:
        """One run. What this process does for it, and what the program does, are together within the time limit.

        The program gets scale · value + offset of each parameter. The values of linear combinations of the parameters
        as they are estimated, name or log10(name) → factor, stand behind those that the program gives.
        """
        require_going_on()
        inputs = {name: of.scale * parameters[name] + of.offset for name, of in self.settings.parameters.items()}
        more = {
            name: np.array([sum(factor * _term(key, parameters) for key, factor in terms.items()) for terms in several])
            for name, several in ((name, output.combinations) for name, output in self.settings.outputs.items())
        }
        times = times[: max(len(times) - max(map(len, more.values())), 0)]
        end = None if self.settings.time_limit is None else time.monotonic() + self.settings.time_limit

        def within_limit(call: Callable[[], T]) -> T:
            return call() if end is None else within(end - time.monotonic(), call)

        try:
            with scratch(self.settings.scratch) as folder:
                within_limit(lambda: self._fill(folder, inputs, times))
                self._run(folder, inputs, end)
                outputs, limit = self.settings.outputs.items(), self.settings.time_limit
                values = within_limit(
                    lambda: {n: read(output, folder, times, self.texts, limit) for n, output in outputs}
                )
                return {name: np.concatenate([values[name], more[name]]) for name in values}
        except DataError as error:
            raise ProgramError(str(error).replace(f"{folder}{os.sep}", "")) from None
        except OSError as error:
            raise ProgramError(f"{error.filename or 'scratch folder'}: {error.strerror}") from None
        except (TimeLimitError, subprocess.TimeoutExpired):
            raise ProgramError(f"not done after {self.settings.time_limit:g} s") from None

    def _fill(self, folder: Path, parameters: Mapping[str, float], times: Array) -> None:
        for file in self.settings.files:
            shutil.copy(file, folder)
        for name, file in self.settings.templates.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            text = languages.filled(self.texts[file], file.name, parameters, times)
            (folder / name).write_text(text, encoding="utf-8", newline="")

    def _run(self, folder: Path, parameters: Mapping[str, float], end: float | None) -> None:
        values = {name: repr(float(value)) for name, value in parameters.items()}
        values |= {"input": next(iter(self.settings.templates), ""), "output": OUTPUT}
        words = [fill(word, values) for word in self.words]
        line: list[str] | str = words
        if self.settings.shell:  # which takes its line as it is
            line = ["/bin/sh", "-c", *words] if POSIX else f'cmd /d /s /c "{words[0]}"'
        with (folder / STDOUT).open("wb") as printed, tempfile.TemporaryFile(dir=folder) as said:
            with Child(line, folder, self.settings.environment, printed, said) as child:
                status = child.wait(None if end is None else end - time.monotonic())
            if status:
                said.seek(max(0, said.seek(0, os.SEEK_END) - LONGEST_ERRORS))
                advice = " (now and then? retries: 2 runs it again)" if status < 0 and not self.settings.retries else ""
                lines = said.read().decode("utf-8", "replace").replace(f"{folder}{os.sep}", "").strip().splitlines()
                reason = f": {lines[-1].strip()[-LAST_WORDS:]}" if lines else ""
                how = "was ended by" if status < 0 else "ended with"
                raise ProgramError(f"the program {how} {status_named(status)}{reason}{advice}")


def _term(key: str, parameters: Mapping[str, float]) -> float:
    if not key.startswith(LOGARITHM):
        return parameters[key]
    value = parameters[key[len(LOGARITHM) : -1]]
    if not value > 0:
        raise ProgramError(f"{key}: {value:g} has no logarithm")
    return math.log10(value)


class CommandModel(FunctionModel):
    """An external program: parameters go into files or arguments, observables come out of files."""

    Settings = CommandSettings
    threaded = True  # a thread that waits for a program leaves the interpreter to others

    def __init__(self, settings: CommandSettings):
        words = split(settings.command, settings.shell)
        program = "/bin/sh" if settings.shell else shutil.which(words[0]) or words[0]
        require_permission(Code(f"model command {settings.command!r}", (Path(program),)))
        own = settings.parameters.items()
        parameters = [Parameter(name, of.unit, bounds=(of.lower, of.upper), label=of.label) for name, of in own]
        units = {name: entry.unit for name, entry in settings.outputs.items()}
        read_once = [*settings.templates.values()]
        for output in settings.outputs.values():
            read_once += itertools.chain(*output.instruction_files.values())
        texts = {path: languages.text_of(path) for path in read_once}
        super().__init__(Program(words, settings, texts), parameters, units, settings.time_unit)
        self.interpolated = frozenset(name for name, of in settings.outputs.items() if of.time is not None)

    @classmethod
    def from_settings(cls, settings: CommandSettings) -> Self:
        """Raises :class:`~en4dvar.plumbing.user_code.RefusedError` where the program may not be run."""
        return cls(settings)
