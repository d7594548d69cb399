"""Damaged ``.mat`` files, read in a process of their own: a reader that trusts a size in them takes its process down.

``python tests/mat_damage.py FOLDER FIRST COUNT SEED`` reads inputs FIRST to FIRST + COUNT; :func:`survive` counts.
"""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

RADIUS = 1e-4 * np.linspace(1, 0.3, 9)
TAGS = (0, 1, 2, 5, 6, 9, 14, 15, 0x10001, 0x7FFFFFFF, 0x80000000, 0xFFFFFFF0, 0xFFFFFFFF)


@cache
def seeds() -> tuple[bytes, ...]:
    """Valid files of every kind of variable, plain and compressed; the last is big-endian."""
    from scipy.io import savemat
    from scipy.sparse import csc_array

    contents = (
        {"R": RADIUS, "dt": 1e-6},
        {"R": RADIUS, "dt": 1e-6, "image": np.arange(12.0).reshape(3, 4)},
        {"R": RADIUS, "dt": 1e-6, "film": {"rate": 2e5, "lens": "10x", "frames": np.arange(5)}},
        {"R": RADIUS, "dt": 1e-6, "cells": np.array([np.ones(3), "text", np.zeros((2, 2))], dtype=object)},
        {"R": RADIUS, "dt": 1e-6, "note": "by hand", "lines": np.array(["ab", "cd"])},
        {"R": RADIUS, "dt": 1e-6, "links": csc_array(np.eye(4))},
        {"R": np.arange(9, dtype=np.int16), "dt": np.uint8(1), "long": np.arange(4), "on": np.array([True, False])},
        {"R": np.arange(9, dtype=np.float32), "dt": 1e-6, "z": 1j * np.ones(3)},
    )
    files = []
    for compressed in (False, True):
        for content in contents:
            file = io.BytesIO()
            savemat(file, content, do_compression=compressed)
            files.append(file.getvalue())
    return (*files, big_endian({"R": RADIUS, "dt": np.array([1e-6])}))


def big_endian(vectors: dict[str, np.ndarray]) -> bytes:
    """A file as a big-endian machine writes it; names have at most four letters and go into small elements."""
    content = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    for name, values in vectors.items():
        body = struct.pack(">IIII", 6, 8, 6, 0) + struct.pack(">IIii", 5, 8, 1, len(values))
        body += struct.pack(">HH", len(name), 1) + name.encode().ljust(4, b"\0")
        body += struct.pack(">II", 9, 8 * len(values)) + values.astype(">f8").tobytes()
        content += struct.pack(">II", 14, len(body)) + body
    return content


def damaged(index: int, seed: int) -> bytes:
    """Input ``index``: one or two bits, bytes, tags, cuts or repetitions in one of the valid files."""
    rng = np.random.default_rng([seed, index])
    content = bytearray(seeds()[index % len(seeds())])
    for _ in range(rng.integers(1, 3)):
        at = int(rng.integers(120, max(122, len(content) - 1)))
        if at >= len(content):
            break
        match rng.integers(5):
            case 0:
                content[at] ^= 1 << int(rng.integers(8))
            case 1:
                content[at] = int(rng.integers(256))
            case 2:
                tag = int(rng.choice(TAGS)) if rng.integers(2) else int(rng.integers(1 << 32))
                content[at & ~3 : (at & ~3) + 4] = struct.pack("<I", tag)
            case 3:
                del content[at + 1 :]
            case _:
                content[at:at] = content[at : at + int(rng.integers(1, 64))]
    return bytes(content)


def survive(folder: Path, count: int, seed: int, first: int = 0) -> Counter[str]:
    """How many of ``count`` inputs were ``read``, ``refused``, or were ``crashes``, after which it goes on."""
    found: Counter[str] = Counter(read=0, refused=0, crashes=0)
    end = first + count
    while first < end:
        words = [sys.executable, __file__, folder, first, end - first, seed]
        done = subprocess.run([str(word) for word in words], check=False, stderr=subprocess.PIPE, text=True)
        if done.returncode > 0:  # not a crash but an exception, a finding of its own
            raise AssertionError(done.stderr[-3000:])
        told = json.loads((folder / "at.json").read_text())
        found.update(told["found"])
        first = told["index"] + 1
        if done.returncode:
            found["crashes"] += 1
            (folder / "case.mat").rename(folder / f"crash{found['crashes']}.mat")
    return found


def main() -> None:
    from en4dvar.inputs.parts import Column, TimeStep
    from en4dvar.inputs.readers import read_series
    from en4dvar.plumbing.errors import DataError

    folder, (first, count, seed) = Path(sys.argv[1]), map(int, sys.argv[2:])
    found = Counter[str]()
    for index in range(first, first + count):
        (folder / "case.mat").write_bytes(damaged(index, seed))
        (folder / "at.json").write_text(json.dumps({"index": index, "found": found}))
        try:
            read_series(folder / "case.mat", TimeStep(Column("dt", "s", "s")), Column("R", "m", "m"))
            found["read"] += 1
        except DataError:
            found["refused"] += 1
    (folder / "at.json").write_text(json.dumps({"index": first + count - 1, "found": found}))


if __name__ == "__main__":
    main()
