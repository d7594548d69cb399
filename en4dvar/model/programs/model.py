"""The forward model of ``model: {command: "./solver {input} {output}", …}``."""

from __future__ import annotations

import shutil
from pathlib import Path

from en4dvar.model.function_model import FunctionModel
from en4dvar.model.programs.process import Adjusted, Program
from en4dvar.model.programs.settings import CommandSettings, split
from en4dvar.model.state import Parameter
from en4dvar.plumbing.user_code import Code, require_permission


class CommandModel(FunctionModel):
    """An external program: parameters go into files or arguments, observables come out of files."""

    Settings = CommandSettings

    def __init__(self, settings: CommandSettings):
        words = split(settings.command, settings.shell)
        program = "/bin/sh" if settings.shell else shutil.which(words[0]) or words[0]
        require_permission(Code(f"model command {settings.command!r}", (Path(program),)))
        run = Program(words, settings)
        parameters = [
            Parameter(name, entry.unit, bounds=(entry.lower, entry.upper), label=entry.label)
            for name, entry in settings.parameters.items()
        ]
        scaled = {n: (p.scale, p.offset) for n, p in settings.parameters.items() if (p.scale, p.offset) != (1, 0)}
        combinations = {name: entry.combinations for name, entry in settings.outputs.items() if entry.combinations}
        function = Adjusted(run, scaled, combinations) if scaled or combinations else run
        super().__init__(
            function, parameters, {name: entry.unit for name, entry in settings.outputs.items()}, settings.time_unit
        )

    @classmethod
    def from_settings(cls, settings: CommandSettings) -> CommandModel:
        """Raises :class:`~en4dvar.plumbing.user_code.RefusedError` where the program may not be run."""
        return cls(settings)

    @property
    def threaded(self) -> bool:
        """A thread that waits for a program leaves the interpreter to others."""
        return True
