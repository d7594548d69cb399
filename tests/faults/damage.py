"""Damage to files of every kind, by seed: to their bytes, or to what their format holds, and sealed again."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mat_damage import TAGS

from en4dvar.results.checkpoint import digest
from en4dvar.results.netcdf import FORMAT, seal_file

Rng = np.random.Generator
ODD_WORDS = (
    "", "0", "-1", "nan", "inf", "1e308", "-1e-320", "9" * 400, "\0", "\x1b[2J", "é", "💥", "a" * 5000, "!", "@", "#",
    "~", "*", "=", "(", "[a", "l1", "w", "!x!", "!dum!", "../x", "/dev/zero", "log", "fixed", "tied", "1d5", "& ",
    "* parameter data", "* observation data", "1:0", "[x]1:999999999", "(x)3:2", "l99999999999", "t0", "%",
    "{{ 1/0 }}", "{% for i in x %}",
)  # fmt: skip
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 5e-324, 1e-300, 2.0**63)
ODD_VALUES: tuple[Any, ...] = (
    *ODD_NUMBERS, "", "x", "$\\frac{$", "a" * 70_000, b"\xff\xfe", np.arange(3), np.zeros((2, 2)), np.int8(-1),
    "error: x: y", "\n\n", "{", "[1]", "1e999", "parsec", "../x", np.float32(1), True, 2**63 - 1,
)  # fmt: skip


def of_bytes(content: bytes, rng: Rng, first: int = 0) -> bytes:
    """One to three bits, bytes, numbers, cuts, repetitions or gaps behind ``first``."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        if len(changed) <= first + 8:
            break
        at = int(rng.integers(first, len(changed) - 8))
        match rng.integers(7):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                changed[at] = int(rng.integers(256))
            case 2:
                changed[at : at + 4] = struct.pack("<I", int(rng.choice(TAGS)))
            case 3:
                changed[at : at + 8] = struct.pack("<Q", int(rng.integers(1 << 63)) >> int(rng.integers(63)))
            case 4:
                del changed[at + 1 :]
            case 5:
                changed[at:at] = changed[at : at + int(rng.integers(1, 64))]
            case _:
                del changed[at : at + int(rng.integers(1, 64))]
    return bytes(changed)


def of_text(content: bytes, rng: Rng) -> bytes:
    """Words replaced, removed, repeated or swapped; lines as well; or bytes."""
    if rng.random() < 0.2:
        return of_bytes(content, rng)
    words = re.split(r"(\s+)", content.decode("utf-8", "surrogateescape"))
    for _ in range(rng.integers(1, 4)):
        at, other = (int(i) for i in rng.integers(len(words), size=2))
        match rng.integers(5):
            case 0 | 1:
                words[at] = ODD_WORDS[rng.integers(len(ODD_WORDS))]
            case 2:
                words[at], words[other] = words[other], words[at]
            case 3:
                words[at] = words[at] * 2
            case _:
                words[at] = ""
    return "".join(words).encode("utf-8", "surrogatepass")


def of_archive(content: bytes, rng: Rng) -> bytes:
    """A part of a zip file (a workbook) changed before it is packed; or bytes."""
    if rng.random() < 0.2:
        return of_bytes(content, rng)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = list(parts)[rng.integers(len(parts))]
    change = of_text if name.endswith((".xml", ".rels")) else of_bytes
    match rng.integers(6):
        case 0:
            del parts[name]
        case 1:
            parts[name] = parts[list(parts)[rng.integers(len(parts))]]
        case _:
            parts[name] = change(parts[name], rng)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, inside in parts.items():
            archive.writestr(part, inside)
    return packed.getvalue()


def resealed_checkpoint(path: Path, rng: Rng) -> None:
    """The text or the numbers of a checkpoint changed, its checksum made again."""
    head, _, payload = path.read_bytes().partition(b"\n")
    size = struct.calcsize("<cQ")
    end = size + struct.unpack_from("<cQ", payload)[1] if payload.startswith(b"A") else len(payload)
    parts = [payload[size:end], payload[end:]] if end < len(payload) else [payload, b""]
    match rng.integers(4):
        case 0 if parts[1]:
            parts[1] = of_bytes(parts[1], rng)
        case 1:
            parts[0] = of_bytes(parts[0], rng)
        case _:
            parts[0] = of_text(parts[0], rng)
    changed = struct.pack("<cQ", b"A", len(parts[0])) + b"".join(parts) if parts[1] else parts[0]
    words = head.decode().split(" ")
    path.write_bytes(" ".join([*words[:-1], digest(changed)]).encode() + b"\n" + changed)


