"""A pack in the hands of others: what is written by hand is read as a result or refused in words, and ends."""

import json
import zlib

import numpy as np
import pytest

from en4dvar.plumbing.errors import OutputError
from en4dvar.results.checkpoint import digest
from en4dvar.results.netcdf import Group, Variable
from en4dvar.results.pack import PACK, Pack, opened, packed, read_result, results_of, unpacked, unpacked_together
from en4dvar.results.store import load_stored


def line(*words):
    return sealed_line(json.dumps(words).encode())


def sealed_line(text):
    return b"\nen4dvar-pack 1 %08x %s\n" % (zlib.crc32(text), text)


@pytest.mark.parametrize(
    "words",
    [
        ("a", "f", 0, -300, "", ""),
        ("a", "f", -1, 0, "", ""),
        ("a", "f", "0", "5", "", ""),
        ("a", "f", 0, 5, ""),
        ("../a", "f", 0, 5, "", ""),
        ("", "f", 0, 5, "", ""),
        (7, "f", 0, 5, "", ""),
        ("a", "f", 0, 10**15, "", ""),
    ],
)
def test_a_forged_line_is_passed_over(tmp_path, words):
    pack = tmp_path / PACK
    pack.write_bytes(line(*words) + b"12345")
    Pack(pack).append("good", "f", b"", b"content", digest(b"content"))
    assert results_of(pack) == [pack / "good"]
    assert read_result(pack / "good") == b"content"


@pytest.mark.parametrize("text", [b"{nonsense", b"5", b"[]", b"[" * 3000, b"\xff"])
def test_a_forged_line_of_other_words_is_passed_over(tmp_path, text):
    (tmp_path / PACK).write_bytes(sealed_line(text))
    assert Pack(tmp_path / PACK).entries == {}


def test_the_last_record_of_a_name_counts(tmp_path):
    pack = Pack(tmp_path / PACK)
    for content in (b"first", b"second"):
        pack.append("a", "f", b"", content, digest(content))
    assert read_result(tmp_path / PACK / "a") == b"second"


def test_results_are_in_the_order_of_their_numbers(tmp_path):
    pack = Pack(tmp_path / PACK)
    for name in ("gel10", "gel2", "gel_b", "gel02"):
        pack.append(name, "f", b"", b"content", digest(b"content"))
    assert [address.name for address in results_of(tmp_path / PACK)] == ["gel02", "gel2", "gel10", "gel_b"]


@pytest.mark.parametrize("content", [b"", b"x" * 7, b"\xff" * 64, bytes(16) + b"[]"])
def test_a_good_checksum_makes_no_result(tmp_path, content):
    Pack(tmp_path / PACK).append("a", "f", b"", content, digest(content))
    with pytest.raises(OutputError, match=r"datasets\.pack/a: not a result of en4dvar"):
        load_stored(tmp_path / PACK / "a")


def test_dimensions_have_one_size(tmp_path):
    columns = {f"of {n}": Variable(("draw",), np.zeros(n), {}) for n in (3, 4)}
    content = packed({"/posterior": Group(columns)})
    Pack(tmp_path / PACK).append("a", "f", b"", content, digest(content))
    with pytest.raises(OutputError, match=r"datasets\.pack/a: not a result of en4dvar: of 3 has the shape \(3,\)"):
        load_stored(tmp_path / PACK / "a")


@pytest.mark.parametrize("beside", ["/observed_data", "/observation_errors"])
def test_a_name_is_that_of_a_variable_or_of_a_coordinate(tmp_path, beside):
    """Also together with the group beside it."""
    column = {"time": Variable(("time",), np.zeros(3), {})}
    content = {"/observed_data": Group(coords=column), "/observation_errors": Group()}
    content[beside] = Group(column, content[beside].coords)
    Pack(tmp_path / PACK).append("a", "f", b"", packed(content), digest(packed(content)))
    with pytest.raises(OutputError, match=r"datasets\.pack/a: not a result .*: time: both a variable and a coordinate"):
        load_stored(tmp_path / PACK / "a")


def groups(names, count, value):
    """Of parameters and ``count`` draws, with a scalar that tells them apart."""
    variables = {"x": Variable(("parameter", "draw"), np.full((len(names), count), value), {})}
    return {
        "/": Group(attrs={"of": value}),
        "/stats": Group(variables, {"parameter": Variable(("parameter",), names, {})}),
    }


def test_contents_are_read_together_as_each_by_itself():
    a, b = (np.array(names, dtype=object) for names in (["a", "b"], ["b", "a"]))
    given = [
        groups(names, count, value) for names, count, value in [(a, 3, 0.0), (a, 4, 1.0), (a, 3, 2.0), (b, 3, 3.0)]
    ]
    contents = list(map(packed, given))
    found = unpacked_together(list(map(opened, contents)), {"/stats"})
    assert [alike.places for alike in found] == [[0, 2], [1], [3]]
    for alike in found:
        for i, place in enumerate(alike.places):
            assert alike.attributes[i]["/"] == {"of": float(place)}
            for name, alone in unpacked(contents[place])["/stats"].every.items():
                together = alike.groups["/stats"].every[name]
                assert together.dims == alone.dims
                np.testing.assert_array_equal(together.values[i], alone.values)


@pytest.mark.parametrize("end", [-8, None])
def test_a_content_of_another_length_is_refused(end):
    content = packed(groups(np.array(["a"], dtype=object), 3, 1.0))
    with pytest.raises(ValueError, match="more or fewer values"):
        opened(content[:end] if end else content + bytes(8))
