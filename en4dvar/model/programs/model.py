"""The forward model of ``model: {command: "./solver {input} {output}", …}``."""

from __future__ import annotations

import shutil
from pathlib import Path

from en4dvar.model.function_model import FunctionModel
from en4dvar.model.programs.process import Program
from en4dvar.model.programs.settings import CommandSettings, split
from en4dvar.model.state import Parameter
from en4dvar.plumbing.user_code import Code, require_permission


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
