"""Windows that are lengthened step by step, where J of the whole window has too many minima.

A chaotic model has about as many minima as its trajectories part within the window. J of its beginning has one, and the
minimum of a window lies near that of the window a little shorter: each descent starts where the one before it ended
(quasi-static variational assimilation: Pires, Vautard & Talagrand 1996, Tellus A 48, 96; Swanson, Vautard & Pires 1998,
Tellus A 50, 369). Readings after the end of a window have the weight zero, and correlated errors count as independent
on the way there, where windows only lead on; the whole window has R as it is.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from en4dvar.data.noise import noise_of
from en4dvar.descent.loop import minimise
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis.analysis import Record, StartRecord
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes.base import Minimiser

ROUGH = 1e-2  # relative decrease of J at which the descent of a window that will be lengthened ends


def shortened(space: WeightSpace, scheme: Minimiser) -> Iterator[WeightSpace]:
    """The data set in the first 1/L, 2/L, … of the time of its readings, L = ``scheme.lengthen``, the whole left out.

    A window that holds no more readings than the one before is left out, too.
    """
    observations, tolerance = space.problem.observations, max(ROUGH, scheme.cost_tolerance)
    noise = observations.noise
    if not noise.independent and not space.problem.discrepancy:
        noise = noise_of(noise.std, noise.time_std)
    settings = replace(space.settings, own=replace(scheme, lengthen=1, cost_tolerance=tolerance))
    (begin, end), counted, of_all = observations.span, 0, int(np.sum(observations.weights > 0))
    for j in range(1, scheme.lengthen):
        inside = observations.times <= begin + (end - begin) * j / scheme.lengthen
        weights = np.where(inside, observations.weights, 0.0)
        if counted < (counted := int(np.sum(weights > 0))) < of_all:
            problem = replace(space.problem, observations=replace(observations, weights=weights, noise=noise))
            yield WeightSpace(problem, settings, space.seed, space.executor)


def lengthened(
    space: WeightSpace, scheme: Minimiser, first: Callable[[WeightSpace], Descent], tell: Callable[[Record], None]
) -> Array:
    """Weights (N,) at the end of the last but one window; ``first`` finds the descent of the first one.

    Nothing is kept of it: a resumed run repeats it. Raises :class:`ConfigError` where all readings are at one time.
    """
    w: Array | None = None
    for number, short in enumerate(shortened(space, scheme)):
        descent = first(short) if w is None else Descent(short.start(w))
        descent.ended = False
        minimise(DataWindow(short, space.seed, lambda: None, lambda record: None), [descent])
        w = descent.weights.w
        space.forward_runs += short.forward_runs
        tell(StartRecord(number + 1, (descent.cost,), 1))
    if w is None:
        raise ConfigError("all readings are at one time; there is no window to lengthen", "assimilation.lengthen")
    return w
