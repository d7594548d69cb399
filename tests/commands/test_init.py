"""``en4dvar init``: what it is asked and given, files, folders and tables; units are never guessed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import click
import numpy as np
import pytest
from init_files import UNITS, call, proposed, rebounding, simulate, write

from en4dvar.assembly.build import build, data_files, inverse_plan
from en4dvar.config import load_config
from en4dvar.config.document import parse_document
from en4dvar.inputs.formats import Format
from en4dvar.runs.together import groups_of
from en4dvar_bubble import commands_init
from en4dvar_bubble.collapse import single
from en4dvar_bubble.starter.config import quoted

pytestmark = pytest.mark.usefixtures("own_folder")


def test_without_units_and_terminal_one_error_says_what_to_add(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv", "t,R"))
    assert done.exit_code == 2
    fault, following = done.stderr.splitlines()[-2:]
    assert "columns with numbers: t, R; units are never guessed" in fault
    assert "add --time-unit UNIT (e.g. us), --radius-unit UNIT (e.g. um)" in fault
    assert following.endswith("--time-unit UNIT --radius-unit UNIT")
    done = call("init", "--data", write(tmp_path / "b.csv", "a,b"), "--time-unit", "us")
    needed = "add --time-column NAME, --radius-column NAME, --radius-unit UNIT (e.g. um)"
    assert needed in done.stderr
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.parametrize("head", ["t_us,R_um", "time [us],radius [um]", "Time (us),Radius(µm)"])
def test_units_that_the_names_of_columns_state_are_taken(tmp_path: Path, head: str) -> None:
    data, named = write(tmp_path / "b.csv", head), tmp_path / "named.yaml"
    assert call("init", "--data", data, "--out", named).exit_code == 0
    assert re.search(r"time: \{name: .*, unit: us\}\n +radius: \{name: .*, unit: .?[uµ]m.?\}", named.read_text())
    assert build(load_config(named))[0].observations.values.max() < 1e-3
    other = call("init", "--data", data, "--time-unit", "ms", "--out", tmp_path / "other.yaml")
    assert other.exit_code == 0
    assert "unit: ms}" in (tmp_path / "other.yaml").read_text()


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
    done = call("init", "--data", write(tmp_path / "b.csv", "when,size"), input="when\nus\nsize\nPa\num\n")
    assert done.exit_code == 0, done.output
    assert "unit 'Pa' cannot be converted to 'm'" in done.stderr  # asked again
    columns = proposed(Path("b.yaml")).document.data["data"]["columns"]
    assert columns == {"time": {"name": "when", "unit": "us"}, "radius": {"name": "size", "unit": "um"}}
    frames = ("--data", write(tmp_path / "f.csv", "frame,radius"), "--time-unit", "frame")
    done = call("init", *frames, input="1/(1.4*MHz)\num\n")  # how long one is no option tells
    assert done.exit_code == 0, done.output
    assert "time: {name: frame, unit: 1/(1.4*MHz)}" in Path("f.yaml").read_text().replace('"', "")


def test_nothing_is_replaced_without_force(tmp_path: Path) -> None:
    write(tmp_path / "b.csv")
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    Path("b.yaml").write_text("mine")
    done = call("init", "--data", "b.csv", *UNITS)
    assert (done.exit_code, done.stderr) == (2, "b.yaml: exists; give --force to replace it, or another name\n")
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
    assert "suggest different starts (acoustic: other; laser: b1, b2); give --start" in done.stderr
    (folder / "another.csv").write_text("")  # first of the folder, and empty
    (folder / "other.csv").write_text("a,b\n1,2\n")
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 0, done.output  # as in a campaign: what cannot be used is named and ends nothing
    assert "other.csv: no column" in done.stderr
    assert "another.csv: the file holds no data" in done.stderr
    assert Path("gel_one.yaml").read_text().count("# WARNING: ") == 2
    (folder / "other.csv").write_text("t_us,R_um\n" + "".join(f"{t},{20 + t}\n" for t in range(20)))  # shows no bubble
    done = call("init", "--data", folder, *UNITS, "--start", "laser", "--force")
    assert done.exit_code == 0, done.output
    assert "other: the recording ends with the maximum, reading 20 of 20: it shows only growth" in done.stderr
    for n in (1, 2):
        (folder / f"b{n}.csv").unlink()
    (folder / "other.csv").write_text("a,b\n1,2\n")
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 2
    assert done.stderr.count("other.csv: ") == 2


def test_the_clock_of_a_bubble_is_as_certain_in_a_folder_as_alone(tmp_path: Path) -> None:
    """Films of the same bubble whose frames lie otherwise about its top, at t = 0 after any time of the camera's."""
    (tmp_path / "gel").mkdir()
    stream, clocks = np.random.default_rng(5), {}
    for n in range(4):
        t, R = rebounding(0.1, 0.025 * n)
        readings = zip(20 * (t + 3.3 * n), 200 * R + 0.4 * stream.standard_normal(len(R)), strict=True)
        (tmp_path / "gel" / f"b{n}.csv").write_text("t_us,R_um\n" + "".join(f"{a:.4f},{b:.4f}\n" for a, b in readings))
    for data in ("gel", *(f"gel/b{n}.csv" for n in range(4))):
        assert call("init", "--data", data, "--start", "laser", "--out", "b.yaml", "--force").exit_code == 0
        for problem in build(proposed(Path("b.yaml"))):
            (clock,) = (term for term in problem.prior.terms if term.parameter.name == "t_s")
            clocks[data, problem.observations.name] = clock.std
            late = clock.mean - problem.observations.zero + 20e-6 * 3.3 * int(problem.observations.name[1:])
            assert abs(late) < 2 * clock.std  # of what the frames' clock shows at the top
    for n in range(4):
        assert clocks["gel", f"b{n}"] == pytest.approx(clocks[f"gel/b{n}.csv", f"b{n}"], rel=0.3)


