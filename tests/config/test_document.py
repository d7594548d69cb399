"""YAML: PyYAML's traps are closed and every fault has a place."""

from pathlib import Path

import pytest

from en4dvar.config.document import override, parse_document, read_document, yaml_text
from en4dvar.plumbing.errors import ConfigError


def test_scalars_of_the_core_schema() -> None:
    text = "a: 1e-6\nb: no\nc: off\nd: true\ne: 012\nf: 2024-01-01\ng: '3'\nh:\ni: 12:30\nj: .5\n"
    text += "k: +7\nl: 1_000\nm: -.inf\n"
    assert parse_document(text).data == {
        "a": 1e-6, "b": "no", "c": "off", "d": True, "e": 12, "f": "2024-01-01", "g": "3", "h": None, "i": "12:30",
        "j": 0.5, "k": 7, "l": "1_000", "m": -float("inf"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: 1\nb:\n  c: 2\n  c: 3\n", "f.yaml:4:3: b: duplicate key 'c', first given on line 3"),
        ("a: &x 1\nb: *x\n", "f.yaml:2:4: aliases are not used here"),
        ('a: 1\nb: "x\\0y"\n', "f.yaml:2:4: a null byte"),
        ('a: 1\n"x\\0y": 2\n', "f.yaml:2:1: a null byte"),
        (
            "a: !!python/object/apply:os.system ['true']\n",
            "f.yaml:1:4: tag 'tag:yaml.org,2002:python/object/apply:os.system'",
        ),
        ("a: [1\nb: 2\n", "f.yaml:2:2: not valid YAML: "),
        ("\tb: 2\n", "f.yaml:1:1: not valid YAML: found character '\\t'"),
        ("a: 1\n---\nb: 2\n", "f.yaml:2:1: not valid YAML: but found another document"),
        ("[a]: 1\n", "f.yaml:1:1: a key must be a word"),
        ("a: \x01\n", "f.yaml: not valid YAML: unacceptable character"),
        ("", "f.yaml: the file is empty"),
        ("just words\n", "f.yaml: expected 'key: value' lines"),
        ("a: " + "[" * 3000 + "]" * 3000, "f.yaml: not valid YAML: nested too deeply"),
    ],
)
def test_refused(text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_document(text, "f.yaml")
    assert str(error.value).startswith(fault)


def test_all_duplicates_at_once() -> None:
    with pytest.raises(ConfigError) as error:
        parse_document("a: 1\na: 2\nb: 1\nb: 2\n", "f.yaml")
    assert [f.line for f in error.value.problems] == [2, 4]


def test_faults_fall_back_to_the_nearest_ancestor() -> None:
    document = parse_document("a:\n  b: 1\n", "f.yaml")
    assert str(document.fault(("a", "b"), "bad")) == "f.yaml:2:6: a.b: bad"
    assert str(document.fault(("a", "b"), "bad", at_key=True)) == "f.yaml:2:3: a.b: bad"
    assert str(document.fault(("a", "z"), "missing")) == "f.yaml:1:1: a.z: missing"


def test_override_leaves_the_document_and_names_its_origin() -> None:
    document = parse_document("a: {b: 1}\n", "f.yaml")
    changed = override(document, {"a.b": "1e-3 m", "c.d": "[1, 2]", "e": 5})
    assert changed.data == {"a": {"b": "1e-3 m"}, "c": {"d": [1, 2]}, "e": 5}
    assert document.data == {"a": {"b": 1}}
    assert str(changed.fault(("a", "b"), "bad")) == "--set a.b: bad"
    for bad in ("a.b.c", "a..c", ""):
        with pytest.raises(ConfigError, match="--set"):
            override(document, {bad: 1})


def test_what_is_written_is_read_as_it_was() -> None:
    """A resolved file that held the name of a column, 08, unquoted could be read no more."""
    texts = ["08", "1e5", "1E-5", "+.5", "1e500", "007", "5", "1.5", "2026-01-01", "no", "null", "", ".inf", "08 gel"]
    data = {"texts": texts, "numbers": [1e5, 1e-5, 1e22, -3, 10**20, 0.1], "1e5": True, "08": None}
    assert parse_document(yaml_text(data)).data == data
    assert "- 08 gel\n" in yaml_text(data)


def test_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "quickstart.yaml").write_text("a: 1\n")
    with pytest.raises(ConfigError, match=r"no such file; the folder holds quickstart\.yaml"):
        read_document(tmp_path / "quikstart.yaml")
    with pytest.raises(ConfigError, match=r"a folder, not a configuration; it holds quickstart\.yaml"):
        read_document(tmp_path)
    (tmp_path / "data").mkdir()
    with pytest.raises(ConfigError, match="a folder, not a configuration; 'en4dvar init --data"):
        read_document(tmp_path / "data")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xb5m\n")
    with pytest.raises(ConfigError, match="not UTF-8"):
        read_document(tmp_path / "latin.yaml")


def test_what_stands_in_an_option_is_not_looked_for_in_the_file():
    """A section that an option replaces has no lines any more; its fault is that of a value set inside."""
    document = parse_document("a: {b: {c: 1}, d: 2}\n", "f.yaml")
    assert str(override(document, {"a.b": {"c": 3}}).fault(("a", "b", "c"), "bad")) == "--set a.b: a.b.c: bad"
    assert str(override(document, {"a.b.c": 3}).fault(("a", "b"), "bad")) == "--set a.b.c: a.b: bad"
    assert str(override(document, {"a.b.c": 3}).fault(("a", "d"), "bad")) == "f.yaml:1:19: a.d: bad"
