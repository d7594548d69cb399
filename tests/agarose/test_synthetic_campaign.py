"""The synthetic campaign: what is drawn, what is told, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.config.document import override, parse_document, read_document
from en4dvar.config.kinds import resolve_campaign, terms_and_fixed
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.simulation import draw_campaign, write_campaign

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def plan(**changes):
    return resolve_campaign(override(read_document(CONFIGS / "agarose_twin.yaml"), changes), CONFIGS)


@pytest.fixture(scope="module")
def sets():
    return draw_campaign(plan())


def test_shipped_files_are_what_the_configuration_draws(tmp_path):
    """To 1 % of the noise: beside a collapse the radius shows the tolerance of the solver, whose bits may change."""
    out = tmp_path / "twin"
    result = CliRunner().invoke(main, ["simulate", str(CONFIGS / "agarose_twin.yaml"), "--out", str(out)])
    assert result.exit_code == 0, result.output
    shipped = CONFIGS / "data" / "agarose_twin"
    assert sorted(p.name for p in out.iterdir()) == sorted(p.name for p in shipped.iterdir())
    for file in out.iterdir():
        told = [line for line in file.read_text().splitlines() if not line.startswith("#")]
        kept = [line for line in (shipped / file.name).read_text().splitlines() if not line.startswith("#")]
        assert told[0] == kept[0]
        assert [row.split(",")[0] for row in told[1:]] == [row.split(",")[0] for row in kept[1:]]
        if file.name != "truth.csv":
            assert "SYNTHETIC" in file.read_text().splitlines()[0]
            np.testing.assert_allclose(
                np.loadtxt(told[1:], delimiter=","), np.loadtxt(kept[1:], delimiter=","), atol=2e-3
            )


SMALL = """
name: small
model: {name: toy_models:Oscillator}
campaign:
  directory: data
  first: [0 s, 1e-8 s]
  spacing: [1e-7 s, 2e-7 s]
  stop: 0.3
  noise: 1e-12 m
  groups: {a: {datasets: 1, parameters: {A: 1e-10 m, k: 1e12 N/m, c: 0.0 N s/m}}}
"""


def test_small_readings_and_short_times_are_written_with_their_digits(tmp_path):
    """Of an oscillation of 1 MHz and 0.1 nm, in s and µm; five decimals would be zeros."""
    drawn = resolve_campaign(parse_document(SMALL, "small.yaml"), tmp_path)
    (one,) = draw_campaign(drawn)
    write_campaign(drawn, (one,), tmp_path / "data", "simulate")
    times, values = np.loadtxt(tmp_path / "data" / "a_01.csv", delimiter=",", skiprows=4).T
    np.testing.assert_allclose(times, one.times, rtol=0, atol=1e-10)
    np.testing.assert_allclose(1e-6 * values, one.values, rtol=0, atol=1e-15)


def test_numbers_of_the_experiment(sets):
    assert [sum(s.group == g for s in sets) for g in ("agarose_03", "agarose_10")] == [19, 20]
    fits = np.array([s.nrmse for s in sets])
    assert np.all((fits > 0.94) & (fits < 0.99))
    gaps = np.concatenate([np.diff(s.times) for s in sets])
    assert np.all((gaps >= 1.25e-6) & (gaps <= 2e-6))
    shifts = np.array([s.truth["t_s"] for s in sets])
    assert np.all(np.abs(shifts) <= 0.8e-6)
    assert np.std(shifts) > 0.3e-6
    for s in sets:
        top = np.maximum.accumulate(s.values)
        assert s.values[-1] < 0.35 * top[-1]
        assert np.all(s.values[:-1] >= 0.35 * top[:-1])


def test_truths_have_the_moments_of_table_1():
    """5000 draws of the distributions: mean and standard deviation within four standard errors."""
    many = plan()
    paper = {"G": (420.0, 62.0), "alpha": (0.029, 0.011), "mu": (0.086, 0.024), "R0": (0.43e-6, 0.31e-6)}
    rng = np.random.default_rng(0)
    terms, _ = terms_and_fixed(many.file.campaign.groups["agarose_03"].parameters)
    for term in terms:
        values = term.to_physical(term.mean + term.std * rng.standard_normal(5000))
        mean, std = paper[term.parameter.name]
        assert np.all(values > 0)
        assert abs(values.mean() - mean) < 4 * std / np.sqrt(5000)
        assert values.std() == pytest.approx(std, rel=0.15)


def test_more_data_sets_leave_the_first_as_they_were(sets):
    fewer = draw_campaign(plan(**{"campaign.groups.agarose_03.datasets": 2, "campaign.groups.agarose_10.datasets": 1}))
    by_name = {s.name: s for s in sets}
    for s in fewer:
        np.testing.assert_array_equal(s.values, by_name[s.name].values)


def test_faults_are_located():
    with pytest.raises(ConfigError) as caught:
        plan(**{"campaign.noise": "1.2 kPa", "campaign.groups.agarose_03.parameters": {"G": "1 kPa"}})
    told = str(caught.value)
    assert "campaign.noise" in told
    assert "campaign.groups.agarose_03.parameters.mu" in told


@pytest.mark.parametrize(("name", "value"), [("reading_scale", "1.03"), ("sigma", "1.5"), ("t_s", "1 us")])
def test_a_campaign_makes_its_own_readings(name, value):
    """What only a fit has is refused, where it would be ignored."""
    with pytest.raises(ConfigError, match=rf"agarose_03\.parameters\.{name}: a campaign makes its own readings"):
        plan(**{f"campaign.groups.agarose_03.parameters.{name}": value})


def test_an_existing_campaign_is_not_overwritten(tmp_path):
    (tmp_path / "truth.csv").write_text("mine")
    result = CliRunner().invoke(main, ["simulate", str(CONFIGS / "agarose_twin.yaml"), "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "--force" in result.output
    assert (tmp_path / "truth.csv").read_text() == "mine"
