"""The forward model of ``model: {command: "./solver {input} {output}", …}``, and one run of its program.

A run has a scratch directory of its own, its input files, the process, what it leaves.
"""

from __future__ import annotations

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
from typing import TypeVar

import numpy as np

from en4dvar.model.function_model import FunctionModel
from en4dvar.model.programs.outputs import read
from en4dvar.model.programs.pest import ProgramError
from en4dvar.model.programs.settings import LOGARITHM, OUTPUT, STDOUT, CommandSettings, fill, split
from en4dvar.model.programs.template import filled
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.children import Child, TimeLimitError, require_going_on, scratch, status_named, within
from en4dvar.plumbing.files import POSIX
from en4dvar.plumbing.user_code import Code, require_permission

LAST_WORDS = 300  # characters of the standard error in a reason
LONGEST_ERRORS = 10_000  # bytes of it that are looked at
T = TypeVar("T")


@dataclass(frozen=True)
class Program:
    """A command as a function of parameters and times; the same numbers for the same arguments, wherever it runs.

    ``words``: program and arguments, in which ``{input}``, ``{output}`` and ``{NAME}`` of a parameter are filled in; a
    single one where a shell runs it. The first of the templates is ``{input}``.
    """

    words: tuple[str, ...]
    settings: CommandSettings

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
        inputs = {
            name: entry.scale * parameters[name] + entry.offset for name, entry in self.settings.parameters.items()
        }
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
                values = within_limit(lambda: {n: read(output, folder, times, limit) for n, output in outputs})
                return {name: np.concatenate([values[name], more[name]]) for name in values}
        except OSError as error:
            raise ProgramError(f"{error.filename or 'scratch folder'}: {error.strerror}") from None
        except (TimeLimitError, subprocess.TimeoutExpired):
            raise ProgramError(f"not done after {self.settings.time_limit:g} s") from None

    def _fill(self, folder: Path, parameters: Mapping[str, float], times: Array) -> None:
        for file in self.settings.files:
            shutil.copy(file, folder)
        for name, template in self.settings.templates.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(filled(template, parameters, times), encoding="utf-8", newline="")

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
                lines = said.read().decode("utf-8", "replace").strip().splitlines()
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
        parameters = [
            Parameter(name, entry.unit, bounds=(entry.lower, entry.upper), label=entry.label)
            for name, entry in settings.parameters.items()
        ]
        units = {name: entry.unit for name, entry in settings.outputs.items()}
        super().__init__(Program(words, settings), parameters, units, settings.time_unit)

    @classmethod
    def from_settings(cls, settings: CommandSettings) -> CommandModel:
        """Raises :class:`~en4dvar.plumbing.user_code.RefusedError` where the program may not be run."""
        return cls(settings)
