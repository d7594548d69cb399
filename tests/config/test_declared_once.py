"""A key is declared once: a dataclass gives the section, its bounds and its words; every fault of a file is told."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import pytest
from annotated_types import Ge, Gt
from pydantic import ValidationError
from toy_config import write_toy

from en4dvar.config import load_config
from en4dvar.config.schema import Assimilation, section_of
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes import ON_A_WINDOW, keys_of
from en4dvar.schemes.settings import AssimilationSettings


@dataclass(frozen=True)
class Settings:
    size: Annotated[int, Ge(3), "How many."] = 5
    width: Annotated[float, Gt(0), "How wide."] = 0.5


def test_a_dataclass_gives_its_section() -> None:
    section = section_of(Settings)
    assert section().model_dump() == {"size": 5, "width": 0.5}
    assert section.model_json_schema()["properties"]["size"]["description"] == "How many."
    for wrong in ({"size": 2}, {"width": 0}, {"depth": 1}):
        with pytest.raises(ValidationError):
            section(**wrong)


def test_the_settings_of_the_scheme_are_a_plain_dataclass() -> None:
    assert Assimilation().settings == AssimilationSettings()
    assert replace(AssimilationSettings(), members=7).members == 7
    keys = Assimilation.model_json_schema()["properties"]
    words = [key.get("description") for name, key in keys.items() if name != "weights"]
    every = AssimilationSettings().keys.keys() | {key for kind in ON_A_WINDOW.values() for key in keys_of(kind)}
    assert keys.keys() == every | {"weights"}
    assert all(words)


def places(tmp_path: Path, *changes: tuple[str, str]) -> list[str]:
    with pytest.raises(ConfigError) as error:
        load_config(write_toy(tmp_path, *changes))
    return [fault.path for fault in error.value.problems]


def test_what_does_not_go_together_is_told_beside_what_is_wrong_in_itself(tmp_path: Path) -> None:
    error = "correlation_time: -3 s, robust: huber, threshold: x, time_std: 1 um"
    changes = ("position_std: 2 um", error), ("  k: {prior", "  q: 1\n  k: {prio"), ("c: 0.02", "d: 0.02")
    assert places(tmp_path, *changes) == [
        "data.error.position_std", "data.error.correlation_time", "data.error.robust", "data.error.threshold",
        "data.error.time_std", "parameters.q", "parameters.k.prior", "parameters.k.prio", "parameters.d",
    ]  # fmt: skip


def test_a_faulty_model_leaves_unread_only_what_depends_on_it(tmp_path: Path) -> None:
    data = ("unit: um", "unit: Pa"), ("position_std: 2 um", "position_std: 1 %")
    found = places(tmp_path, ("mass: 2 g", "law: cubik"), *data, ("c: 0.02 N s/m", "c: 1"))
    assert found == ["data.columns.position.unit", "data.error.position_std", "model.law"]
    found = places(tmp_path, ("toy_models:Oscillator", "buble"), *data, ("name: t_ms", "nam: t_ms"))
    assert found == ["data.columns.time.nam", "model.name"]
