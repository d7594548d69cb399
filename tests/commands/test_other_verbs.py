"""Each command, given a file or a folder that is for another one, says in one line which one that is."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from init_files import call, write

CONFIGS = Path(__file__).parents[2] / "configs"
OTHERS = {  # file → the words that say which command it is for, and the commands that can do nothing with it
    "linear_design": ("'en4dvar design'", "run", "validate", "calibrate", "sweep", "sweep-twin", "study"),
    "lorenz96_etkf": ("'en4dvar run' and 'en4dvar sweep-twin'", "simulate", "calibrate", "design", "sweep", "study"),
    "bubble_sequence": ("for 'en4dvar run'", "simulate", "calibrate", "design", "sweep", "sweep-twin", "study"),
    "agarose_twin": (
        "for 'en4dvar simulate'",
        "run",
        "validate",
        "calibrate",
        "design",
        "sweep",
        "sweep-twin",
        "study",
    ),
    "agarose_study": ("for 'en4dvar study'", "run", "validate", "simulate", "calibrate", "design", "sweep-twin"),
    "quickstart": ("for 'en4dvar run'", "sweep-twin", "study"),
}
WITH = {"sweep-twin": ("--vary", "assimilation.members=[20]"), "calibrate": ("--sets", "2")}


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("name", "command"), [(name, command) for name, (_, *commands) in OTHERS.items() for command in commands]
)
def test_a_file_for_another_command(name: str, command: str) -> None:
    result = call(command, CONFIGS / f"{name}.yaml", *WITH.get(command, ()))
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 2
    assert OTHERS[name][0] in line


def test_simulate_of_a_plan_asks_for_its_instants() -> None:
    result = call("simulate", CONFIGS / "linear_design.yaml")
    assert "no such file" in result.stderr
    assert "--times FROM:TO:STEP" in result.stderr
    assert call("simulate", CONFIGS / "linear_design.yaml", "--times", "0:4:1").exit_code == 0


@pytest.mark.parametrize("command", ["report", "rerun", "export", "joint", "population --of G", "compare"])
def test_a_configuration_in_place_of_a_run(tmp_path: Path, command: str) -> None:
    name, *more = command.split()
    path, other = CONFIGS / "quickstart.yaml", tmp_path / "other.yaml"
    other.write_text("")
    result = call(name, path, *([other] if name == "compare" else more))
    assert result.exit_code == 2
    assert f"'en4dvar run {path}' makes one" in result.stderr


def test_a_run_in_place_of_a_configuration(tmp_path: Path) -> None:
    for name in ("config.yaml", "config.resolved.yaml", "posterior.nc"):
        (tmp_path / name).write_text("")
    result = call("run", tmp_path)
    assert result.exit_code == 2
    assert "a folder, not a configuration; it holds config.resolved.yaml, config.yaml" in result.stderr


@pytest.mark.usefixtures("own_folder")
def test_readings_are_not_replaced_by_what_is_proposed_for_them(tmp_path: Path) -> None:
    data = write(tmp_path / "b.csv", "t_us,R_um")
    held = data.read_bytes()
    config = tmp_path / "b.yaml"
    config.write_text(
        (CONFIGS / "quickstart.yaml").read_text(encoding="utf-8").replace("data/agarose_synthetic.csv", "b.csv")
    )
    for words in (("init", "--data", data), ("init", "--data", "."), ("init", "--data", "*.csv"), ("simulate", config)):
        done = call(*words, "--out", "b.csv", "--force")
        assert done.stderr == "b.csv: is what the command reads, and is not replaced; give another name\n"
        assert (done.exit_code, data.read_bytes()) == (2, held)


def test_a_folder_that_others_may_not_look_into(monkeypatch: pytest.MonkeyPatch) -> None:
    def looked(self: Path, **how: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "is_dir", looked)
    done = call("init", "--data", "private/b.csv")
    assert done.exit_code == 2
    assert done.stderr.endswith("private/b.csv: Permission denied\n")


@pytest.mark.usefixtures("own_folder")
def test_a_fault_in_the_value_of_an_option_is_told_of_the_option() -> None:
    told = call("run", CONFIGS / "quickstart.yaml", "--scheduler", "foo").stderr
    assert told == "--scheduler: expected an address such as tcp://10.0.0.1:8786, not 'foo'\n"
    told = call("run", CONFIGS / "quickstart.yaml", "--set", "name=-x").stderr
    assert told == "--set name: expected letters, digits, blanks and . + - _, a letter or digit first, not '-x'\n"