@pytest.mark.parametrize(
    ("ends", "to", "words"),
    [
        ((1.1,), "end", "warning: the readings end before the top of the first rebound, .*; record longer, "),
        ((0.7,), "end", "warning: the readings end before the top of the first rebound, .*; record longer, "),
        ((0.7, 1.1, 3.0), "trough 2 or end", "warning: b0, b1: the readings end .*; move those files away, or accept "),
        ((1.5,), "end", ""),
        ((1.5, 1.6), "end", ""),
        ((3.0,), "trough 2", ""),
        ((1.1, 3.0), "trough 2 or end", "warning: b0: the readings end .*; move those files away, or accept "),
        ((1.5, 3.0), "trough 2 or end", ""),
    ],
)
def test_a_recording_that_ends_with_the_first_collapse_is_told_at_once(
    tmp_path: Path, ends: tuple[float, ...], to: str, words: str
) -> None:
    """A rebound whose top is past is in the window, and one that ends before it costs the other bubbles nothing."""
    (tmp_path / "gel").mkdir()
    t, R = rebounding(0.05)
    for n, end in enumerate(ends):
        rows = zip(20 * t[t < end], 200 * R[t < end], strict=True)
        (tmp_path / "gel" / f"b{n}.csv").write_text("t_us,R_um\n" + "".join(f"{a:.4f},{b:.4f}\n" for a, b in rows))
    done = call("init", "--data", "gel", "--start", "laser", "--out", "b.yaml")
    assert done.exit_code == 0, done.output
    assert re.search(words, done.stderr)
    assert ("of the first rebound" in done.stderr) == bool(words)
    assert ("us later (not recorded: where the readings before it lead to), " in done.output) == (ends == (0.7,))
    assert proposed(Path("b.yaml")).document.data["data"]["window"] == {"from": "top", "to": to}
    for end, problem in zip(ends, build(load_config("b.yaml")), strict=True):
        assert single(problem.observations.times, problem.observations.values) == (end == 1.1)
        assert problem.observations.times[-1] == pytest.approx(20e-6 * min(end, 2.5), abs=1.1e-6)


