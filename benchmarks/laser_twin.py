"""Synthetic laser-induced bubbles: truths from the prior, read by a camera through collapse and rebounds.

Thirty readings from 0.7 µs on, every 1.4 µs, with Gaussian errors of 1.5 µm: the first collapse of a bubble of 250 µm
comes after some 23 µs. The design is fixed, so the posterior of an experiment is calibrated by definition. Minima of J
where both R_eq and μ are too large meet the rebound by its phase and not by its height.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from acoustic_twin import Twin
from worlds import RIGHT, World

from en4dvar.noise import noise_of
from en4dvar.observations import Observations
from en4dvar.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt

MODEL = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
MEDIANS = {"G": 4e3, "mu": 0.06, "R_eq": 35e-6}
LOG_STD = {"G": 0.5, "mu": 0.5, "R_eq": 0.2}
LARGEST, LARGEST_STD = 250e-6, 5e-6  # R_max, m
STD = 1.5e-6
TIMES = 0.7e-6 + 1.4e-6 * np.arange(30)


def laser_prior() -> Prior:
    """Lognormal about the medians, R_max ~ N(250 µm, 5 µm)."""
    parameters = {p.name: p for p in MODEL.parameters}
    terms = [PriorTerm.lognormal(parameters[k], m, LOG_STD[k]) for k, m in MEDIANS.items()]
    return Prior((*terms, PriorTerm.normal(parameters["R_max"], LARGEST, LARGEST_STD)))


def make_laser_twin(
    seed: int, model: BubbleModel = MODEL, world: World = RIGHT, more: tuple[PriorTerm, ...] = ()
) -> Twin:
    """Experiment ``seed``, fitted by ``model`` with ``more`` parameters. A truth that cannot be run is drawn again."""
    of, ones = Prior((*laser_prior().terms, *more)), np.ones(len(TIMES))
    observed = Observations(TIMES, ones, noise_of(STD * ones, 0 * ones), ones, name=f"laser{seed:04d}")
    return read_once(InverseProblem(model, model.observables[0], observed, of), [20211, seed], world)


def read_once(problem: InverseProblem, seed: list[int], world: World = RIGHT) -> Twin:
    """Readings at the times of a problem, of a truth from its prior."""
    of, observed, rng = problem.prior, problem.observations, np.random.default_rng(seed)
    while True:
        truth = of.mean + of.std * rng.standard_normal(len(of.names))
        run = world.run(problem, truth, seed[-1])
        if not run.failures[0]:
            break
    values = world.values(problem, run, rng.standard_normal(len(observed.times)), seed[-1])
    return Twin(replace(problem, observations=replace(observed, values=values)), truth)
