"""Names and words for what files hold that nothing has damaged."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from mat_damage import RADIUS, seeds
from scipy.io import loadmat, savemat

from en4dvar.inputs.matfile import mat_variables

KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "c16", "?", ">f8")
VALUES = st.sampled_from(KINDS).flatmap(
    lambda kind: arrays.arrays(kind, arrays.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=5))
)
WORDS = {"V": "a struct", "O": "a cell array", "U": "text", "c": "complex"}


def assert_same(path: Path) -> None:
    """Every variable is what scipy says: a vector with these numbers, or the same words."""
    expected = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    found = mat_variables(path)
    vectors, scalars, others = found.vectors, found.scalars, found.others
    outermost = {re.split(r"[.({]", name)[0] for name in vectors.keys() | others.keys()}
    assert outermost == expected.keys()
    for name, value in expected.items():
        if hasattr(value, "toarray"):
            assert others[name] == "a sparse matrix"
        elif value.dtype.kind in WORDS:
            assert others[name] == WORDS[value.dtype.kind]
        elif value.size == max(value.shape):
            assert np.array_equal(vectors[name], value.ravel().astype(float), equal_nan=True)
            if value.size == 1 and np.isfinite(value.flat[0]):
                assert scalars[name] == float(value.flat[0])
        else:
            assert others[name] == f"an array of {' x '.join(map(str, value.shape))}"
            if value.ndim == 2:
                assert np.array_equal(found.matrices[name], value.astype(float), equal_nan=True)


def bubbles(count: int) -> np.ndarray:
    """A struct array as laboratories keep them: one bubble an element."""
    found = np.empty(count, dtype=[(name, object) for name in ("t", "Roft", "Req", "note")])
    for k in range(count):
        found[k] = (np.arange(5.0), 9.0 - np.arange(5) + k, 2.0 + k, "by hand")
    return found


@pytest.mark.parametrize("compressed", [False, True])
def test_what_is_in_structs_and_cells_has_matlabs_name(tmp_path, compressed):
    cells = np.empty(2, dtype=object)
    cells[:] = [np.arange(3.0), np.arange(4.0)]
    content = {"expts": bubbles(3), "film": {"R": np.arange(4.0), "lens": {"size": 1.5}}, "C": cells}
    savemat(tmp_path / "a.mat", content, do_compression=compressed)
    found = mat_variables(tmp_path / "a.mat")
    vectors, scalars, others = found.vectors, found.scalars, found.others
    for k in range(3):
        assert vectors[f"expts({k + 1}).Roft"].tolist() == (9.0 - np.arange(5) + k).tolist()
        assert scalars[f"expts({k + 1}).Req"] == 2.0 + k
        assert others[f"expts({k + 1}).note"] == "text"
    assert vectors["film.R"].tolist() == [0, 1, 2, 3]
    assert scalars["film.lens.size"] == 1.5
    assert [vectors[f"C{{{k}}}"].size for k in (1, 2)] == [3, 4]
    assert others["expts"] == "a struct"


@given(st.dictionaries(st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,20}", fullmatch=True), VALUES, max_size=4), st.booleans())
@settings(max_examples=60, deadline=None, database=None, suppress_health_check=list(HealthCheck))
def test_any_arrays(tmp_path, content, compressed):
    savemat(tmp_path / "a.mat", content, do_compression=compressed)
    assert_same(tmp_path / "a.mat")


@pytest.mark.parametrize("number", range(17))
def test_every_kind_of_variable_in_both_byte_orders(tmp_path, number):
    (tmp_path / "a.mat").write_bytes(seeds()[number])
    assert_same(tmp_path / "a.mat")
    found = mat_variables(tmp_path / "a.mat")
    vectors, scalars = found.vectors, found.scalars
    assert len(vectors["R"]) == len(RADIUS)
    assert "dt" in scalars


def element(kind: int, content: bytes = b"") -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def variable(kind: int, name: bytes, count: int, *content: bytes) -> bytes:
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack("<ii", 1, count)) + element(1, name)
    return element(14, head + b"".join(content))


def table(name: bytes) -> bytes:
    head = element(6, struct.pack("<II", 17, 0)) + element(1, name) + element(1, b"MCOS") + element(1, b"table")
    return element(14, head + variable(13, b"", 1, element(6, struct.pack("<I", 7))))


def test_what_scipy_does_not_write(tmp_path):
    """Tables, text of two bytes a letter that is no UTF-8, and an element of a cell array that never had a value."""
    cells = (variable(6, b"", 2, element(9, struct.pack("<dd", 1, 2))), variable(4, b"", 2, element(4, b"\xb5\0m\0")))
    content = variable(1, b"C", 3, *cells, element(14)) + table(b"T") + table(b"notes")
    (tmp_path / "a.mat").write_bytes(seeds()[0] + content)
    found = mat_variables(tmp_path / "a.mat")
    assert found.vectors.keys() == {"R", "dt", "C{1}"}
    assert found.others == {"C": "a cell array", "C{2}": "text", "T": "an object", "notes": "an object"}