def test_a_bubble_that_shrinks_where_it_should_rest_ends_with_its_only_minimum(tmp_path: Path) -> None:
    """In a folder, too, where another has a second one; that its rebound is lost is told."""
    (tmp_path / "gel").mkdir()
    t, R = rebounding(0.05)
    shrinking = np.where(t > 1.75, np.interp(t, (1.75, 2.1, 3), (np.interp(1.75, t, R), 0.36, 0.24)), R)
    damped = np.where(t > 0, 0.4 + 0.6 * np.exp(-2 * t**2), R)  # has no minimum
    (tmp_path / "thick").mkdir()
    for folder, radii in (("gel", (shrinking, R)), ("thick", (shrinking, R, damped))):
        for n, radius in enumerate(radii):
            rows = "".join(f"{a:.4f},{b:.4f}\n" for a, b in zip(20 * t, 200 * radius, strict=True))
            (tmp_path / folder / f"b{n}.csv").write_text("t_us,R_um\n" + rows)
    ends = {"gel": {"to": "trough 2 or trough 1"}, "thick": {"to": "trough 2 or trough 1 or end"}}
    for data, to in (*ends.items(), ("gel/b0.csv", {"to": "trough 1", "until": "trough 1"})):
        done = call("init", "--data", data, "--start", "laser", "--out", "b.yaml", "--force")
        assert "b0: R goes from" in done.stderr
        assert "and its window ends with the first collapse, before the rebound has a top" in done.stderr
        assert proposed(Path("b.yaml")).document.data["data"]["window"] == {"from": "top", **to}


def test_without_data_a_starter_is_written() -> None:
    done = call("init", "--start", "laser")
    assert done.exit_code == 0, done.output
    assert load_config("bubble.yaml").document.data["model"]["start"] == "laser"
    assert "bubble.csv: no such file" in call("validate", "bubble.yaml").stderr
    _, proposed = Path("bubble.yaml").read_text(encoding="utf-8").split("  name: bubble\n")
    assert [line for line in proposed.split("assimilation:")[0].splitlines() if "#" not in line] == []


def test_names_are_quoted_where_yaml_needs_it() -> None:
    for text in ("R (um)", "1", "no", "a: b", "#", "t,s", "Größe", "R_um", "a b", ".5", ".inf", "..."):
        assert parse_document(f"x: {{name: {quoted(text)}, unit: m}}").data == {"x": {"name": text, "unit": "m"}}


def test_of_three_bubbles_the_run_ends_with_their_gel(tmp_path: Path) -> None:
    """What varies is written down, what is common is told, and the file is valid as it stands; of two it is not."""
    folder = tmp_path / "gel"
    folder.mkdir()
    for n in (1, 2):
        write(folder / f"b{n}.csv", scale=1 + n / 20)
    assert call("init", "--data", folder, *UNITS).exit_code == 0
    assert proposed(Path("gel.yaml")).population is None
    assert proposed(Path("gel.yaml")).assimilation.what_if is True
    write(folder / "b3.csv")
    done = call("init", "--data", folder, *UNITS, "--force")
    assert "3 bubbles: at its end the run estimates their one gel" in done.output
    asked = proposed(Path("gel.yaml")).population
    assert asked is not None
    assert asked.of == ("G", "mu")
    assert asked.spread == 0.25
    assert proposed(Path("gel.yaml")).assimilation.what_if is False
    assert "rho, c, p_inf, reading_scale have one value in all bubbles" in Path("gel.yaml").read_text()
    assert call("init", "--data", folder, *UNITS, "--law", "newtonian", "--force").exit_code == 0
    asked = proposed(Path("gel.yaml")).population
    assert asked is not None
    assert (asked.of, asked.spread) == (("mu",), 0.05)  # a liquid has one viscosity


def test_subfolders_are_gels_that_are_compared(tmp_path: Path) -> None:
    """The same file names in each; the name of one folder begins as that of another; what is no gel's file is named."""
    for folder in ("gel", "gel_8 kPa"):
        (tmp_path / "gels" / folder).mkdir(parents=True)
        for n in (1, 2, 3):
            write(tmp_path / "gels" / folder / f"b{n}.csv", scale=1 + n / 20)
    done = call("init", "--data", tmp_path / "gels", *UNITS)
    assert done.exit_code == 0, done.output
    assert "at its end the run estimates each folder, and compares them: gel (3), gel_8 kPa (3)" in done.output
    config = proposed(Path("gels.yaml"))
    assert config.population is not None
    assert config.population.by == "folder"
    groups = {group.name: sorted(group.datasets) for group in groups_of(config, data_files(inverse_plan(config)))}
    assert groups == {f: [f"{f}_b{n}" for n in (1, 2, 3)] for f in ("gel", "gel_8 kPa")}
    for n in (1, 2):
        (tmp_path / "gels" / "gel_8 kPa" / f"b{n}.csv").write_text("a,b\n1,2\n")
    done = call("init", "--data", tmp_path / "gels", *UNITS, "--force")
    assert done.exit_code == 0, done.output
    assert "b1.csv: no column" in done.stderr


