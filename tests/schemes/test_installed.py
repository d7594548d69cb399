"""A scheme of another package: used by its name, with its keys; one that fails to load is told to who asks for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from toy_config import write_toy

import en4dvar
from en4dvar.plumbing.errors import ConfigError

TESTS = Path(__file__).resolve().parents[1]
SCHEME = """
from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Ge
from en4dvar.schemes import ESMDA

@dataclass(frozen=True)
class Patient(ESMDA):
    words: ClassVar[str] = "ES-MDA, and patient"
    patience: Annotated[int, Ge(0), "How long it waits."] = 3
"""
RUN_AND_VALIDATE = """
import sys
from click.testing import CliRunner
from en4dvar.cli import main
called = [["run", "own.yaml"], *(["validate", path] for path in sys.argv[1:])]
told = [CliRunner().invoke(main, words) for words in called]
print(*(f"{done.exit_code} {done.stderr}" for done in told), sep="---\\n")
"""
FIRST_AND_FORKED = """
import os, patient, en4dvar
if os.fork():
    assert os.wait()[1] == 0
    en4dvar.validate("own.yaml")
else:
    print(en4dvar.AssimilationSettings("patient", patience=5).patience)
"""


@pytest.fixture
def package(tmp_path):
    """The environment of a process that finds the package ``patient`` installed."""
    (tmp_path / "patient.py").write_text(SCHEME)
    named = {"patient": "patient:Patient", "etkf": "patient:Patient", "lost": "nowhere:Lost", "number": "math:pi"}
    declared = {"patient": {**named, "twice": "patient:Patient"}, "again": {"twice": "patient:Other"}}
    for name, entries in declared.items():
        about = tmp_path / f"{name}-1.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        lines = "".join(f"{key} = {value}\n" for key, value in entries.items())
        (about / "entry_points.txt").write_text(f"[en4dvar.schemes]\n{lines}")
    config = yaml.safe_load(write_toy(tmp_path).read_text(encoding="utf-8"))
    config["output"] = {"report": False}
    config["assimilation"] = {"scheme": "patient", "patience": 4, "members": 16, "what_if": False}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(config))
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(TESTS), os.environ.get("PYTHONPATH", "")])}


def called(*words, environment, folder):
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )


def test_it_runs_by_its_name_and_its_keys_are_checked(package, tmp_path):
    """Those that cannot be loaded are told where they are asked for, and nowhere else."""
    text = (tmp_path / "own.yaml").read_text()
    (tmp_path / "negative.yaml").write_text(text.replace("patience: 4", "patience: -1"))
    (tmp_path / "other.yaml").write_text(text.replace("scheme: patient", "scheme: etkf"))
    for name, scheme in {"lost": "lost", "number": "number", "twice": "twice", "module": "patient:Patient"}.items():
        (tmp_path / f"{name}.yaml").write_text(text.replace("scheme: patient", f"scheme: {scheme}"))
    asked = [f"{name}.yaml" for name in ("negative", "other", "lost", "number", "twice", "module")]
    done = called("-c", RUN_AND_VALIDATE, *asked, environment=package, folder=tmp_path)
    run, negative, other, lost, number, twice, module = done.stdout.split("---\n")
    assert run.startswith("0 "), run
    assert "cannot be loaded" not in run
    assert "not a subclass" not in run
    resolved = yaml.safe_load((tmp_path / "runs" / "toy" / "config.resolved.yaml").read_text())
    assert resolved["assimilation"]["scheme"] == "patient"
    assert resolved["assimilation"]["patience"] == 4
    assert "assimilation.scheme: scheme 'lost' (nowhere:Lost) cannot be loaded: No module named 'nowhere'" in lost
    assert "assimilation.scheme: 'number' is not a subclass of en4dvar.schemes.Scheme" in number
    assert "assimilation.scheme: 'patient:Patient' is no scheme; one of your own is named as ./file.py:Class" in module
    assert "'twice' is declared in en4dvar.schemes by again (patient:Other) and patient (patient:Patient);" in twice
    assert negative.startswith("2 ")
    assert "assimilation.patience" in negative
    assert "scheme etkf does not read it; it is a key of patient" in other  # not replaced


@pytest.mark.parametrize("first", ["en4dvar.schemes.base", "en4dvar.AssimilationSettings"])
def test_a_script_may_import_the_package_first(first, package, tmp_path):
    """Which imports from ours, while it is not yet there itself; a new process for each of the two that follow it."""
    module, _, name = first.rpartition(".")
    (tmp_path / "patient.py").write_text(f"from {module} import {name}\n{SCHEME}")
    done = called("-c", FIRST_AND_FORKED, environment=package, folder=tmp_path)
    assert (done.stdout, done.returncode) == ("5\n", 0), done.stderr
    assert "'patient'" not in done.stderr


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("return None", "scheme Bad: advance gives None; it gives a Step or a GaussNewtonStep"),
        (
            "return Step(weights, weights.w)",
            "scheme Bad: advance gives weights (16,), transform (16, 16) and norm (16,); they are",
        ),
        ("return weights.w + 'x'", "scheme Bad: advance raises UFuncTypeError: "),
        ("return weights.width", "AttributeError: 'Weights' object has no attribute 'width' ({0}:7)"),
    ],
)
def test_a_scheme_that_gives_no_step_is_named(package, tmp_path, line, words):
    file = tmp_path / "bad.py"
    begin = "from en4dvar.schemes import ETKF\nfrom en4dvar.schemes.base import Step\nclass Bad(ETKF):\n"
    head = "    words = 'bad'\n\n    def advance(self, weights, evaluation, iteration, draw):\n        "
    file.write_text(f"{begin}{head}{line}\n")
    config = yaml.safe_load((tmp_path / "own.yaml").read_text())
    config["assimilation"] = {"scheme": f"{file}:Bad", "members": 16, "what_if": False}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError) as caught:
        en4dvar.run(tmp_path / "own.yaml", overrides={"output.directory": str(tmp_path / "runs")})
    assert words.format(file) in str(caught.value)


@pytest.mark.slow
def test_a_file_serves_as_well(package, tmp_path):
    """``scheme: ./file.py:Class``, of the data of one set, in other processes, and of a series."""

    found = {**os.environ, "PYTHONPATH": package["PYTHONPATH"].partition(os.pathsep)[2]}  # the scheme in the file alone

    def cli(*words):
        return called("-m", "en4dvar.cli", *words, environment=found, folder=tmp_path)

    own = (tmp_path / "own.yaml").read_text().replace("scheme: patient", "scheme: ./patient.py:Patient")
    for old, new, words in (
        ("patience: 4", "patience: -1", "assimilation.patience: should be greater than or equal to 0"),
        ("patience: 4", "patienc: 4", "unknown key 'patienc'; did you mean 'patience'?"),
        (":Patient", ":Patien", "no class 'Patien'; did you mean 'Patient'?"),
        (":Patient", ":Ge", "is not a subclass of en4dvar.schemes.Scheme"),
    ):
        (tmp_path / "file.yaml").write_text(own.replace(old, new))
        refused = cli("validate", "file.yaml")
        assert refused.returncode == 2
        assert words in refused.stderr
    (tmp_path / "file.yaml").write_text(own)
    workers = ["--set", "execution.executor=processes", "--set", "execution.workers=2", "--out", "out"]
    for verb in (["calibrate", "file.yaml", "--sets", "2", *workers], ["run", "file.yaml"]):
        done = cli(*verb)
        assert done.returncode == 0, done.stderr
        assert "no posterior" not in done.stderr
    resolved = yaml.safe_load((tmp_path / "runs" / "toy" / "config.resolved.yaml").read_text())
    assert resolved["assimilation"]["scheme"] == f"{tmp_path / 'patient.py'}:Patient"
    assert resolved["assimilation"]["patience"] == 4
    (tmp_path / "slow.py").write_text("from en4dvar.schemes import ETKF\nclass Slow(ETKF):\n    words = 'slow'\n")
    errors, spread = {f"{name}_std": 1.0 for name in "xyz"}, dict.fromkeys("xyz", 1.0)
    twin = {"error": errors, "initial_std": spread, "interval": 0.1, "cycles": 20, "burn_in": 5}
    config = {"name": "twin", "model": {"name": "lorenz63"}, "twin": twin}
    config["assimilation"] = {"scheme": "./slow.py:Slow", "members": 8}
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(config))
    done = cli("run", "twin.yaml")
    assert done.returncode == 0, done.stderr