def resealed_result(path: Path, rng: Rng) -> None:
    """The content of a result changed, as bytes or as HDF5, its last line made again."""
    content = path.read_bytes()
    content = content[: content.rindex(f"\n{FORMAT} ".encode())]
    if rng.random() < 0.3:
        path.write_bytes(of_bytes(content, rng))
    else:
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            for _ in range(rng.integers(1, 4)):
                of_hdf5(file, rng)
    seal_file(path)


def of_hdf5(file: h5py.File, rng: Rng) -> None:
    """A variable, a group or an attribute removed, renamed, swapped, or with other numbers, kind or size."""
    nodes: list[Any] = []
    file.visititems(lambda _, node: nodes.append(node))
    node = nodes[rng.integers(len(nodes))]
    with suppress(Exception):  # what this library refuses is no damage
        _CHANGES[rng.integers(len(_CHANGES))](file, node, nodes, rng)


def _remove(file: h5py.File, node: Any, _: Any, __: Rng) -> None:
    del file[node.name]


def _rename(file: h5py.File, node: Any, _: Any, rng: Rng) -> None:
    file.move(node.name, node.name + str(rng.choice(["x", "_std", "$", "é"])))


def _swap(file: h5py.File, node: Any, nodes: list[Any], rng: Rng) -> None:
    other = nodes[rng.integers(len(nodes))]
    name, source = node.name, other.name
    file.copy(source, file, name="/_en4dvar_swap")
    del file[name]
    file.move("/_en4dvar_swap", name)


def _attribute(file: h5py.File, node: Any, nodes: list[Any], rng: Rng) -> None:
    holder = [file, node][rng.integers(2)]
    names = [name for name in holder.attrs if not name.startswith("_") and name.isidentifier()] or ["x"]
    name = names[rng.integers(len(names))]
    if rng.random() < 0.3:
        del holder.attrs[name]
    else:
        holder.attrs[name] = ODD_VALUES[rng.integers(len(ODD_VALUES))]


def _values(file: h5py.File, node: Any, _: Any, rng: Rng) -> None:
    if not isinstance(node, h5py.Dataset):
        return
    if node.dtype.kind == "O":
        node[...] = ODD_WORDS[rng.integers(len(ODD_WORDS))]
        return
    odd = ODD_NUMBERS[rng.integers(len(ODD_NUMBERS))]
    values = np.array(node[...])
    with np.errstate(all="ignore"):
        if values.ndim and rng.random() < 0.5:
            values.reshape(-1)[rng.integers(max(1, values.size))] = np.array(odd).astype(values.dtype)
        else:
            values[...] = np.array(odd).astype(values.dtype)
    node[...] = values


def _kind(file: h5py.File, node: Any, _: Any, rng: Rng) -> None:
    """Of other size or kind, with the attributes as they were (but those of dimensions, which are references)."""
    shape = getattr(node, "shape", ()) or ()
    attrs = {k: v for k, v in node.attrs.items() if not k.startswith(("_", "DIM", "REF", "CLASS", "NAME"))}
    kinds: list[Any] = ["f8", "f4", "i1", "u8", h5py.string_dtype(), "S3", "c16", np.dtype([("a", "f8")]), "f2"]
    shapes = [shape, shape[1:], (*shape, 2), (0,), tuple(n + 1 for n in shape), (), (1, 3)]
    kind, name = kinds[rng.integers(len(kinds))], node.name
    shape = shapes[rng.integers(len(shapes))]
    del file[name]
    made = file.create_group(name) if rng.random() < 0.1 else file.create_dataset(name, shape, kind)
    made.attrs.update(attrs)


def _elsewhere(file: h5py.File, node: Any, nodes: list[Any], rng: Rng) -> None:
    """A link instead: to itself, to another, to nothing."""
    name = node.name
    target = [name, nodes[rng.integers(len(nodes))].name, "/nowhere", "/"][rng.integers(4)]
    del file[name]
    file[name] = h5py.SoftLink(target)


_CHANGES: tuple[Callable[[h5py.File, Any, list[Any], Rng], None], ...] = (
    _remove, _rename, _swap, _attribute, _attribute, _values, _values, _kind, _kind, _elsewhere,
)  # fmt: skip
