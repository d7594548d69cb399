"""``en4dvar init``: what it is asked and given, files, folders and tables; units are never guessed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from init_files import UNITS, call, proposed, simulate, write

from en4dvar.config import load_config
from en4dvar.config.build import build
from en4dvar.config.document import parse_document
from en4dvar_bubble import commands_init
from en4dvar_bubble.starter.page import quoted

pytestmark = pytest.mark.usefixtures("own_folder")


def test_without_units_and_terminal_one_error_says_what_to_add(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"))
    assert done.exit_code == 2
    fault = done.stderr.splitlines()[-1]
    assert "columns with numbers: t_us, R_um; units are never guessed" in fault
    assert "add --time-unit UNIT (e.g. us), --radius-unit UNIT (e.g. um)" in fault
    done = call("init", "--data", write(tmp_path / "b.csv", "a,b"), "--time-unit", "us")
    needed = "add --time-column NAME, --radius-column NAME, --radius-unit UNIT (e.g. um)"
    assert needed in done.stderr
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--time-unit", "us", "--radius-unit", "Pa"), "unit 'Pa' cannot be converted to 'm'"),
        (("--time-unit", "usec", "--radius-unit", "um"), "did you mean 'us'"),
        ((*UNITS, "--radius-column", "x"), "no column 'x'; the columns are: t_us, R_um"),
        ((*UNITS, "--law", "newtonain"), "did you mean 'newtonian'"),
        ((*UNITS, "--out", "nowhere/b.yaml"), "nowhere/b.yaml: the folder nowhere does not exist"),
    ],
)
def test_wrong_options(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), *options)
    assert done.exit_code == 2, done.output
    assert message in done.stderr
    assert not list(tmp_path.glob("*.yaml"))


def test_on_a_terminal_it_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands_init, "_interactive", lambda: True)
    done = call("init", "--data", write(tmp_path / "b.csv", "when,size"), input="size\nwhen\nus\nPa\num\n")
    assert done.exit_code == 0, done.output
    assert "unit 'Pa' cannot be converted to 'm'" in done.stderr  # asked again
    columns = proposed(Path("b.yaml")).document.data["data"]["columns"]
    assert columns == {"time": {"name": "when", "unit": "us"}, "radius": {"name": "size", "unit": "um"}}


def test_nothing_is_replaced_without_force(tmp_path: Path) -> None:
    write(tmp_path / "b.csv")
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    Path("b.yaml").write_text("mine")
    done = call("init", "--data", "b.csv", *UNITS)
    assert (done.exit_code, done.stderr) == (2, "b.yaml: exists; give --force to replace it, or another --out\n")
    assert Path("b.yaml").read_text() == "mine"
    assert call("init", "--data", "b.csv", *UNITS, "--force").exit_code == 0
    assert proposed(Path("b.yaml")).document.data["data"]["path"] == "b.csv"


def test_one_column_tells_what_the_other_is(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv", "Zeit;radius".replace(";", ",")), *UNITS)
    assert done.exit_code == 0, done.output
    assert proposed(Path("b.yaml")).document.data["data"]["columns"]["time"]["name"] == "Zeit"


def test_the_run_is_called_like_the_file(tmp_path: Path) -> None:
    write(tmp_path / "film 1.csv")
    assert call("init", "--data", "film 1.csv", *UNITS).exit_code == 0
    assert proposed(Path("film_1.yaml")).name == "film_1"
    assert call("init", "--data", "film 1.csv", *UNITS, "--out", "my_gel.yaml").exit_code == 0
    assert proposed(Path("my_gel.yaml")).name == "my_gel"
    assert call("init", "--out", "other.yaml").exit_code == 0
    assert load_config("other.yaml").name == "other"


def test_a_constant_step_instead_of_times(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), "--time-step", "0.7 us", "--radius-unit", "um")
    assert done.exit_code == 0, done.output
    assert proposed(Path("b.yaml")).document.data["data"]["columns"]["time"] == {"step": "0.7 us"}


def test_a_folder_is_a_campaign_and_its_odd_file_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "gel one"
    folder.mkdir()
    for n in (1, 2):
        write(folder / f"b{n}.csv", scale=1 + n / 20)
    done = call("init", "--data", folder, *UNITS)
    assert done.exit_code == 0, done.output
    assert len(build(proposed(Path("gel_one.yaml")))) == 2
    assert re.search(r"b1\.csv: .*; one of 2 files\n", done.stderr)
    simulate("acoustic", "0 us:40 us:0.5 us", "1 um", folder / "other.csv")
    text = (folder / "other.csv").read_text().replace("t_us,radius_um", "t_us,R_um")
    (folder / "other.csv").write_text(text)
    (folder / "other.truth.yaml").unlink()
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 2
    assert "suggest different starts (acoustic: other; laser: b1, b2); say --start" in done.stderr
    (folder / "another.csv").write_text("")  # first of the folder, and empty
    (folder / "other.csv").write_text("a,b\n1,2\n")
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 0, done.output  # as in a campaign: what cannot be used is named and ends nothing
    assert "other.csv: no column" in done.stderr
    assert "another.csv: the file holds no data" in done.stderr
    assert Path("gel_one.yaml").read_text().count("# MIND: ") == 2
    for n in (1, 2):
        (folder / f"b{n}.csv").unlink()
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 2
    assert done.stderr.count("other.csv: ") == 2


def test_without_data_a_starter_is_written() -> None:
    done = call("init", "--start", "laser")
    assert done.exit_code == 0, done.output
    assert load_config("bubble.yaml").document.data["model"]["start"] == "laser"
    assert "bubble.csv: no such file" in call("validate", "bubble.yaml").stderr
    _, proposed = Path("bubble.yaml").read_text(encoding="utf-8").split("  name: bubble\n")
    assert [line for line in proposed.split("assimilation:")[0].splitlines() if "#" not in line] == []


def test_names_are_quoted_where_yaml_needs_it() -> None:
    for text in ("R (um)", "1", "no", "a: b", "#", "t,s", "Größe", "R_um", "a b"):
        assert parse_document(f"x: {{name: {quoted(text)}, unit: m}}").data == {"x": {"name": text, "unit": "m"}}


def test_one_table_of_many_bubbles(tmp_path: Path) -> None:
    text = write(tmp_path / "b.csv").read_text().splitlines()[1:]
    rows = [f"{name},{line}" for name in ("one", "two") for line in (text if name == "one" else text[::-1])]
    Path("b.csv").write_text("\n".join(["gel,t_us,R_um", *rows, rows[-1], ""]))
    done = call("init", "--data", "b.csv", *UNITS, "--by", "gel")
    assert "times must increase" in done.stderr  # of the second, which is named among the warnings
    done = call(
        "init", "--data", "b.csv", *UNITS, "--by", "gel", "--unsorted", "sort", "--repeated", "average", "--force"
    )
    assert done.exit_code == 0, done.output
    problems = build(proposed(Path("b.yaml")))
    assert [p.observations.name for p in problems] == ["b_one", "b_two"]
    assert np.array_equal(problems[0].observations.values, problems[1].observations.values)


@pytest.mark.parametrize(
    ("words", "wanted"), [(["bubble.csv"], "--data bubble.csv"), (["--data", "a.csv", "b.csv"], "a pattern in quotes")]
)
def test_a_file_that_no_option_names_is_answered_with_the_option(words: list[str], wanted: str) -> None:
    done = call("init", *words)
    assert done.exit_code == 2
    assert words[-1] in done.stderr
    assert wanted in done.stderr
