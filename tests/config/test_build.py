"""Building: the data complete the settings."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat
from toy_config import csv_text, write_toy

from en4dvar.assembly.build import build, data_files, inverse_plan
from en4dvar.assembly.reading import with_parts
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.inputs.parts import Column, Layout
from en4dvar.plumbing.errors import ConfigError, DataError


def test_one_problem(tmp_path: Path) -> None:
    (problem,) = build(load_config(write_toy(tmp_path)))
    assert problem.observations.name == "toy"
    assert len(problem.observations) == 31
    assert problem.observations.times[1] == 5e-3
    assert np.all(problem.observations.std == 2e-6)
    assert np.all(problem.observations.weights == 1.0)
    assert problem.prior.names == ("A", "k")
    assert problem.prior.mean.tolist() == [pytest.approx(1e-4), pytest.approx(np.log(3.0))]
    assert problem.prior.std.tolist() == [pytest.approx(1e-6), 0.3]
    assert problem.fixed == {"c": 0.02}


def test_window_zero_weights_and_relative_error(tmp_path: Path) -> None:
    extra = "  window: {from: minimum 1, to: x_max}\n  time_zero: window\n"
    path = write_toy(
        tmp_path,
        ("  error: {position_std: 2 um}\n", "  error: {position_std: 1 % of maximum}\n" + extra),
        data=csv_text(61),
    )
    (problem,) = build(load_config(path, {"assimilation.weights": "mean"}))
    y = problem.observations
    assert y.times[0] == 0.0
    assert y.file_times == pytest.approx(build(load_config(path, {"data.time_zero": "file"}))[0].observations.times)
    assert y.zero == y.file_times[0] > 0
    assert y.values[0] < y.values[1] < y.values[-1]
    assert y.std == pytest.approx(np.full(len(y), 0.01 * y.values.max()))
    assert y.weights.sum() == pytest.approx(1.0)


def test_the_clock_can_start_at_the_top_that_each_data_set_shows(tmp_path: Path) -> None:
    """A parabola read every 5 ms, whose top lies at 52 ms in one file and at 54 ms in the other."""
    path = write_toy(tmp_path, ("  path: toy.csv\n", "  path: [toy.csv, late.csv]\n  window: {from: top, to: end}\n"))
    for name, top in (("toy", 52), ("late", 54)):
        rows = "".join(f"{t},{100 - 0.01 * (t - top) ** 2}\n" for t in range(0, 150, 5))
        (tmp_path / f"{name}.csv").write_text("t_ms,x_um\n" + rows)
    problems = build(load_config(path, {"data.time_zero": "top"}))
    assert [problem.observations.zero for problem in problems] == pytest.approx([52e-3, 54e-3])
    assert [problem.observations.times[0] for problem in problems] == pytest.approx([3e-3, 1e-3])
    assert [problem.observations.file_times[0] for problem in problems] == pytest.approx([55e-3, 55e-3])
    with pytest.raises(DataError, match=r"lies 52 ms before time zero.*begin later"):
        build(load_config(path, {"data.time_zero": "top", "data.window": {"from": "start"}}))


def test_the_clock_can_start_where_each_file_says(tmp_path: Path) -> None:
    path = write_toy(tmp_path, ("  path: toy.csv\n", "  path: [toy.csv, late.csv]\n"))
    for name, delay in (("toy", 0.0), ("late", 7.0)):
        rows = "".join(f"{t + delay},{100 - t}\n" for t in range(4, 90, 5))
        (tmp_path / f"{name}.csv").write_text(f"# delay = {delay}\nt_ms,x_um\n{rows}")
    problems = build(load_config(path, {"data.time_zero": "{from_file: delay, unit: ms}"}))
    assert [problem.observations.zero for problem in problems] == pytest.approx([0.0, 7e-3])
    np.testing.assert_allclose(problems[0].observations.times, problems[1].observations.times)
    for plus, first in (("3 ms", 1e-3), ("-3 ms", 7e-3)):
        shifted = build(load_config(path, {"data.time_zero": f"{{from_file: delay, unit: ms, plus: {plus}}}"}))
        assert [problem.observations.times[0] for problem in shifted] == pytest.approx([first, first])
    with pytest.raises(DataError, match=r"no scalar 'delai' for data.time_zero; did you mean 'delay'"):
        build(load_config(path, {"data.time_zero": "{from_file: delai, unit: ms}"}))


def test_the_trough_after_the_window_is_named(tmp_path: Path) -> None:
    """Counted as ``data.window.to`` counts it, from the window's start, as far as readings are predicted."""
    path = write_toy(tmp_path, data=csv_text(121))
    for window, name in (
        ({"from": "start", "to": "trough 1"}, "trough 2"),
        ({"from": "start", "to": "20 ms"}, "trough 1"),
        ({"from": "minimum 1", "to": "250 ms"}, "trough 1"),
        ({"from": "start", "to": "trough 1", "until": "250 ms"}, ""),
        ({"from": "start", "to": "end"}, ""),
    ):
        (problem,) = build(load_config(path, {"data.window": window}))
        assert problem.observations.next_end == name


