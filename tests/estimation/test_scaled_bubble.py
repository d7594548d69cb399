"""A joint estimate of twelve bubbles of one gel, the radii of one of which are 8 % too large: it is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.joint import estimate_jointly, sharing
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt

MODEL = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
TIMES, STD, LARGEST, OFF = 0.7e-6 + 1.4e-6 * np.arange(30), 1.5e-6, 250e-6, 1.08


def bubbles(count, rng):
    """Of 6.3 kPa and 0.07 Pa s, with sizes of their own; the radii of the first are too large."""
    of = {p.name: p for p in MODEL.parameters}
    ones, problems = np.ones(len(TIMES)), []
    for i in range(count):
        off = OFF if i == 0 else 1.0
        largest = LARGEST + 5e-6 * rng.standard_normal()
        terms = [PriorTerm.lognormal(of["G"], 6e3, 0.7), PriorTerm.lognormal(of["mu"], 0.06, 0.5)]
        terms += [PriorTerm.lognormal(of["R_eq"], 35e-6, 0.2), PriorTerm.normal(of["R_max"], off * largest, 3e-6)]
        data = Observations(TIMES, ones, noise_of(STD * ones, 0 * ones), ones, name=f"bubble{i}")
        problem = InverseProblem(MODEL, MODEL.observables[0], data, Prior(tuple(terms)))
        truth = np.array([np.log(6.3e3), np.log(0.07), np.log(35e-6) + 0.1 * rng.standard_normal(), largest])
        values = off * (forecast(problem, truth[None]).predictions[0] + STD * rng.standard_normal(len(TIMES)))
        problems.append(replace(problem, observations=replace(data, values=values)))
    return problems


@pytest.mark.slow
def test_a_bubble_of_another_scale_is_named():
    joint = sharing(bubbles(12, np.random.default_rng(4)), ["G", "mu"])
    found = estimate_jointly(joint, AssimilationSettings(what_if=False), seed=1)
    assert found.odd == ("bubble0",)
    assert found.without is not None
    rest = np.log(found.without.shared) - np.log([6.3e3, 0.07])
    assert np.all(np.abs(rest.mean(axis=0)) < 3.5 * rest.std(axis=0))
    with_it = np.log(found.shared[:, 0] / 6.3e3)
    assert with_it.mean() > 4 * with_it.std()
