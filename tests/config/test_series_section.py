"""``data.series``: what it comes to, and one located message for everything that can be wrong with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.data.noise import BlockNoise
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.runs.checks import validate

YAML = """\
name: two
seed: 3
model: {name: "problem.series_models:Two"}
data:
  path: pq.csv
  columns:
    time: {name: t, unit: s}
  series:
    p:
      columns: {p: {name: p, unit: "1"}}
      error: {p_std: 0.1}
    q:
      columns: {q: {name: q, unit: cm}}
      error: {q_std: 5 cm}
    heads:
      observable: f
      path: f.csv
      columns: {f: {name: f, unit: "1"}}
      places: {column: x, unit: m}
      weights: {column: w}
      error: {f_std: 0.2}
  correlation:
    p: {q: 0.5}
parameters:
  a: {prior: normal, mean: 0, std: 2}
  b: {prior: normal, mean: 0, std: 2}
assimilation: {members: 12}
"""
PQ = "t,p,q\n" + "".join(f"{0.1 * i:.1f},{1 + 0.05 * i},{200 - 0.5 * i * i}\n" for i in range(1, 8))
HEADS = "t,x,cell,f,w\n" + "".join(
    f"{t},{x},{c},{x + t},{0.5 + c}\n" for t in (0.5, 0.2) for x, c in ((0, 0), (2.5, 1))
)


def write(folder: Path, *changes: tuple[str, str], heads: str = HEADS) -> Path:
    text = YAML
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    (folder / "two.yaml").write_text(text, encoding="utf-8")
    (folder / "pq.csv").write_text(PQ, encoding="utf-8")
    (folder / "f.csv").write_text(heads, encoding="utf-8")
    return folder / "two.yaml"


def observations(folder: Path, *changes: tuple[str, str]):
    (problem,) = build(load_config(write(folder, *changes)))
    return problem.observations


def test_what_is_said_once_holds_for_all(tmp_path: Path) -> None:
    found = observations(tmp_path)
    assert [(p.name, p.observable.name, p.begin, p.end) for p in found.parts] == [
        ("p", "p", 0, 7), ("q", "q", 7, 14), ("heads", "f", 14, 18),
    ]  # fmt: skip
    assert found.name == "pq"
    assert found.values[7:9] == pytest.approx([1.995, 1.98])  # m
    assert found.std == pytest.approx([0.1] * 7 + [0.05] * 7 + [0.2] * 4)
    assert found.times[14:] == pytest.approx([0.2, 0.2, 0.5, 0.5])  # several readings at a time, in any order
    assert found.parts[2].places is not None
    assert found.parts[2].places.positions.tolist() == [0, 2.5, 0, 2.5]
    assert found.weights[14:].tolist() == [0.5, 1.5, 0.5, 1.5]
    assert isinstance(found.noise, BlockNoise)
    matrix = found.noise.correlation.toarray()
    assert np.array_equal(matrix[:7, 7:14], 0.5 * np.eye(7))


def test_a_data_set_has_the_name_that_is_given(tmp_path: Path) -> None:
    path = write(tmp_path, ("  path: pq.csv", "  path: pq.csv\n  name: gel 3"))
    (problem,) = build(load_config(path))
    assert problem.observations.name == "gel 3"
    again = tmp_path / "again.yaml"
    again.write_text(load_config(path).resolved, encoding="utf-8")
    (problem,) = build(load_config(again))
    assert problem.observations.name == "gel 3"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("path: pq.csv", "path: pq.csv\n  name: a/b", "data.name:"),
        ("path: pq.csv", "path: [pq.csv, f.csv]\n  name: gel", "name: gel is that of one data set, and there are 2"),
        ("      observable: f", "      name: g\n      observable: f", "a data set has one name; write it above"),
    ],
)
def test_names_that_cannot_be(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises((ConfigError, DataError)) as error:
        validate(write(tmp_path, (old, new)))
    assert str(error.value).count("two.yaml:") == 1, str(error.value)
    assert message in str(error.value)


def test_the_resolved_file_says_the_same(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "again.yaml").write_text(config.resolved, encoding="utf-8")
    (problem,) = build(load_config(tmp_path / "sub" / "again.yaml"))
    (first,) = build(config)
    for key in ("times", "values", "weights", "std"):
        assert np.array_equal(getattr(problem.observations, key), getattr(first.observations, key))
    assert np.array_equal(
        problem.observations.noise.matrices()["correlation"][0], first.observations.noise.matrices()["correlation"][0]
    )


@pytest.mark.parametrize(
    ("written", "positions"),
    [("2", [2.0] * 4), ("[0, 4, 1, 1]", [0, 4, 1, 1]), ("3.5 m", [3.5] * 4), ("[0 m, 4 m, 100 cm, 1 m]", [0, 4, 1, 1]),
     ("{column: cell}", [0, 1, 0, 1])],
)  # fmt: skip
def test_places(tmp_path: Path, written: str, positions: list[float]) -> None:
    found = observations(tmp_path, ("{column: x, unit: m}", written))
    assert found.parts[2].places is not None
    assert found.parts[2].places.positions == pytest.approx(positions)


def test_weights_by_a_list_a_function_and_the_distance_from_minima(tmp_path: Path) -> None:
    (tmp_path / "weights.py").write_text(
        "def early(times, values):\n    return (times < 0.3) * 2.0\n", encoding="utf-8"
    )
    change = "error: {p_std: 0.1}"
    found = observations(tmp_path, (change, f"{change}\n      weights: {{function: ./weights.py:early}}"), CORRELATED)
    assert found.weights[:7].tolist() == [2.0, 2.0, 0, 0, 0, 0, 0]
    found = observations(tmp_path, (change, f"{change}\n      weights: [0, 0, 1, 1, 2, 1, 1]"), CORRELATED)
    assert found.weights[:7].tolist() == [0, 0, 1, 1, 2, 1, 1]


def test_weights_that_are_zero_near_minima(tmp_path: Path) -> None:
    path = write(tmp_path, ("p_std: 0.1}", "p_std: 0.1}\n      weights: {zero_near_minima: 0.11 s}"), CORRELATED)
    dip = [1.0, 0.9, 0.5, 0.9, 1.0, 1.1, 1.2]
    rows = "".join(f"{0.1 * i:.1f},{p},{200 - 0.5 * i * i}\n" for i, p in enumerate(dip, 1))
    (tmp_path / "pq.csv").write_text("t,p,q\n" + rows, encoding="utf-8")
    (problem,) = build(load_config(path))
    assert problem.observations.weights[:7].tolist() == [1, 0, 0, 0, 1, 1, 1]


CORRELATED = ("  correlation:\n    p: {q: 0.5}\n", "")


def test_balanced_series_and_groups(tmp_path: Path) -> None:
    balanced = ("{members: 12}", "{members: 12, weights: balanced}")
    found = observations(tmp_path, balanced)
    assert [found.weights[p.where].sum() for p in found.parts] == pytest.approx([6, 6, 6])  # Σβ = 7 + 7 + 4
    grouped = [(f"      error: {{{name}_std", f"      group: together\n      error: {{{name}_std") for name in "pq"]
    found = observations(tmp_path, balanced, *grouped)
    assert [found.weights[p.where].sum() for p in found.parts] == pytest.approx([4.5, 4.5, 9])


FAULTS = [
    ("observable: f", "observable: g", "16:19: data.series.heads.observable: unknown observable 'g'"),
    ("      observable: f\n", "", "15:5: data.series.heads: unknown observable 'heads'; known: p, q, f; of"),
    ("    heads:\n", "    he ads:\n", "15:5: data.series.he ads: 'he ads' cannot be the name of a series"),
    ("p: {q: 0.5}", "p: {z: 0.5}", "23:9: data.correlation.p.z: no other series 'z'"),
    ("p: {q: 0.5}", "z: {q: 0.5}", "23:5: data.correlation.z: no series 'z'"),
    ("p: {q: 0.5}", "p: {q: 1.5}", "23:12: data.correlation.p.q: should be less than 1"),
    ("p: {q: 0.5}", "p: {q: 0.5}\n    q: {p: 0.4}", "data.correlation.q.p: given as p: {q: …} as well"),
    ("unit: s}", "unit: kg}", "7:27: data.columns.time.unit:"),
    ("  path: pq.csv", "  decimol: .\n  path: pq.csv", "5:3: data.decimol: unknown key 'decimol'; did you mean"),
    ("q_std: 5 cm", "q_std: 5 kg", "14:22: data.series.q.error.q_std:"),
    ("q_std: 5 cm", "q_std: 5 cm, p_std: 5 cm", "data.series.q.error.p_std: unknown key 'p_std'"),
    ("p_std: 0.1}", "p_std: 0.1, discrepancy: estimated}", "series.p.error.discrepancy: a discrepancy is that"),
    ("{column: x, unit: m}", "{column: x, unit: kg}", "data.series.heads.places.unit:"),
    ("      places: {column: x, unit: m}\n", "", "data.series.heads.places: required: 'f' is a field of 5 values"),
    ("      places:", "      outliers: leave out\n      places:", "series.heads.outliers: not together with places"),
    ("{column: x, unit: m}", "{columm: x}", "data.series.heads.places: write an index, a coordinate"),
    ("{column: x, unit: m}", "7", "7 is not the index of a component of the field; they go from 0 to 4"),
    ("{column: x, unit: m}", "[0, 1]", "2 places for 4 observations"),
    ("{column: x, unit: m}", "9 m", "place 9 m lies outside 0 to 6 m"),
    ("{column: x, unit: m}", "3 kg", "data.series.heads.places:"),
    ("{column: w}", "{column: v}", "no column 'v'"),
    ("{column: w}", "[1, 2]", "2 weights for 4 observations"),
    ("{column: w}", "[1, 2, -1, 0]", "data.series.heads.weights.2: should be greater"),
    ("{column: w}", "[1, 2, .inf, 0]", "data.series.heads.weights.2: should be a finite number"),
    ("{column: w}", "{colum: w}", "data.series.heads.weights: write a list"),
    ("{column: w}", "half", "data.series.heads.weights: write a list"),
    ("{column: w}", "[0, 0, 0, 0]", "all weights are zero"),
    ("{column: w}", "{function: ./nowhere.py:f}", "data.series.heads.weights.function:"),
    ("{column: w}", "{function: f}", "is not a function in a file"),
    ("{column: w}", "{zero_near_minima: 3 kg}", "data.series.heads.weights.zero_near_minima:"),
    ("f.csv", "g.csv", "17:13: data.series.heads.path:"),
    ("weights: {column: w}", "group: [1]\n      weights: {column: w}", "data.series.heads.group:"),
    ("mean: 0, std: 2}\n  b", "mean: maximum, std: 2}\n  b", "'maximum' is defined only for a single series"),
    ("mean: 0, std: 2}\n  b", "mean: 0, std: 2, shared: all}\n  b", "parameters.a.shared: not where a data set"),
    ("parameters:\n", "parameters:\n  reading_scale: {prior: lognormal, median: 1, log_std: 0.1}\n",
     "25:18: parameters.reading_scale: cannot be one number for several series"),
    ("path: pq.csv", "path: -1", "5:9: data.path: expected text; put it in quotes or expected a list"),
    ("path: pq.csv", "path: [1]", "5:10: data.path.0: expected text; put it in quotes, not 1"),
    ("columns: {p: {name: p, unit: \"1\"}}", "columns: {}", "columns.p: required: the column of p"),
    ("time: {name: t, unit: s}\n", "time: {name: t, unit: s}\n    z: 1\n", "data.columns.z: unknown column role 'z'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), FAULTS, ids=[f[2][:40] for f in FAULTS])
def test_one_located_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write(tmp_path, (old, new))
    with pytest.raises(ConfigError) as error:
        validate(path)
    told = [str(fault) for fault in error.value.problems]
    assert len(told) == 1, told
    assert message in told[0], told[0]
    assert f"{path}:" in told[0]


def test_columns_of_weights_and_places_that_cannot_be(tmp_path: Path) -> None:
    for row, message in (("0.2,0,0,0.2,-1", "the weight of reading 1 in column 'w' is -1, negative"),
                         ("0.2,,0,0.2,1", "the place of reading 1 in column 'x' is blank")):  # fmt: skip
        heads = f"t,x,cell,f,w\n{row}\n" + "".join(HEADS.splitlines(keepends=True)[1:])
        with pytest.raises(DataError, match=message):
            build(load_config(write(tmp_path, heads=heads)))


def test_campaigns_pair_the_files_of_each_series_by_their_names(tmp_path: Path) -> None:
    for folder in ("p", "q"):
        (tmp_path / folder).mkdir()
        for name in ("one", "two"):
            (tmp_path / folder / f"{name}.csv").write_text(PQ, encoding="utf-8")
    changes = [
        ("  path: pq.csv\n", ""), ("    p:\n", "    p:\n      path: p\n"), ("    q:\n", "    q:\n      path: q\n"),
        (YAML[YAML.index("    heads:"):YAML.index("  correlation:")], ""),
    ]  # fmt: skip
    found = build(load_config(write(tmp_path, *changes)))
    assert [p.observations.name for p in found] == ["one", "two"]
    (tmp_path / "q" / "two.csv").rename(tmp_path / "q" / "three.csv")
    with pytest.raises(DataError, match=r"each data set needs a file of the same name in every series; not so two"):
        build(load_config(write(tmp_path, *changes)))
