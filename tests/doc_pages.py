"""Reading and running the examples of a documentation page.

A page is one folder and one session, from top to bottom; ``configs`` and ``benchmarks`` of the clone are in it:

- a ``python`` or ``yaml`` block whose first line is a comment with a file name (``# case.yaml``) is that file; a Python
  file is run at once;
- lines of a ``console`` block after ``$`` and of an ``sh`` block are commands; what a ``console`` block shows below a
  command must be its output, where ``…`` stands for anything;
- a ``yaml`` block without a file name completes the quick start: it is merged into it, section by section, and loaded
  (with a ``model`` it brings its own ``parameters``);
- ``text`` and ``bibtex`` blocks are read by people only.

An HTML comment just above a block says otherwise: ``<!-- not run: reason -->`` (its commands are still parsed by the
real command line, its files and options must exist), ``<!-- tested by tests/… -->``, or ``<!-- needs: ../shared/… -->``
(run where this file lies beside the repository, skipped by name elsewhere).
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]


def hook(name: str) -> ModuleType:
    """A module of ``docs/hooks``."""
    spec = spec_from_file_location(name, ROOT / "docs" / "hooks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
_BLOCK = re.compile(r"^(?:<!-- (?P<mark>[^\n]*?) -->\n+)?```(?P<language>\w*)[^\n]*\n(?P<body>.*?)^```$", re.M | re.S)
_FILE = re.compile(r"# ([\w./-]+\.(?:py|yaml))\b")


@dataclass(frozen=True)
class Block:
    """A fenced block: ``mark`` is the comment above it, ``line`` where it starts."""

    language: str
    body: str
    mark: str
    line: int

    @property
    def file(self) -> str | None:
        """The name of the file that the block is."""
        named = _FILE.match(self.body) if self.language in ("python", "yaml") else None
        return named[1] if named else None

    @property
    def not_run(self) -> str | None:
        """Why the block is not run, if it is not."""
        return self.mark.partition("not run:")[2].strip() or None

    @property
    def missing(self) -> str | None:
        """The file outside the repository that the block needs, if it is not there."""
        needed = self.mark.partition("needs:")[2].strip()
        return needed if needed and not (ROOT / needed).exists() else None

    @property
    def tested_by(self) -> str | None:
        """The test that runs it instead."""
        return self.mark.partition("tested by")[2].strip() or None


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(m["language"], m["body"], m["mark"] or "", text.count("\n", 0, m.start("language")) + 1)
        for m in _BLOCK.finditer(text)
    ]


def commands(block: Block) -> list[tuple[str, str]]:
    """Commands of an ``sh`` or ``console`` block, each with the output that the page shows for it."""
    lines = block.body.replace("\\\n", " ").splitlines()
    if block.language == "sh":
        return [(line, "") for line in lines if line.strip() and not line.startswith("#")]
    found: list[tuple[str, str]] = []
    for line in lines:
        if line.startswith("$ "):
            found.append((line[2:], ""))
        else:
            command, shown = found[-1]
            found[-1] = (command, f"{shown}{line}\n")
    return found


def command_lines(page: Path) -> Iterator[tuple[int, str]]:
    """Every command that calls this project on a page: in fenced and indented blocks and between backquotes."""
    text = page.read_text(encoding="utf-8")
    for number, line in enumerate(text.replace("\\\n", "  ").splitlines(), 1):
        for piece in [*re.findall(r"`([^`]+)`", line), re.sub(r"^(?:    )?(?:\$ )?", "", line)]:
            command = re.sub(r"\s{2,}#.*|\s+[|>] .*| && .*", "", piece).strip()
            if re.match(r"(?:en4dvar [a-z]|python \w+/\w+\.py)", command):
                yield number, command


def command_words(command: str) -> list[str]:
    """A command as words, without what the shell does with its output."""
    return shlex.split(re.split(r"\s[|>]\s|\s{2,}#", command.replace("\\\n", " "))[0])


class Session:
    """A folder in which the blocks of one page are run."""

    def __init__(self, folder: Path, quick_start: Path):
        self.folder, self.quick_start = folder / "clone", quick_start
        self.folder.mkdir()
        for name in ("configs", "benchmarks"):
            (self.folder / name).symlink_to(ROOT / name)
        (folder / "shared").symlink_to(ROOT.parent / "shared")
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        self.environment = {**os.environ, "PATH": path, "MPLBACKEND": "Agg", "NO_COLOR": "1", "COLUMNS": "100"}

    def run(self, block: Block) -> None:
        """Do what the block says. Raises AssertionError with what went wrong."""
        if block.file:
            (self.folder / block.file).write_text(block.body, encoding="utf-8")
            if block.language == "python":
                self.call(f"python {block.file}")
        elif block.language == "python":
            self.call(f"python -c {shlex.quote(block.body)}")
        elif block.language == "yaml":
            self.load(block)
        else:
            for command, shown in commands(block):
                printed = self.call(command)
                assert not shown or matches(shown, printed), f"{command} printed\n{printed}\nnot\n{shown}"

    def call(self, command: str) -> str:
        """Standard output of a command; it must succeed. An exported variable stays for those that follow."""
        if exported := re.match(r"export (\w+)=(\S+)", command):
            self.environment[exported[1]] = exported[2]
            return ""
        done = subprocess.run(
            ["bash", "-c", f"set -o pipefail; {command}"],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{command}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def load(self, block: Block) -> None:
        """The quick start with the sections of the block in place of its own."""
        from en4dvar.config import load_config

        config, change = (yaml.safe_load(text) for text in (self.quick_start.read_text(encoding="utf-8"), block.body))
        if "model" in change:  # another model has other parameters
            del config["parameters"]
        config["data"]["path"] = str(self.quick_start.parent / config["data"]["path"])
        path = self.folder / f"completed_{block.line}.yaml"
        path.write_text(yaml.safe_dump(merged(config, change)), encoding="utf-8")
        load_config(path)


def merged(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Sections of ``change`` laid over those of ``base``, key by key; below that, values replace values."""
    return base | {
        key: base[key] | value if isinstance(value, dict) and isinstance(base.get(key), dict) else value
        for key, value in change.items()
    }


def matches(shown: str, printed: str) -> bool:
    """Whether the output is what the page shows; ``…`` stands for anything."""
    pattern = ".*".join(re.escape(part) for part in shown.rstrip().split("…"))
    return re.fullmatch(pattern, printed.rstrip(), re.S) is not None
