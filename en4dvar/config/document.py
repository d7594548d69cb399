"""YAML with a memory of where everything stood, and without PyYAML's traps.

Scalars follow YAML 1.2's core schema: only ``true``/``false`` are booleans (``no`` and ``off`` are text), ``1e-6`` is a
number, dates are text. Duplicate keys, aliases and tags are refused: a configuration is plain data.
"""

import copy
import math
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import yaml

from en4dvar.inputs.formats import SUFFIXES
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, retold
from en4dvar.plumbing.files import open_plain
from en4dvar.plumbing.hints import brief, listed, shown
from en4dvar.plumbing.units import UnitError

Key = tuple[str | int, ...]
Mark = tuple[int, int]  # line and column, from 1
Source = str | Path | Mapping[str, Any]  # of a configuration

LONGEST = 1_000_000  # bytes of a file, some ten seconds to read: the paths of 10 000 data sets and more

OPTIONS = {"data.path": "--data", "execution.address": "--scheduler"}  # keys that a command has an option for
NOT_UTF8 = "a byte that is not UTF-8, in the name of a file or folder perhaps, which then needs another one"
NULL = "a null byte, which no name, word or number holds"
_INT = re.compile(r"[-+]?\d{1,40}")
_FLOAT = re.compile(r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d{1,3})?\Z")
_WORDS = {
    ".inf": math.inf, "-.inf": -math.inf, "true": True, "True": True, "false": False, "False": False,
    "null": None, "~": None, "": None,
}  # fmt: skip


@dataclass(frozen=True)
class Document:
    """Plain data read from ``file``, with the position of each key and value, and the verbatim ``text``."""

    data: dict[str, Any]
    file: str = ""
    text: str = ""
    keys: dict[Key, Mark] = field(default_factory=dict)
    values: dict[Key, Mark] = field(default_factory=dict)
    origins: Mapping[Key, str] = field(default_factory=dict)  # what an override came from, instead of the file

    def fault(self, path: Sequence[str | int], message: str, *, at_key: bool = False) -> Fault:
        """A fault at ``path``, or at its nearest ancestor that is written in the file."""
        dotted, message = brief(_dotted(path), 200), brief(message)
        below = [origin for key, origin in self.origins.items() if path and key[: len(path)] == tuple(path)]
        if below and (len(path) > 1 or tuple(path) not in self.keys):  # of what an option has set inside
            return Fault(message, dotted, below[0])
        for n in range(len(path), -1, -1):
            key = tuple(path[:n])
            if key in self.origins:
                return Fault(message, dotted, self.origins[key])
            marks = self.keys if key and (at_key or n < len(path)) else self.values
            if key in marks:
                return Fault(message, dotted, self.file, *marks[key])
        return Fault(message, dotted, self.file)

    def placed(self, error: ConfigError, *above: str | int) -> list[Fault]:
        """The faults of an error, each at its path in this file, below ``above``."""
        paths = [((*above, *(f.path.split(".") if f.path else ())), f) for f in error.problems]
        return [self.fault(path, f.message) if path else f for path, f in paths]

    @contextmanager
    def placing(self, *above: str | int) -> Iterator[None]:
        """Within, the faults of a :class:`ConfigError` are :meth:`placed`."""
        try:
            yield
        except ConfigError as error:
            raise ConfigError(self.placed(error, *above)) from None

    @contextmanager
    def collecting(self, faults: list[Fault], *above: str | int) -> Iterator[None]:
        """Within, the faults of an error of settings, units or data are :meth:`placed` among ``faults``."""
        try:
            yield
        except ConfigError as error:
            faults += self.placed(error, *above)
        except (DataError, UnitError) as error:
            faults.append(self.fault(above, str(error)))

    def has(self, path: Sequence[str | int]) -> bool:
        """True if the data contains ``path``."""
        node: Any = self.data
        for part in path:
            try:
                node = node[part]
            except (KeyError, IndexError, TypeError):
                return False
        return True


