"""``en4dvar schema``: accepts what loads, refuses what does not, and has a word for every key."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from jsonschema import Draft202012Validator
from toy_config import YAML

from en4dvar.cli import main
from en4dvar.config.document import parse_document, read_document

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))
QUICKSTART = (ROOT / "configs" / "quickstart.yaml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    outcome = CliRunner().invoke(main, ["schema"])
    assert outcome.exit_code == 0, outcome.output
    schema = json.loads(outcome.stdout)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_shipped_configurations_are_valid(validator: Draft202012Validator, path: Path) -> None:
    faults = [f"{list(e.absolute_path)}: {e.message}" for e in validator.iter_errors(read_document(path).data)]
    assert faults == []


def test_shipped_configurations_name_the_schema_that_lies_beside_them() -> None:
    outcome = CliRunner().invoke(main, ["schema"])
    text = (ROOT / "configs" / "en4dvar.schema.json").read_text(encoding="utf-8")
    assert text == outcome.stdout, "run: en4dvar schema --out configs/en4dvar.schema.json"
    for path in CONFIGS:
        first, _ = path.read_text(encoding="utf-8").split("\n", 1)
        assert first == "# yaml-language-server: $schema=en4dvar.schema.json", path


@pytest.mark.parametrize(
    "given",
    ["  driving: none\n", "  driving: {amplitude: -20 MPa}\n", "  driving: {kind: gaussian, amplitude: 1 MPa, "
     "delay: 2 us, width: 1 us}\n", "  constants: imr-v2\n", "  constants: {set: imr-v1, rho: 1.06 g/cm^3}\n",
     "  vapour_pressure: saturated\n", "  vapour_pressure: 2.3 kPa\n", "  law: ./my_law.py:MyLaw\n"],
)  # fmt: skip
def test_every_way_to_write_a_setting(validator: Draft202012Validator, given: str) -> None:
    text = QUICKSTART.replace("  law: quadratic-kelvin-voigt\n", given)
    assert text != QUICKSTART
    assert list(validator.iter_errors(parse_document(text).data)) == []


def test_a_model_of_ones_own(validator: Draft202012Validator) -> None:
    assert list(validator.iter_errors(parse_document(YAML).data)) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [("seed: 1", "sede: 1"), ("seed: 1", "seed: one"), ("name: bubble", "name: bubbel"), ("gas: heat", "gas: hot"),
     ("unit: us", "units: us"), (", unit: us", ""), ("prior: lognormal", "prior: log"), ("members: 48", "members: 2"),
     ("scheme: en4dvar", "scheme: en3dvar"), ("radius_std", "radius_sdt"), ("median: 0.5 kPa", "medain: 0.5 kPa"),
     ("gas: heat", "constants: {rho: 998}"), ("gas: heat", "driving: {kind: sine}"), ("model:", "modle:")],
)  # fmt: skip
def test_a_mistake_is_seen(validator: Draft202012Validator, old: str, new: str) -> None:
    assert old in QUICKSTART
    assert list(validator.iter_errors(parse_document(QUICKSTART.replace(old, new, 1)).data))


def keys(node: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every key that a file may have, with its schema."""
    if isinstance(node, list):
        for item in node:
            yield from keys(item, path)
    elif isinstance(node, dict):
        for name, child in node.get("properties", {}).items():
            yield f"{path}.{name}", child
        for part, child in node.items():
            if part != "if":  # conditions are not keys of the file
                yield from keys(child, f"{path}.{part}")


def test_every_key_has_a_description(validator: Draft202012Validator) -> None:
    found = {
        path: "description" in child
        for name, definition in validator.schema["$defs"].items()
        for path, child in keys(definition, name)
        if set(child) != {"$ref"}  # parameters of a model, described where the reference leads
    }
    assert len(found) > 150
    assert [path for path, described in found.items() if not described] == []
    assert found["model_bubble.properties.constants.anyOf.rho"]  # a section is walked through, not passed over


def test_it_is_written_to_a_file(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(main, ["schema", "--out", str(tmp_path / "s.json")])
    assert outcome.output == f"schema: {tmp_path / 's.json'}\n"
    assert json.loads((tmp_path / "s.json").read_text(encoding="utf-8"))["title"] == "en4dvar configuration"
