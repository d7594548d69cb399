"""One run of a program: a scratch directory of its own, its input files, the process, what it leaves."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from en4dvar.programs.errors import ProgramError
from en4dvar.programs.outputs import ProgramOutput
from en4dvar.programs.template import filled
from en4dvar.state import Array

OUTPUT = "output"  # the file that {output} names
STDOUT = "stdout"  # what the program prints, as a file
LAST_WORDS = 300  # characters of the standard error in a reason


@dataclass(frozen=True)
class Program:
    """A command as a function of parameters and times; the same numbers for the same arguments, wherever it runs.

    ``words``: program and arguments, in which ``{input}``, ``{output}`` and ``{NAME}`` of a parameter are filled in; a
    single one with ``shell``, which then runs it. ``templates``: input file → template, the first is ``{input}``.
    ``files`` are copied into the scratch directory, whose parent is ``scratch``. It runs again ``retries`` times where
    it fails.
    """

    words: tuple[str, ...]
    templates: Mapping[str, Path]
    outputs: Mapping[str, ProgramOutput]
    files: tuple[Path, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    time_limit: float | None = None
    retries: int = 0
    shell: bool = False
    scratch: Path | None = None

    def __call__(self, parameters: Mapping[str, float], times: Array) -> dict[str, Array]:
        """Observable → values (K,). Raises :class:`ProgramError`: the last attempt failed, with its reason."""
        for attempt in range(self.retries + 1):
            try:
                return self._attempt(parameters, times)
            except ProgramError:
                if attempt == self.retries:
                    raise
        raise AssertionError

    def _attempt(self, parameters: Mapping[str, float], times: Array) -> dict[str, Array]:
        folder = Path(tempfile.mkdtemp(prefix="en4dvar-", dir=self.scratch))
        try:
            for file in self.files:
                shutil.copy(file, folder)
            for name, template in self.templates.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_text(filled(template, parameters, times), encoding="utf-8")
            self._run(folder, parameters)
            return {name: output.read(folder, times) for name, output in self.outputs.items()}
        except OSError as error:
            raise ProgramError(f"{error.filename or folder}: {error.strerror}") from None
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _run(self, folder: Path, parameters: Mapping[str, float]) -> None:
        values = {name: repr(float(value)) for name, value in parameters.items()}
        values |= {"input": next(iter(self.templates), ""), "output": OUTPUT}
        words = [fill(word, values) for word in self.words]
        with (folder / STDOUT).open("wb") as printed:
            process = subprocess.Popen(
                ["/bin/sh", "-c", *words] if self.shell else words,
                cwd=folder,
                env={**os.environ, **self.environment},
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
            try:
                _, errors = process.communicate(timeout=self.time_limit)
            except subprocess.TimeoutExpired:
                raise ProgramError(f"not done after {self.time_limit:g} s") from None
            finally:
                _end(process)
        if process.returncode:
            raise ProgramError(_why(process.returncode, errors))


def fill(word: str, values: Mapping[str, str]) -> str:
    """A word of a command with ``{name}`` replaced by what is known; other braces stay."""
    for name, value in values.items():
        word = word.replace(f"{{{name}}}", value)
    return word


def split(command: str, shell: bool) -> tuple[str, ...]:
    """The words of a command. Raises ValueError where quotes are left open or there is none."""
    words = (command,) if shell else tuple(shlex.split(command))
    if not words or not words[0].strip():
        raise ValueError("write the program and its arguments")
    return words


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program that is still at work, with the processes it has started."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.stderr is not None:
        process.stderr.close()


def _why(status: int, errors: bytes) -> str:
    lines = [line.strip() for line in errors.decode("utf-8", "replace").splitlines() if line.strip()]
    said = f": {lines[-1][-LAST_WORDS:]}" if lines else ""
    if status < 0:
        try:
            name = signal.Signals(-status).name
        except ValueError:
            name = str(-status)
        return f"the program was ended by signal {name}{said}"
    return f"the program ended with exit status {status}{said}"