def read_document(path: Path) -> Document:
    """Read and parse a YAML file. Raises :class:`ConfigError` listing every fault found."""
    if os.path.isdir(path):
        raise ConfigError(_propose("a folder", path))
    with retold(OSError, ConfigError, f"{path}: "), open_plain(path) as file:
        content = file.read(LONGEST + 1)
    try:
        if len(content) > LONGEST:
            words = f"longer than {LONGEST / 1e6:g} MB, which no configuration is; numbers belong into data files"
            raise ConfigError([Fault(words, file=str(path))])
        text = content.decode("utf-8-sig")
        return parse_document(text, str(path))
    except UnicodeDecodeError as error:
        fault = ConfigError([Fault(f"not UTF-8 text ({error.reason} at byte {error.start})", file=str(path))])
    except ConfigError as error:
        fault = error
    if path.suffix.lower() in SUFFIXES:
        raise ConfigError(_propose("a data file", path)) from None
    raise fault from None


def document_of(content: Mapping[Any, Any]) -> Document:
    """Plain data of Python as if it had been read from a file.

    Numbers of numpy become numbers, arrays, tuples and sets lists, paths text. Raises :class:`ConfigError`: every value
    that a YAML file could not hold.
    """
    document, faults = Document({}), list[Fault]()
    data = _plain(content, (), document, faults)
    if faults:
        raise ConfigError(faults)
    return replace(document, data=data, text=yaml_text(data))


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Compiled where PyYAML has it; quotes what :func:`_scalar` reads as a number and PyYAML as text: 08, 1e5."""


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("+-.0123456789"))


def yaml_text(data: Any) -> str:
    """Plain data as YAML, in its own order."""
    with retold(UnicodeEncodeError, ConfigError, f"{NOT_UTF8}: "):
        return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120))


def _plain(value: Any, path: Key, document: Document, faults: list[Fault]) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item, (*path, str(key)), document, faults) for key, item in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if callable(tolist := getattr(value, "tolist", None)):  # numpy's, and what wraps it
        value = tolist()
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item, (*path, i), document, faults) for i, item in enumerate(value)]
    known = value is None or type(value) in (bool, int, float, str)
    if known and not (isinstance(value, str) and "\0" in value):
        return value
    what = NULL if known else f"{shown(value)} is neither number, text, list nor dict"
    faults.append(Fault(what, _dotted(path), document.file))
    return None


def parse_document(text: str, file: str = "") -> Document:
    """Parse YAML text whose top level is a mapping. Raises :class:`ConfigError`."""
    document, faults = Document({}, file, text), list[Fault]()
    data = _read(document, faults)
    if not faults and not isinstance(data, dict):
        what = "the file is empty" if data is None else "expected 'key: value' lines at the top level"
        faults.append(Fault(what, file=file))
    if faults:
        raise ConfigError(faults)
    return replace(document, data=data)


def document_from(source: Source, overrides: Mapping[str, Any] | None = None) -> tuple[Document, Path]:
    """A YAML file, or a dict of the same, with overrides, and the folder where its relative paths start: the file's, or
    this one. Raises :class:`ConfigError`.
    """
    if isinstance(source, Mapping):
        return override(document_of(source), overrides or {}), Path.cwd()
    return override(read_document(Path(source)), overrides or {}), Path(source).resolve().parent


def override(
    document: Document, overrides: Mapping[str, Any], option: str = "--set", places: Mapping[str, str] | None = None
) -> Document:
    """Set values at dotted paths; text is YAML. Raises :class:`ConfigError`, naming the ``option`` they came by, or the
    place of this one among ``places``.
    """
    data = copy.deepcopy(document.data)
    origins = dict(document.origins)
    faults: list[Fault] = []
    for dotted, value in overrides.items():
        own = OPTIONS.get(dotted) if option == "--set" else None
        path, origin = tuple(dotted.split(".")), (places or {}).get(dotted, own or f"{option} {dotted}")
        if isinstance(value, str):
            value = _read(Document({}, origin, value), faults)
        node = data
        for n, part in enumerate(path[:-1], 1):
            node = node.setdefault(part, {})
            if not isinstance(node, dict):
                single = f"{'.'.join(path[:n])!r} is a single value; nothing can be set inside it"
                faults.append(Fault(single, file=origin))
                break
        else:
            if not all(path):
                faults.append(Fault("expected key=value with a dotted key such as assimilation.members", file=origin))
            node[path[-1]] = value
            origins[path] = origin
    if faults:
        raise ConfigError(faults)
    kept = [
        {key: mark for key, mark in marks.items() if not any(key[: len(path)] == path for path in origins)}
        for marks in (document.keys, document.values)
    ]
    return replace(document, data=data, origins=origins, keys=kept[0], values=kept[1])


def _propose(what: str, path: Path) -> str:
    shell_path = shlex.quote(str(path))
    proposal = f"'en4dvar init --data {shell_path}' looks at the readings and proposes one"
    held = sorted(file.name for file in path.glob("*.yaml"))  # as the directory of a run does
    return f"{path}: {what}, not a configuration; {f'it holds {listed(held, 5)}' if held else proposal}"


class _Refused(Exception):
    """Valid YAML that a configuration does not use: a message and a mark."""


class _Loader(yaml.SafeLoader):
    """Composes the node graph; scalars are resolved by :func:`_scalar`."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = cast(Any, self).peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise _Refused("aliases are not used here; repeat the value", event.start_mark)
        if getattr(event, "tag", None) is not None:
            raise _Refused(f"tag {shown(event.tag)}: tags are not used here", event.start_mark)
        if "\0" in getattr(event, "value", ""):
            raise _Refused(NULL, event.start_mark)
        return super().compose_node(parent, index)


