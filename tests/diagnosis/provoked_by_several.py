"""Campaigns that provoke each warning about several data sets, and what somebody does who follows its advice."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from estimation.test_agreement import campaign

from en4dvar.plumbing.caution import Caution
from en4dvar.problem import InverseProblem

Campaign = list[InverseProblem]


def left_out(problems: Campaign, told: Caution) -> Campaign:
    """Without the data sets that are named."""
    assert "left out" in told.advice
    return [p for p in problems if f"{p.observations.name} (" not in told.words]


def larger_errors(problems: Campaign, told: Caution) -> Campaign:
    times = re.search(r"state them ([\d.]+) times as large", told.advice)
    assert times
    assert "(en4dvar population --of a)" in told.advice
    return [replace(p, observations=scaled(p.observations, float(times[1]))) for p in problems]


def scaled(observations, factor):
    return replace(observations, noise=replace(observations.noise, std=factor * observations.noise.std))


def without_drift(problems: Campaign, told: Caution) -> Campaign:
    """What is left to judgement: the drift that was looked for, and found, is taken out of the readings."""
    assert "a drift" in told.advice
    return [
        replace(p, observations=replace(p.observations, values=p.observations.values - e / 7))
        for e, p in enumerate(problems)
    ]


OF_SEVERAL: dict[str, tuple[Callable[[], Campaign], Callable[[Campaign, Caution], Campaign]]] = {
    "odd-data-set": (lambda: campaign([0.0] * 7 + [0.6, 0.0]), left_out),
    "data-sets-differ": (lambda: campaign(0.5 * np.random.default_rng(5).standard_normal(10)), larger_errors),
    "trend": (lambda: campaign(np.linspace(0, 1, 8)), without_drift),
}