def test_value_from_a_mat_file(tmp_path: Path) -> None:
    t = np.arange(31) * 5e-3
    savemat(tmp_path / "toy.mat", {"x": np.cos(30 * t)[None], "dt": 5.0, "damping": 20.0})
    path = write_toy(
        tmp_path,
        ("toy.csv", "toy.mat"),
        ("{name: t_ms, unit: ms}", "{step: dt, unit: ms}"),
        ("x_um", "x"),
        ("c: 0.02 N s/m", "c: {from_file: damping, unit: mN s/m}"),
    )
    (problem,) = build(load_config(path))
    assert problem.fixed == {"c": 0.02}
    assert problem.observations.times == pytest.approx(t)
    path.write_text(path.read_text().replace("from_file: damping", "from_file: dampin"))
    with pytest.raises(
        ConfigError, match=r"toy\.yaml:15:6: parameters\.c: .*no scalar 'dampin' for c; did you mean 'dam"
    ):
        build(load_config(path))


def test_campaign(tmp_path: Path) -> None:
    tmp_path /= "gel [1]"  # brackets in the name of a folder are no pattern
    tmp_path.mkdir()
    path = write_toy(tmp_path)
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        for n in (1, 2):
            (tmp_path / folder / f"set{n}.csv").write_text(csv_text())
    names = [p.observations.name for p in build(load_config(path, {"data.path": "a/*.csv"}))]
    assert names == ["set1", "set2"]
    names = [p.observations.name for p in build(load_config(path, {"data.path": ["b/set1.csv", "a/*.csv"]}))]
    assert names == ["b_set1", "a_set1", "set2"]
    with pytest.raises(DataError, match="occurs more than once"):
        build(load_config(path, {"data.path": ["a/set1.csv", "a/*.csv"]}))
    for n in (1, 2):
        (tmp_path / "b" / f"set{n}.csv").write_text("t_ms,x_um\n")
    with pytest.raises(DataError, match=r"b/set1\.csv: .*\n.*b/set2\.csv: "):
        build(load_config(path, {"data.path": ["a/set1.csv", "b/*.csv"], "name": "all"}))
    with pytest.raises(DataError, match="no file matches"):
        build(load_config(path, {"data.path": "c/*.csv"}))


def test_tables_are_counted_without_a_look_into_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(write_toy(tmp_path))
    monkeypatch.setattr("en4dvar.inputs.parts.table_of", lambda *_: pytest.fail("a table was read"))
    assert len(data_files(inverse_plan(config))) == 1


