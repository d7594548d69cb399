"""A key of a scheme that has the name of something else in the section is refused, not mistaken for it."""

import warnings
from pathlib import Path

import pytest
from toy_config import YAML, write_toy

from en4dvar.config.load import load_config
from en4dvar.config.schema import Assimilation, keys_of_schemes
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes import ON_A_WINDOW

SCHEME = """
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge
from en4dvar.schemes import ETKF

@dataclass(frozen=True)
class Patient(ETKF):
    {key}: Annotated[int, Ge(0), "How long it waits."] = 3
"""
pytestmark = pytest.mark.usefixtures("schemes_as_before")
TAKEN = "part own settings copy json dict schema validate kinds rules unread as_written model_fields members weights _x"


def given(folder: Path, key: str) -> Path:
    (folder / "patient.py").write_text(SCHEME.format(key=key), encoding="utf-8")
    change = (YAML[YAML.index("assimilation:") :], f"assimilation:\n  scheme: ./patient.py:Patient\n  {key}: 4\n")
    return write_toy(folder, change)


@pytest.mark.parametrize("key", TAKEN.split())
def test_a_name_that_is_taken_is_refused(key, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ConfigError, match=f"assimilation.scheme: '{key}' cannot be the name of a key") as told:
            load_config(given(tmp_path, key))
    assert len(told.value.problems) == 1


def test_other_names_are_not(tmp_path):
    assert load_config(given(tmp_path, "patience")).assimilation.own.patience == 4


def test_of_a_scheme_of_another_package_nothing_is_said_until_it_is_used(tmp_path, monkeypatch):
    """Nor does its key replace what the section of all schemes has of that name."""
    kinds = dict(ON_A_WINDOW)
    given(tmp_path, "copy")
    namespace = {}
    exec((tmp_path / "patient.py").read_text(encoding="utf-8"), namespace)
    kinds["patient"] = namespace["Patient"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        section = keys_of_schemes(kinds)
    assert "copy" not in section.model_fields
    monkeypatch.setitem(Assimilation.kinds, "patient", namespace["Patient"])
    with pytest.raises(ValueError, match="'copy' cannot be the name of a key"):
        Assimilation.model_validate({"scheme": "patient"})