def bubbles_of(folder: Path, names: str = "abcdef") -> Path:
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        write(folder / f"{name}.csv", scale=1 + i / 20)
    return folder


def groups_in(path: str) -> dict[str, list[str]]:
    config = proposed(Path(path))
    assert config.population is not None
    return {group.name: sorted(group.datasets) for group in groups_of(config, data_files(inverse_plan(config)))}


@pytest.mark.parametrize(
    ("table", "asked", "kind", "expected"),
    [
        ("file,gel\na.csv,soft\nb,soft\nc.csv,soft\nd.csv,9 of 12\ne.csv,9 of 12\nf.csv,9 of 12\nother.csv,none\n",
         "gels.csv", "gel", {"soft": ["a", "b", "c"], "9 of 12": ["d", "e", "f"]}),
        ("day;conc [%];name\n1;5;a\n1;5;b\n2;8;c\n2;8;d\n2;8;e\n1;8;f\n",
         "gels.csv:conc [%]", "conc", {"5 %": ["a", "b"], "8 %": ["c", "d", "e", "f"]}),
        ("day;conc [%];name\n1;5;a\n1;5;b\n2;8;c\n2;8;d\n2;8;e\n1;8;f\n",
         "gels.csv:day", "day", {"1": ["a", "b", "f"], "2": ["c", "d", "e"]}),
    ],
)  # fmt: skip
def test_groups_are_a_column_of_a_table(tmp_path: Path, table: str, asked: str, kind: str, expected: object) -> None:
    """By file or name of the data set, in any column; a number has the unit of its column's name."""
    folder = bubbles_of(tmp_path / "all")
    Path("gels.csv").write_text(table)
    done = call("init", "--data", folder, *UNITS, "--groups", asked)
    assert done.exit_code == 0, done.output
    assert f"at its end the run estimates each {kind}, and compares them: " in done.output
    assert groups_in("all.yaml") == expected


def test_bubbles_of_groups_are_those_that_are_seen_and_a_column_can_be_typed(tmp_path: Path) -> None:
    folder = bubbles_of(tmp_path / "all")
    (folder / "a.csv").write_text("t_us,R_um\n0,\n1,\n")
    Path("gels.csv").write_text("file,gel [%],day\n" + "".join(f"{x},{i // 2},{i}\n" for i, x in enumerate("abcdef")))
    said = call("init", "--data", folder, *UNITS, "--groups", "gels.csv").stderr
    assert "say 'gels.csv:gel [%]' or gels.csv:day" in said
    done = call("init", "--data", folder, *UNITS, "--groups", "gels.csv:gel [%]")
    assert "5 bubbles:" not in done.output
    Path("gels.csv").write_text("file,gel [%],day\n" + "".join(f"{x},{i // 3},{i}\n" for i, x in enumerate("abcdef")))
    done = call("init", "--data", folder, *UNITS, "--groups", "gels.csv:gel [%]", "--force")
    assert "5 bubbles: at its end the run estimates each gel, and compares them: 0 % (2), 1 % (3)" in done.output


def test_groups_are_a_column_of_the_data(tmp_path: Path) -> None:
    """Of one table of many bubbles, and of a file each; the same as of a table of them."""
    lines = write(tmp_path / "one.csv").read_text().splitlines()[1:]
    of_gel = {"x1": "A", "x2": "A", "x3": "A", "y1": "B_x", "y2": "B_x", "y3": "B_x"}
    rows = [f"{name},{gel},{line}" for name, gel in of_gel.items() for line in lines]
    Path("many.csv").write_text("\n".join(["bubble,gel,t_us,R_um", *rows, ""]))
    done = call("init", "--data", "many.csv", *UNITS, "--by", "bubble", "--groups", "gel")
    assert done.exit_code == 0, done.output
    expected = {"A": ["many_x1", "many_x2", "many_x3"], "B_x": ["many_y1", "many_y2", "many_y3"]}
    assert groups_in("many.yaml") == expected
    folder = tmp_path / "each"
    folder.mkdir()
    for name, gel in of_gel.items():
        (folder / f"{name}.csv").write_text("\n".join(["gel,t_us,R_um", *(f"{gel},{line}" for line in lines), ""]))
    done = call("init", "--data", folder, *UNITS, "--time-column", "t_us", "--radius-column", "R_um", "--groups", "gel")
    assert done.exit_code == 0, done.output
    assert groups_in("each.yaml") == {g: [n.removeprefix("many_") for n in its] for g, its in expected.items()}


