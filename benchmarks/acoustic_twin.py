"""Synthetic acoustic experiments: truths from the prior, read as in the paper's multi-flash imaging.

Readings are 1.25 to 1.75 µs apart from the growth until the first one below 65 % of the largest so far, with Gaussian
errors of the radius and, where asked for, of the instants. When to stop is decided by the readings, never by the
truth, so the posterior of an experiment is calibrated whatever the design. The rule leaves out, as a rule, the last
microsecond of the collapse, which no flash resolves and where the radius changes by more than its error in 10 ns.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from worlds import RIGHT, Twin, World, read_once

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.model.state import TIME_SHIFT, Array
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.solver.driver import AccuracyName, preset

MEDIANS = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
NARROW = {"G": 0.3, "alpha": 0.3, "mu": 0.3, "R0": 0.3}
WIDE = {"G": 1.0, "alpha": 1.0, "mu": 0.7, "R0": 0.7}
SHIFT_STD = 0.3e-6
STOP = 0.65  # of the largest reading so far
FEWEST = 5  # readings; a smaller set is drawn again
MODEL = BubbleModel()


def prior(log_std: dict[str, float] = NARROW, widen: float = 1.0) -> Prior:
    """Lognormal about the paper's initial guesses for 0.3 % agarose, t_s ~ N(0, 0.3 µs); spreads times ``widen``."""
    parameters = {p.name: p for p in MODEL.parameters}
    terms = [PriorTerm.lognormal(parameters[k], m, widen * log_std[k]) for k, m in MEDIANS.items()]
    return Prior((*terms, PriorTerm.normal(TIME_SHIFT, 0.0, widen * SHIFT_STD)))


def through_the_collapse(
    times: Array, log_std: dict[str, float], accuracy: AccuracyName = "standard", std: float = 1.4e-6
) -> Callable[[int], Twin]:
    """Readings at fixed ``times`` (K,) s, wherever the collapse is."""
    model, of, ones = BubbleModel(accuracy=preset(accuracy, "acoustic")), prior(log_std), np.ones(len(times))
    observed = Observations(times, ones, noise_of(std * ones, 0 * ones), ones, name="through")
    return lambda seed: read_once(InverseProblem(model, model.observables[0], observed, of), [17, seed])


def make_twin(
    seed: int,
    of: Prior,
    *,
    truths: Prior | None = None,
    std: float = 1.4e-6,
    time_std: float = 0.0,
    world: World = RIGHT,
) -> Twin:
    """Experiment ``seed``: truth from ``truths`` (default: the prior ``of``), readings of a ``world``, errors in m, s.

    A truth that cannot be integrated, or whose bubble yields fewer than 5 readings, is drawn again.
    """
    rng = np.random.default_rng([20210, seed])
    while True:
        truth = (truths or of).mean + (truths or of).std * rng.standard_normal(len(of.names))
        twin = read_twin(seed, rng, of, truth, std=std, time_std=time_std, world=world)
        if twin is not None:
            return twin


def read_twin(
    seed: int, rng: np.random.Generator, of: Prior, truth: Array, *, std: float = 1.4e-6, time_std: float = 0.0,
    world: World = RIGHT,
) -> Twin | None:  # fmt: skip
    """Readings of a truth (n,), transformed; None where it cannot be integrated, or yields too few."""
    times = 5.6e-6 + np.cumsum(rng.uniform(1.25e-6, 1.75e-6, 60))
    design = Observations(times, np.ones(60), noise_of(np.full(60, std), np.full(60, time_std)), np.ones(60))
    problem = InverseProblem(MODEL, MODEL.observables[0], design, of)
    run = world.run(problem, truth, seed)
    noise = rng.standard_normal((2, 60))
    if run.failures[0]:
        return None
    values = world.values(problem, run, noise[0], seed)
    if run.predicted.rates is not None:
        values += time_std * run.predicted.rates[0] * noise[1]
    last = np.flatnonzero(values < STOP * np.maximum.accumulate(values))
    count = last[0] + 1 if len(last) else 60
    if count < FEWEST:
        return None
    ones = np.ones(count)
    observed = Observations(
        times[:count], values[:count], noise_of(std * ones, time_std * ones), ones, name=f"twin{seed:04d}"
    )
    return Twin(InverseProblem(MODEL, MODEL.observables[0], observed, of), truth)