def test_refused(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    with pytest.raises(ConfigError, match="nothing to estimate"):
        build(load_config(path, {"parameters.A": "1 um", "parameters.k": "1 N/m"}))
    with pytest.raises(DataError, match=r"toy\.csv: the window asks for minimum 9"):
        build(load_config(path, {"data.window": "{to: minimum 9}"}))
    with pytest.raises(DataError, match="before time zero"):
        build(load_config(path, {"data.time_zero": "7 ms"}))
    for window in ("from: 200 ms", "to: -1 ms", "from: 21 ms, to: 24 ms"):
        with pytest.raises(DataError, match=r"the window holds no reading; the readings go from 0 to 150 ms$"):
            build(load_config(path, {"data.window": f"{{{window}}}"}))
    with pytest.raises(DataError, match=r"it ends before it starts; the readings go from 0 to 150 ms$"):
        build(load_config(path, {"data.window": "{from: 20 ms, to: 10 ms}"}))
    with pytest.raises(DataError, match=r"the window data\.window holds 2 of \d+ usable observations; at least 3"):
        build(load_config(path, {"data.window": "{to: 7 ms}"}))
    text = path.read_text()
    path.write_text(text[: text.index("data:")] + text[text.index("model:") :])
    with pytest.raises(ConfigError, match="data: required"):
        build(load_config(path))


def test_a_struct_array_is_a_campaign(tmp_path: Path) -> None:
    """One bubble an element, each with its own scalars; what stands beside the array is shared."""
    from scipy.io import savemat

    array = np.empty(3, dtype=[("R", object), ("Req", object)])
    for k in range(3):
        array[k] = (1e2 * np.exp(-np.arange(6.0) / (k + 2)), 10.0 + k)
    savemat(tmp_path / "gel.mat", {"expts": array, "t": np.arange(6.0)})
    text = """
name: many
data:
  path: gel.mat
  columns: {time: {name: t, unit: us}, radius: {name: expts.R, unit: um}}
  window: {from: R_max, to: end}
  time_zero: window
  error: {radius_std: 1 um}
model: {name: bubble, law: neo-hookean-kelvin-voigt, start: laser}
parameters:
  G: {prior: lognormal, median: 2 kPa, log_std: 0.5}
  mu: 0.1 Pa s
  R_eq: {from_file: expts.Req, unit: um}
  R_max: {prior: normal, mean: maximum, std: 1 %}
  t_s: 0 us
"""
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    problems = build(load_config(tmp_path / "c.yaml"))
    assert [p.observations.name for p in problems] == ["gel_1", "gel_2", "gel_3"]
    assert [p.fixed["R_eq"] for p in problems] == pytest.approx([10e-6, 11e-6, 12e-6])
    assert problems[2].observations.values == pytest.approx(1e-4 * np.exp(-np.arange(6.0) / 4))
    one = load_config(tmp_path / "c.yaml", {"data.columns.radius.name": "expts(2).R", "parameters.R_eq": "12 um"})
    (problem,) = build(one)
    assert problem.observations.values == pytest.approx(problems[1].observations.values)
    missing = load_config(tmp_path / "c.yaml", {"data.columns.radius.name": "expts.Roft", "parameters.R_eq": "12 um"})
    with pytest.raises(DataError, match=r"field 'expts.Roft' is not in the file"):
        build(missing)


def test_lengths_in_pixels(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    (plain,) = build(load_config(path))
    (found,) = build(load_config(path, {"data.columns.position.unit": {"pixel": "2.5 um"}}))
    assert found.observations.values == pytest.approx(2.5 * plain.observations.values)
    for wrong in ({"pixel": "2.5"}, {"pixel": "-2 um"}, {"pixels": "2 um"}, {"pixel": "0 um"}, {"pixel": "2 us"}):
        with pytest.raises(ConfigError, match="unit"):
            load_config(path, {"data.columns.position.unit": wrong})


def test_a_column_a_data_set(tmp_path: Path) -> None:
    rows = "".join(f"{k},{10 - k},{20 - k if k < 8 else ''}\n" for k in range(10))
    path = write_toy(tmp_path, ("name: x_um", "name: x_*"), data=f"t_ms,x_a,x_b\n{rows}")
    a, b = build(load_config(path))
    assert [p.observations.name for p in (a, b)] == ["toy_x_a", "toy_x_b"]
    assert a.observations.values == pytest.approx((10 - np.arange(10)) * 1e-6)
    assert b.observations.values == pytest.approx((20 - np.arange(8)) * 1e-6)
    with pytest.raises(DataError, match=r"toy.csv: no column 'z_\*'; the columns are: t_ms, x_a, x_b"):
        build(load_config(path, {"data.columns.position.name": "z_*"}))


def test_rows_that_say_which_data_set(tmp_path: Path) -> None:
    rows = "".join(f"{name},{k},{10 * n - k}\n" for n, name in ((2, "b 1"), (1, "a")) for k in range(5))
    path = write_toy(tmp_path, ("  path: toy.csv", "  path: toy.csv\n  by: bubble"), data=f"bubble,t_ms,x_um\n{rows}")
    b, a = build(load_config(path))
    assert [p.observations.name for p in (b, a)] == ["toy_b 1", "toy_a"]
    assert b.observations.values == pytest.approx((20 - np.arange(5)) * 1e-6)
    assert a.observations.values == pytest.approx((10 - np.arange(5)) * 1e-6)
    for by, text, message in (
        ("bubbles", "", r"no column 'bubbles'; the columns are: bubble, t_ms, x_um"),
        ("bubble", ",9,1\n", r"toy.csv:12: column 'bubble' does not say which data set this is"),
    ):
        (tmp_path / "toy.csv").write_text(f"bubble,t_ms,x_um\n{rows}{text}")
        with pytest.raises(DataError, match=message):
            build(load_config(path, {"data.by": by}))


def test_data_sets_of_several_files_have_names_of_their_own(tmp_path):
    """Part ``2_3`` of one and part ``3`` of the other: neither takes the place of the other."""
    text = "t,gel,R\n" + "".join(f"{k},{{}},{k + 1}\n" for k in range(3))
    paths = {name: tmp_path / f"{name}.csv" for name in ("a_1", "a_1_2")}
    for path, part in zip(paths.values(), ("2_3", "3"), strict=True):
        path.write_text(text.replace("{}", part))
    found = with_parts(paths, Column("R", "um", "um"), Layout(by="gel"))
    assert [(name, file.path.stem, file.part) for name, file in found.items()] == [
        ("a_1_2_3", "a_1", "2_3"),
        ("a_1_2_3_2", "a_1_2", "3"),
    ]


def test_outliers_that_were_left_out_are_told(tmp_path):
    rows = [f"{t},{100 - 0.1 * (t - 15) ** 2 + (9 if t == 8 else 0.1 * (t % 3))}" for t in range(30)]
    path = write_toy(tmp_path, ("path: toy.csv", "path: toy.csv\n  outliers: leave out"))
    (tmp_path / "toy.csv").write_text("t_ms,x_um\n" + "\n".join(rows))
    (problem,) = build(load_config(path))
    (told,) = problem.observations.doubts
    assert told.code == "down-weighted"
    assert told.words.endswith("say: 1 of 30, at 8 ms")
    assert "note: toy: readings left out" in CliRunner().invoke(main, ["validate", str(path)]).output


@pytest.mark.parametrize(("heights", "window", "told"), [
    ((96, 100, 90), "from: maximum, to: minimum", "rise to 96 % of their largest once more, at 3 ms of the file"),
    ((100, 60, 99), "from: maximum, to: minimum", "rise to 99 % of their largest once more, at 23 ms of the file"),
    ((100, 60, 30), "from: maximum, to: minimum", ""),
    ((96, 100, 90), "from: 10 ms, to: 20 ms", ""),
    ((100, -98, 96), "from: maximum, to: minimum", ""),
])  # fmt: skip
def test_several_shots_in_a_file_are_told_where_the_window_takes_the_largest(tmp_path, heights, window, told):
    rows = [f"{t},{heights[t // 10] * (1 - 0.025 * (t % 10 - 3) ** 2) + 5:.3f}" for t in range(30)]
    path = write_toy(tmp_path, ("path: toy.csv", f"path: toy.csv\n  time_zero: window\n  window: {{{window}}}"))
    (tmp_path / "toy.csv").write_text("t_ms,x_um\n" + "\n".join(rows))
    (problem,) = build(load_config(path))
    words = [doubt.words for doubt in problem.observations.doubts]
    assert told in "".join(words)
    assert bool(words) == bool(told)


def test_a_share_of_the_maximum_is_that_of_each_data_set(tmp_path: Path) -> None:
    prior = "{prior: normal, mean: maximum, std: 1 %}"
    path = write_toy(tmp_path, ("toy.csv", "'*.csv'"), (prior, prior.replace("maximum", "13 % of maximum")))
    (tmp_path / "toy2.csv").write_text("t_ms,x_um\n" + "\n".join(f"{5 * i},{300 - 2 * i}" for i in range(25)))
    assert [problem.prior.terms[0].mean for problem in build(load_config(path))] == pytest.approx([13e-6, 39e-6])
    assert [problem.prior.terms[0].std for problem in build(load_config(path))] == pytest.approx([13e-8, 39e-8])
    whole, share = (load_config(path, {"parameters.A.mean": where}) for where in ("maximum", "100 % of the maximum"))
    of_whole, of_share = ([p.prior.terms[0].mean for p in build(config)] for config in (whole, share))
    assert of_whole == pytest.approx([1e-4, 3e-4])
    assert of_share == pytest.approx(of_whole)


@pytest.mark.parametrize(("mean", "share"), [("first", 1.0), ("40 % of first", 0.4), ("40 % of the first", 0.4)])
def test_a_share_of_the_first_reading_is_that_of_each_data_set_in_its_window(
    tmp_path: Path, mean: str, share: float
) -> None:
    path = write_toy(tmp_path, ("toy.csv", "'*.csv'"), ("mean: maximum", f"mean: {mean}"))
    (tmp_path / "toy2.csv").write_text("t_ms,x_um\n" + "\n".join(f"{5 * i},{300 - 2 * i}" for i in range(25)))
    problems = build(load_config(path, {"data.window.from": "10 ms"}))
    firsts = [float(problem.observations.values[0]) for problem in problems]
    assert firsts[1] == pytest.approx(296e-6)
    assert [problem.prior.terms[0].mean for problem in problems] == pytest.approx([share * y for y in firsts])


@pytest.mark.parametrize(
    ("where", "told"),
    [
        ("0 % of maximum", "must be positive, not 0 % of maximum"),
        ("-5 % of maximum", "must be positive, not -5 % of maximum"),
        ("x % of maximum", "'x %' is not a quantity"),
        (
            "5 % of minimum",
            "'5 % of minimum' is no share; write a number in % of maximum or first, as '5 % of maximum'",
        ),
        ("5 of maximum", "'5 of maximum' is no share"),
        ("13 um of maximum", "'13 um of maximum' is no share"),
    ],
)
def test_what_is_no_share_of_the_maximum_is_told_in_place(tmp_path: Path, where: str, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(write_toy(tmp_path, ("mean: maximum", f"mean: {where}")))
    (fault,) = caught.value.problems
    assert fault.path == "parameters.A.mean"
    assert told in fault.message
