"""Records of long benchmarks, one JSON line an experiment, so that a run can be cut into pieces and continued."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

Record = dict[str, Any]


def load(path: Path) -> dict[str, Record]:
    """Records by their key; empty where there is no file."""
    lines = path.read_text().splitlines() if path.is_file() else []
    return {record["key"]: record for record in map(json.loads, lines)}


def fill(path: Path, keys: Iterable[str], run: Callable[[str], Record], minutes: float) -> dict[str, Record]:
    """Run the experiments whose record is missing, for at most so many minutes; all records of ``keys`` there are."""
    wanted, done, end = list(keys), load(path), time.monotonic() + 60 * minutes
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        for key in wanted:
            if key in done:
                continue
            if time.monotonic() > end:
                break
            done[key] = {"key": key, **run(key)}
            file.write(json.dumps(done[key], default=_plain) + "\n")
            file.flush()
    return {key: done[key] for key in wanted if key in done}


def _plain(value: Any) -> Any:
    """Arrays and numpy scalars as JSON has them."""
    return np.asarray(value).tolist()
