"""Is there a lower minimum? Each experiment by itself, where what is shared is as a joint minimum says.

A joint minimum may hold one experiment in the wrong minimum of its own quantities, as a bubble whose radii explain
rebounds by their phase and not by their height. The others then keep what is shared about right, so that it is enough
to look at one experiment after the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from en4dvar.estimation.joint.descent import ArrowSystem, Place
from en4dvar.estimation.joint.tangent import Experiment
from en4dvar.priors.prior import member_stream

DRAWS, DEEPEST, STEPS = 48, 4, 8  # of the prior; of which are descended from; and with so many linearisations
LOWER = 0.5  # of J


def challenger(experiments: Sequence[Experiment], at: ArrowSystem, seed: int) -> Place | None:
    """The place with the own quantities of some experiments in lower minima; None where none is found."""
    place, lower = at.place, False
    own = list(place.own)
    for experiment in experiments:
        e, n = experiment.e, len(own[experiment.e])
        if not n:
            continue
        draws = member_stream(seed, f"joint challengers {e}").standard_normal((DRAWS, n))
        border = np.tile(place.border, (DRAWS, 1))
        costs = experiment.costs(experiment.joint.standard(e, border, draws)) + 0.5 * np.sum(draws**2, axis=1)
        starts = draws[np.argsort(costs, kind="stable")[:DEEPEST]]
        precision = np.broadcast_to(at.arrow.blocks[e], (DEEPEST, n, n))
        places, _, ends = experiment.settled(border[:DEEPEST], starts, precision, STEPS)
        if ends.min() < at.forms[e].cost + 0.5 * float(own[e] @ own[e]) - LOWER:
            own[e], lower = places[np.argmin(ends)], True
    return Place(place.border, tuple(own)) if lower else None
