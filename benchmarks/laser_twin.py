"""Synthetic laser-induced bubbles: truths from the prior, read by a camera through collapse and rebounds.

Thirty readings from 0.7 µs on, every 1.4 µs, with Gaussian errors of 1.5 µm: the first collapse of a bubble of 250 µm
comes after some 23 µs. The design is fixed, so the posterior of an experiment is calibrated by definition. Minima of J
where both R_eq and μ are too large meet the rebound by its phase and not by its height.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds import RIGHT, Twin, World, read_once

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.model.state import TIME_SHIFT
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt
from en4dvar_bubble.medium import WATER_25C, saturated_vapour_pressure

MODEL = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
MEDIANS = {"G": 4e3, "mu": 0.06, "R_eq": 35e-6}
LOG_STD = {"G": 0.5, "mu": 0.5, "R_eq": 0.2}
LARGEST, LARGEST_STD = 250e-6, 5e-6  # R_max, m
STD = 1.5e-6
TIMES = 0.7e-6 + 1.4e-6 * np.arange(30)
PARAMETERS = {p.name: p for p in MODEL.parameters}
SATURATED = replace(WATER_25C, p_v=saturated_vapour_pressure(WATER_25C.T_inf))
POLYTROPIC = replace(MODEL, medium=SATURATED)
PROPOSED = replace(MODEL, gas="heat", vapour="transport", medium_heat="conducting")  # by ``en4dvar init``
STIFF = {"G": (8e3, 1.0), "mu": (0.1, 0.7), "R_eq": (48e-6, 0.4)}  # median, log_std
STIFF_TIMES = 3.7e-6 * np.arange(1, 31)


def laser_prior() -> Prior:
    """Lognormal about the medians, R_max ~ N(250 µm, 5 µm)."""
    terms = [PriorTerm.lognormal(PARAMETERS[k], m, LOG_STD[k]) for k, m in MEDIANS.items()]
    return Prior((*terms, PriorTerm.normal(PARAMETERS["R_max"], LARGEST, LARGEST_STD)))


def make_laser_twin(
    seed: int, model: BubbleModel = MODEL, world: World = RIGHT, more: tuple[PriorTerm, ...] = ()
) -> Twin:
    """Experiment ``seed``, fitted by ``model`` with ``more`` parameters. A truth that cannot be run is drawn again."""
    of, ones = Prior((*laser_prior().terms, *more)), np.ones(len(TIMES))
    observed = Observations(TIMES, ones, noise_of(STD * ones, 0 * ones), ones, name=f"laser{seed:04d}")
    return read_once(InverseProblem(model, model.observables[0], observed, of), [20211, seed], world)


def stiff_gel(seed: int, model: BubbleModel = POLYTROPIC, world: World = RIGHT) -> Twin:
    """A stiff polyacrylamide gel with the priors of ``en4dvar init``: wide, errors of 1 %, a camera of 270 kHz."""
    terms = [PriorTerm.lognormal(PARAMETERS[k], *about) for k, about in STIFF.items()]
    terms += [PriorTerm.normal(PARAMETERS["R_max"], 400e-6, 4e-6), PriorTerm.normal(TIME_SHIFT, 0.0, 0.5e-6)]
    ones = np.ones(len(STIFF_TIMES))
    observed = Observations(STIFF_TIMES, ones, noise_of(4e-6 * ones, 0 * ones), ones, name=f"stiff{seed:04d}")
    problem = InverseProblem(model, model.observables[0], observed, Prior(tuple(terms)))
    return read_once(problem, [20213, seed], world)
