"""``en4dvar simulate`` of several series: one table, against the closed form, that the same file reads again."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from problem.series_models import CELLS

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.config.document import read_document
from en4dvar.config.kinds import resolve_campaign
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.units import UnitError
from en4dvar.runs.simulation import draw_campaign, noise_level, simulate, to_csv, write_campaign

YAML = """\
name: two
model: {name: "problem.series_models:Two"}
data:
  path: two.csv
  columns:
    time: {name: t, unit: ms}
  series:
    p: {columns: {p: {name: p, unit: "1"}}, error: {p_std: 0.1}}
    q: {columns: {q: {name: q, unit: cm}}, error: {q_std: 5 cm}}
    well: {observable: f, places: 3.5 m, columns: {f: {name: f, unit: "1"}}, error: {f_std: 0.1}}
parameters:
  a: {prior: normal, mean: 3, std: 2}
  b: 2
simulate: {times: {from: 100 ms, to: 500 ms, step: 100 ms}}
assimilation: {members: 12}
"""
TIMES = np.linspace(0.1, 0.5, 5)


def write(folder: Path, text: str = YAML) -> Path:
    (folder / "two.yaml").write_text(text, encoding="utf-8")
    return folder / "two.yaml"


def test_all_series_at_the_same_instants_in_one_table_that_is_read_again(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    found = simulate(config)
    at = np.interp(3.5, CELLS, CELLS)
    exact = {"p": 3 + 2 * TIMES, "q": 6 - 2 * TIMES**2, "well": 3 * at + 2 * TIMES}
    assert found.times == pytest.approx(TIMES)
    assert list(found.series) == list(exact)
    for name, values in exact.items():
        assert found.series[name] == pytest.approx(values), name
    (tmp_path / "two.csv").write_text(to_csv(found, config), encoding="utf-8")
    (problem,) = build(config)
    assert problem.observations.values == pytest.approx(np.concatenate(list(exact.values())), rel=1e-8)
    again = simulate(load_config(write(tmp_path, YAML.replace("simulate:", "# simulate:"))))
    assert again.times == pytest.approx(TIMES)  # those of the data


def test_instants_are_a_sequence_that_increases_from_zero(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    found = simulate(config, [0, 1])
    assert found.series["p"] == pytest.approx([3, 5])
    for wrong in ([1, 0], [0, 1, 1], [], [[0, 1]], 1.0, [0, np.nan], ["0 s"]):
        with pytest.raises(ConfigError, match="times: give a one-dimensional sequence of increasing numbers, in s"):
            simulate(config, wrong)
    with pytest.raises(ConfigError, match=r"times: -0\.5 s is before the model's clock begins"):
        simulate(config, (-0.5, 1.0))


def test_noise_has_a_seed_and_a_std_of_each_series(tmp_path: Path) -> None:
    found = simulate(load_config(write(tmp_path)))
    with pytest.raises(ConfigError, match="seed: must not be negative, not -1"):
        found.with_noise(0.1, -1)
    for std in (-0.1, {"p": 0.1}, np.nan):
        with pytest.raises(ConfigError, match="std: give one for all series, or of each: p, q, well"):
            found.with_noise(std, 1)


def test_noise_in_the_unit_of_one_series_says_what_is_of_each(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    words = "--noise of p: '2 cm': unit 'cm' cannot be converted to '1'; of several series, '1 % of maximum' is of each"
    with pytest.raises(UnitError, match=re.escape(words)):
        noise_level("2 cm", config, simulate(config))


def test_noise_is_a_share_of_each_series(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    found = simulate(config, np.linspace(0.1, 0.5, 4000))
    stds = noise_level("1 % of maximum", config, found)
    assert stds == pytest.approx({name: 0.01 * values.max() for name, values in found.series.items()})
    noisy = found.with_noise(stds, 3)
    noise = {name: noisy.series[name] - values for name, values in found.series.items()}
    for name, values in noise.items():
        assert values.std() == pytest.approx(stds[name], rel=0.05), name
    assert abs(np.corrcoef(noise["p"], noise["q"])[0, 1]) < 0.05


def test_a_series_of_many_places_is_refused(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, YAML.replace("places: 3.5 m", "places: {column: x, unit: m}")))
    with pytest.raises(ConfigError, match="well is read at many places"):
        simulate(config)


def test_a_campaign_on_another_scale_loses_no_digits(tmp_path):
    """Pulses of nanoseconds and picometres of a model that shows seconds and micrometres."""
    path = tmp_path / "twin.yaml"
    path.write_text(
        "name: twin\nseed: 3\nmodel: {name: toy_models:Oscillator, mass: 2e-9 g}\ncampaign: {directory: data, "
        "first: [0 s, 0.1 us], spacing: [50 ns, 80 ns], stop: 0.1, most: 40, noise: 1 fm, groups: "
        "{a: {datasets: 1, parameters: {A: 1 pm, k: 3 N/m, c: 0 N s/m}}}}\n"
    )
    plan = resolve_campaign(read_document(path), tmp_path)
    (drawn,) = sets = draw_campaign(plan)
    write_campaign(plan, sets, tmp_path / "data", "simulate")
    told = np.genfromtxt(tmp_path / "data" / "a_01.csv", delimiter=",", comments="#", skip_header=4)
    np.testing.assert_allclose(told[:, 0], drawn.times, rtol=0, atol=50e-12)
    np.testing.assert_allclose(1e-6 * told[:, 1], drawn.values, rtol=0, atol=1e-18)
