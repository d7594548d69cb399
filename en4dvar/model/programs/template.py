"""Parameters into the input files of a program.

A template is the input file with ``{{ name }}`` where a parameter belongs (Jinja's language, in its sandbox); one whose
first line is ``ptf`` and a sign is in PEST's language. Numbers are written with all their digits.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from jinja2 import StrictUndefined, TemplateError
from jinja2.meta import find_undeclared_variables
from jinja2.sandbox import ImmutableSandboxedEnvironment

from en4dvar.model.programs import pest
from en4dvar.model.programs.pest import ProgramError
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import retold
from en4dvar.plumbing.files import in_bytes, read_text
from en4dvar.plumbing.hints import suggest

TIMES = "times"
LONGEST = 256_000_000  # characters of an input file
SUFFIXES = (".j2", ".tpl", ".template")
_ENVIRONMENT = ImmutableSandboxedEnvironment(undefined=StrictUndefined, keep_trailing_newline=True)


def input_name(template: Path) -> str:
    """The name of the file that a template becomes: without the suffix that says it is one."""
    return template.stem if template.suffix in SUFFIXES else template.name


def check_template(template: Path, names: Collection[str]) -> None:
    """Raise ValueError, in words, where a template cannot be read or names an unknown parameter."""
    text = text_of(template)
    if pest.is_template(text):
        names = {pest.identifier(name) for name in names}
        with retold(ProgramError, ValueError, f"{template}: "):
            wanted: Collection[str] = pest.parameters_of(text)
    else:
        try:
            wanted = find_undeclared_variables(_ENVIRONMENT.parse(text))
        except TemplateError as error:
            line = getattr(error, "lineno", None)
            raise ValueError(f"{template}{f':{line}' if line else ''}: {error}") from None
    for name in sorted(wanted):
        if name not in names and name != TIMES:
            raise ValueError(f"{template}: {name!r} is no parameter of the model{suggest(name, names)}")


def filled(template: Path, parameters: Mapping[str, float], times: Array) -> str:
    """The input file of a member; ``times`` (K,) are where it is observed. Raises :class:`ProgramError`."""
    text = text_of(template)
    if pest.is_template(text):
        return pest.filled(text, parameters)
    values: dict[str, Any] = {name: float(value) for name, value in parameters.items()}
    parts, left = list[str](), LONGEST
    for part in _compiled(text).generate(values | {TIMES: times.tolist()}):
        parts.append(part)
        if (left := left - len(part)) < 0:
            raise ProgramError(f"{template.name}: makes an input file of more than {in_bytes(LONGEST)}")
    return "".join(parts)


@functools.cache
def text_of(file: Path) -> str:
    """A template or instructions, read once in a process. Raises ValueError."""
    with retold(OSError, ValueError, f"{file}: "):
        return read_text(file)


_compiled = functools.cache(_ENVIRONMENT.from_string)
