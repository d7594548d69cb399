"""A control file of PEST or PEST++ (``.pst``) as the arguments of :func:`en4dvar.estimate`.

Priors are those of PEST++'s ensemble smoother: ``parval1`` in the middle, and bounds four standard deviations apart,
of the logarithm where ``partrans`` is ``log``. The std of an observation is 1/weight; those of weight 0 are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.errors import ConfigError
from en4dvar.programs import pest

RANGE = 4.0  # standard deviations between the bounds: PEST++ (White et al. 2020), option par_sigma_range
OBSERVED = "observations"


def from_pest(path: str | Path, files: Sequence[str] = ()) -> dict[str, Any]:
    """``model``, ``data``, ``priors`` and ``error`` of a control file, for ``en4dvar.estimate(**from_pest(path))``.

    Observations count as readings 1, 2, 3, … in the order of the control file. ``files``, beside the control file, are
    copied into each scratch directory: whatever the model needs besides its templates.

    Raises
    ------
    ConfigError: it cannot be read (with the line), or asks for what is not known here: tied parameters, prior
        information, several instruction files.
    """
    path = Path(path).absolute()
    sections = _sections(path)
    parameters = [(n, w) for n, w in sections["parameter data"] if len(w) >= 7]
    observed = [(n, w) for n, w in sections["observation data"] if float(_field(path, n, w, 2)) > 0]
    pairs = [words for _, words in sections["model input/output"]]
    readers = [words for words in pairs if pest.is_instructions(_text(path.parent / words[0]))]
    if len(readers) != 1:
        raise ConfigError(f"{path}: {len(readers)} instruction files; one is read")
    instructions, output = readers[0]
    command = " ".join(sections["model command line"][0][1])
    return {
        "model": {
            "command": command,
            "shell": True,
            "parameters": {words[0].lower(): {} for _, words in parameters},
            "templates": {words[1]: str(path.parent / words[0]) for words in pairs if words not in readers},
            "files": [str(path.parent / file) for file in files],
            "outputs": {
                OBSERVED: {
                    "file": output,
                    "instructions": str(path.parent / instructions),
                    OBSERVED: [words[0].lower() for _, words in observed],
                }
            },
            "time_unit": "1",
        },
        "data": {
            "time": np.arange(1.0, len(observed) + 1),
            OBSERVED: np.array([float(_field(path, n, words, 1)) for n, words in observed]),
        },
        "priors": {words[0].lower(): _prior(path, number, words) for number, words in parameters},
        "error": 1 / np.array([float(_field(path, n, words, 2)) for n, words in observed]),
    }


def _prior(path: Path, number: int, words: list[str]) -> Any:
    kind = words[1].lower()
    value, low, high = (float(_field(path, number, words, i)) for i in (3, 4, 5))
    if kind == "fixed":
        return value
    if kind == "log":
        return {"prior": "lognormal", "median": value, "log_std": math.log(high / low) / RANGE}
    if kind == "none":
        return {"prior": "normal", "mean": value, "std": (high - low) / RANGE}
    raise ConfigError(f"{path}:{number}: parameter {words[0]} is {kind}; log, none and fixed are known")


def _field(path: Path, number: int, words: list[str], i: int) -> str:
    try:
        float(words[i])
    except (IndexError, ValueError):
        given = words[i] if i < len(words) else "nothing"
        raise ConfigError(f"{path}:{number}: {given!r} where {words[0]} has a number") from None
    return words[i]


def _sections(path: Path) -> dict[str, list[tuple[int, list[str]]]]:
    """Name of a section → its lines, numbered and as words."""
    lines = _text(path).splitlines()
    if not lines or not re.match(r"pcf\b", lines[0].strip(), re.IGNORECASE):
        raise ConfigError(f"{path}: the first line of a control file is pcf")
    found: dict[str, list[tuple[int, list[str]]]] = {}
    current: list[tuple[int, list[str]]] = []
    for number, line in enumerate(lines[1:], 2):
        if line.startswith("*"):
            current = found.setdefault(line[1:].strip().lower(), [])
        elif line.strip() and not line.startswith(("#", "++")):
            current.append((number, line.split()))
    if found.get("prior information"):
        raise ConfigError(f"{path}:{found['prior information'][0][0]}: prior information is not read")
    for name in ("parameter data", "observation data", "model command line", "model input/output"):
        if not found.get(name):
            raise ConfigError(f"{path}: no section '* {name}'")
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {getattr(error, 'strerror', None) or 'is not UTF-8 text'}") from None
