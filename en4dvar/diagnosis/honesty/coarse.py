"""Whether the times of a model's own outputs are too far apart for the readings between them."""

import numpy as np

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.checks import CLOCK, Findings, moments
from en4dvar.plumbing.caution import caution

TOLD = 0.5  # of the readings' error that interpolation may be off by
STRAIGHT = 1e-9  # change of a slope, over the largest that rounding could make one of all the values


def coarse(analysis: Analysis) -> Findings:
    """Predictions that are straight lines with turns, where the model says that they are interpolated.

    Between outputs h apart with a turn Δ of the slope a smooth curve is h Δ/8 off the straight line. It takes three
    readings between two outputs to see it.
    """
    a = analysis
    for part in a.problem.parts:
        t, y, std = (of_all[part.where] for of_all in (a.observations.times, a.centre_predictions, a.own_std))
        steps = np.diff(t)
        if part.observable.name not in a.problem.model.interpolated or len(t) < 3 or not np.all(steps > 0):
            continue
        turns = np.diff(np.diff(y) / steps)
        straight = np.abs(turns) * np.minimum(steps[1:], steps[:-1]) <= STRAIGHT * np.max(np.abs(y))
        bent = np.flatnonzero(~straight)
        groups = np.split(bent, np.flatnonzero(np.diff(bent) > 1) + 1)  # a turn between two readings shows at both
        if 2 * straight.sum() < len(turns) or len(groups) < 2:
            continue
        places = np.array([group[0] + 1 for group in groups])
        gap = float(np.median(np.diff(t[places])))
        share = gap / 8 * np.abs([turns[group].sum() for group in groups]) / std[places]
        if share[worst := int(np.argmax(share))] > TOLD:
            words = (
                f"the model's outputs of {part.observable.name} seem to be about {len(t) / (len(groups) + 1):.2g} "
                f"readings apart, with straight lines between them: near {moments(a)[part.begin + places[worst]]} "
                f"{CLOCK} these would be off by about {share[worst]:.2g} times the readings' error"
            )
            yield caution("coarse-outputs", words)
