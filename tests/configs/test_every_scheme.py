"""Every registered scheme runs from YAML: on the data of one set, and on a series."""

from __future__ import annotations

from pathlib import Path

import pytest

from en4dvar.assembly.build import build
from en4dvar.config import load_config, load_twin
from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes import ON_A_SERIES, ON_A_WINDOW, SCHEMES
from en4dvar.series.twin import conduct

# a baseline's members run freely: the std of the model, and 0.95 of that of the observations
EXPECTED = {"climatology": 3.8, "optimal-interpolation": 0.99}
OTHERWISE: dict[str, dict[str, object]] = {
    "particle-filter": {"inflation": 1.0, "rotation": False, "members": 200},
    "optimal-interpolation": {"inflation": 1.0, "members": 25},
}
CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_every_scheme_runs_on_something():
    assert SCHEMES.keys() == ON_A_WINDOW.keys() | ON_A_SERIES.keys()


@pytest.mark.parametrize("scheme", ON_A_WINDOW)
def test_parameters_of_one_bubble(scheme):
    config = load_config(CONFIGS / "quickstart.yaml", {"assimilation.scheme": scheme})
    (problem,) = build(config)
    analysis = assimilate(problem, config.assimilation, config.seed)
    assert analysis.settings.scheme == scheme
    assert analysis.iterations[-1].cost < 0.5 * analysis.iterations[0].cost
    prior, posterior = (ensemble.std(axis=0) for ensemble in (analysis.prior, analysis.posterior))
    assert (posterior < prior).sum() >= 4  # of five parameters


@pytest.mark.parametrize("scheme", ON_A_SERIES)
def test_a_chaotic_series_is_followed(scheme):
    """Lorenz-96, every variable observed with an error of 1: an analysis is better than its observations.

    The inflation is enough for any filter of 40 members, one with perturbed observations included. Particles need more.
    """
    changes = {"scheme": scheme, "inflation": 1.06, "members": 40} | OTHERWISE.get(scheme, {})
    small = {"model.size": 4} if scheme == "particle-filter" else {}
    changes = {f"assimilation.{key}": value for key, value in changes.items()} | small
    config = load_twin(CONFIGS / "lorenz96_etkf.yaml", changes | {"twin.cycles": 150, "twin.burn_in": 100})
    assert conduct(config.experiment, config.seed).scores["analysis"].mean_rmse < EXPECTED.get(scheme, 0.5)


def test_es_mda_runs_each_ensemble_once():
    """Four assimilations of 100 members: five ensembles, each with its mean, and two members again."""
    plain = {"assimilation.emulator": "off", "assimilation.what_if": False}
    changes = {"assimilation.scheme": "es-mda", "assimilation.members": 100, **plain}
    config = load_config(CONFIGS / "quickstart.yaml", changes)
    (problem,) = build(config)
    assert assimilate(problem, config.assimilation, config.seed).forward_runs == 5 * 101 + 2