@pytest.mark.parametrize(
    ("table", "asked", "words"),
    [
        ("file,gel\na.csv,A\n", "gels.csv", "gels.csv: no row for b, c, d, e, f; a row needs"),
        ("file,gel,day\n" + "".join(f"{x},A,1\n" for x in "abcdef"), "gels.csv",
         "gels.csv: 2 columns could be the groups; say gels.csv:gel or gels.csv:day"),
        ("file,gel,day\n" + "".join(f"{x},A,1\n" for x in "abcdef"), "gels.csv:gell",
         "gels.csv: no column 'gell' of groups; say gels.csv:gel or gels.csv:day"),
        ("file,gel\n" + "".join(f"{x},A\n" for x in "abcdef"), "gels.csv", "all data sets are of 'A'"),
        ("file,gel\na,B\n" + "".join(f"{x},A\n" for x in "abcdef"), "gels.csv",
         "a: one group is needed for a data set, not A, B"),
        ("file,gel\n" + "".join(f"{x},\n" for x in "abcdef"), "gels.csv",
         "a: one group is needed for a data set, not empty"),
        ("", "none.csv", "none.csv: no such table of groups"),
        ("", "all/a.csv", "all/a.csv: lies among the data files"),
        ("", "gel", "a.csv: no column 'gel'; the columns are: t_us, R_um"),
    ],
)  # fmt: skip
def test_groups_that_cannot_be_told(tmp_path: Path, table: str, asked: str, words: str) -> None:
    folder = bubbles_of(tmp_path / "all")
    Path("gels.csv").write_text(table)
    done = call("init", "--data", folder, *UNITS, "--groups", asked)
    assert done.exit_code == 2
    assert words in done.stderr
    assert not Path("all.yaml").exists()


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


@pytest.mark.parametrize("since", ["trough 1", "trough 7 or 0.0189 ms", "0.0189 ms"])
def test_what_is_before_an_instant_is_as_if_nobody_had_seen_it(tmp_path: Path, since: str) -> None:
    """The first collapse of a film left out: its bubble is that of the rebound, R_max 60 um at 27 us."""
    done = call("init", "--data", write(tmp_path / "b.csv"), "--since", since)
    assert done.exit_code == 0, done.output
    assert ("--start acoustic" in done.output) == (since == "0.0189 ms")  # a collapse is behind it, a time says nothing
    told = re.search(r"R_max (\S+) um", done.output)
    assert told
    assert float(told[1]) == pytest.approx(60, abs=1)
    assert f"\n  since: {since}\n" in Path("b.yaml").read_text()
    (problem,) = build(proposed(Path("b.yaml")))
    assert problem.observations.values.max() < 61e-6
    answered = call("init", "--data", "b.csv", "--since", since, "--start", "laser", "--force")
    assert "only a proposal" not in answered.output
    refused = call("init", "--data", "b.csv", "--since", "trough 9", "--force")
    assert refused.exit_code == 2
    assert "b.csv: --since asks for minimum 9, but only 1" in refused.stderr
    assert "--since: 'soon' is not an instant" in call("init", "--data", "b.csv", "--since", "soon", "--force").stderr


@pytest.mark.parametrize(
    ("words", "wanted"), [(["bubble.csv"], "--data bubble.csv"), (["--data", "a.csv", "b.csv"], "a pattern in quotes")]
)
def test_a_file_that_no_option_names_is_answered_with_the_option(words: list[str], wanted: str) -> None:
    done = call("init", *words)
    assert done.exit_code == 2
    assert words[-1] in done.stderr
    assert wanted in done.stderr