def _read(document: Document, faults: list[Fault]) -> Any:
    """The data of a document's text, or None; its places and what is wrong with it are added."""

    def refuse(message: str, line: int = 0, column: int = 0) -> None:
        faults.append(Fault(message, "", document.file, line, column))

    try:
        node = yaml.compose(document.text, _Loader)
        return None if node is None else _value(node, (), document, faults)
    except _Refused as error:
        message, at = error.args
        refuse(message, at.line + 1, at.column + 1)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = (mark.line + 1, mark.column + 1) if mark else ()
        words = f"not valid YAML: {error.problem or error.context}"
        if "escape character" in words or "escape sequence" in words:
            words += "; in double quotes a backslash stands for another sign: use single quotes, or / in paths"
        refuse(words, *where)
    except yaml.YAMLError as error:
        words = str(error).splitlines()[0]
        refuse(f"{NOT_UTF8 if '#xdc' in words else 'not valid YAML'}: {words}")
    except RecursionError:
        refuse("not valid YAML: nested too deeply")
    return None


def _value(node: yaml.Node, path: Key, document: Document, faults: list[Fault]) -> Any:
    document.values[path] = _mark(node)
    if isinstance(node, yaml.SequenceNode):
        return [_value(child, (*path, i), document, faults) for i, child in enumerate(node.value)]
    if not isinstance(node, yaml.MappingNode):
        return _scalar(node)
    result: dict[str, Any] = {}
    for key, child in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _Refused("a key must be a word", key.start_mark)
        name = str(key.value)
        here = (*path, name)
        if name in result:
            message = f"duplicate key {shown(name)}, first given on line {document.keys[here][0]}"
            faults.append(Fault(message, _dotted(path), document.file, *_mark(key)))
            continue
        document.keys[here] = _mark(key)
        result[name] = _value(child, here, document, faults)
    return result


def _scalar(node: Any) -> Any:
    text = node.value
    if node.style is not None:  # quoted or block: always text
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


def _mark(node: yaml.Node) -> Mark:
    return node.start_mark.line + 1, node.start_mark.column + 1


def _dotted(path: Sequence[str | int]) -> str:
    return ".".join(str(part) for part in path)