@pytest.mark.parametrize("option", ["--since", "--groups", "--time-unit"])
def test_an_option_of_data_needs_data(option: str) -> None:
    for example in ((), ("--example", "quickstart")):
        done = call("init", option, "day", *example)
        assert (done.exit_code, f"{option} needs --data" in done.stderr) == (2, True)
    assert "comes with its own data, start, law" in call("init", "--example", "quickstart", "--start", "laser").stderr


def test_options_that_contradict_each_other(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), *UNITS, "--pixel", "2 um")
    assert (done.exit_code, done.stderr.splitlines()[-1][:37]) == (2, "--pixel makes pixels the unit of radi")
    done = call("init", "--data", "b.csv", "--pixel", "-2 um", "--time-unit", "us")
    assert "'-2 um' is not positive" in done.stderr


def _workbook(path: Path) -> Path:
    from openpyxl import Workbook

    book = Workbook()
    for title in ("Film 3", "Film 4"):
        sheet = book.active if title == "Film 3" else book.create_sheet()
        sheet.title = title
        for row in [("t_us", "R_um"), (0, 9), (1, 8), (2, 7)]:
            sheet.append(row)
    book.save(path)
    return path


@pytest.mark.parametrize(
    ("rows", "words", "following"),
    [
        ("0,9 1,8 3,7 2,7", "sort the rows (--unsorted sort)", "--unsorted sort"),
        ("0,9 1,8 1,7 2,7", "their mean (--repeated average)", "--repeated average"),
        (
            "0,9 1,8 2,7 3,6 0,9 1,7 2,5 3,3",
            "a column that says whose each row is, and name it by --by",
            "of one series whose clock began anew, add the time that had passed to the later times",
        ),
    ],
)
def test_disorder_is_answered_with_options_of_init(tmp_path: Path, rows: str, words: str, following: str) -> None:
    (tmp_path / "b.csv").write_text("\n".join(["t_us,R_um", *rows.split()]))
    done = call("init", "--data", "b.csv", *UNITS)
    assert done.exit_code == 2
    assert words in done.stderr
    assert "data." not in done.stderr
    assert done.stderr.splitlines()[-1].endswith(following)


def test_init_knows_every_format_of_data() -> None:
    option = next(it for it in commands_init.init.params if it.name == "format")
    assert isinstance(option.type, click.Choice)
    assert tuple(option.type.choices) == get_args(Format)


def test_sheets_movies_and_unknown_files_are_answered_with_options(tmp_path: Path) -> None:
    done = call("init", "--data", _workbook(tmp_path / "b.xlsx"), *UNITS)
    assert "say which (--sheet): Film 3, Film 4" in done.stderr
    assert done.stderr.splitlines()[-1].endswith("--sheet SHEET")
    (tmp_path / "b.abc").write_text((write(tmp_path / "b.csv")).read_text())
    done = call("init", "--data", "b.abc", *UNITS)
    assert "say what it is (--format csv" in done.stderr
    assert call("init", "--data", "b.abc", "--format", "csv", *UNITS).exit_code == 0
    assert len(build(proposed(Path("b.yaml")))) == 1
    frames = tmp_path / "frames"
    frames.mkdir()
    for n in range(3):
        (frames / f"{n}.tif").write_bytes(b"")
    for movie in ("bubble.mp4", "frames"):
        done = call("init", "--data", movie)
        assert done.exit_code == 2
        assert f"next: en4dvar init --movie {movie} --pixel LENGTH --frame-rate RATE" in done.stderr


def test_columns_that_differ_by_a_number_are_proposed_as_bubbles(tmp_path: Path) -> None:
    lines = write(tmp_path / "b.csv").read_text().split()[1:]
    wide = "\n".join(["t_us,R_1,R_2", *(f"{line},{line.split(',')[1]}" for line in lines), ""])
    Path("b.csv").write_text(wide)
    done = call("init", "--data", "b.csv", *UNITS)
    assert "add --radius-column 'R_*' (each of these columns is a bubble)" in done.stderr
    assert done.stderr.splitlines()[-1].endswith("--radius-column 'R_*'")
    done = call("init", "--data", "b.csv", *UNITS, "--radius-column", "R_*")
    assert done.exit_code == 0, done.output
    assert [p.observations.name for p in build(proposed(Path("b.yaml")))] == ["b_R_1", "b_R_2"]
