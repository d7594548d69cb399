r"""What else must be known, and how well, for what is asked to become as well known as is wanted.

Scale, density and pressure cannot be told from what is asked by more readings. A measurement of parameter b alone makes
its prior std f times as large: it adds (f⁻² − 1) w wᵀ / (w wᵀ) to the prior's precision in the coordinates u of
:class:`Planned`, w the row of W of this parameter. The posterior of what is asked, by linearisation, then grows with f,
also where priors are correlated, and the largest f that allows what is wanted is found by bisection.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from en4dvar.estimation.design.laplace import shared_spread
from en4dvar.estimation.design.planned import Planned, Tangents
from en4dvar.model.state import Array

LEAST, MOST, HALVINGS = 1e-4, 1e3, 20  # factors: below it is exactly known, above it anything; to 2e-5


def in_units(planned: Planned, names: tuple[str, ...], ratio: Array, u: Array) -> tuple[Array, Array]:
    """Standard deviations of parameters (a,), given relative to the prior's in transformed space at draws ``u``.

    ``ratio`` (R, a). In their units, the mean over the draws (R, n), and relative to the value, the median; with the
    slope of the parameter map at each draw.
    """
    prior, std, relative = planned.problem.prior, np.empty(len(names)), np.empty(len(names))
    x, physical = planned.control(u), prior.to_physical(planned.control(u))
    for a, name in enumerate(names):
        j = prior.names.index(name)
        slopes = np.array([prior.terms[j].slope(float(value)) for value in x[:, j]])
        of_draws = ratio[:, a] * prior.std[j] * np.abs(slopes)
        with np.errstate(divide="ignore"):
            std[a], relative[a] = of_draws.mean(), np.median(of_draws / np.abs(physical[:, j]))
    return std, relative


def needed(
    planned: Planned, tangents: Tangents, wanted: Mapping[str, tuple[float, bool]], alike: int, scale: Array
) -> tuple[Array, Array]:
    """Factors (W, B + 1) of the prior stds of the B others, one by one and (the last) all at once.

    They are the largest that allow each of ``wanted``: name → standard deviation in its unit, or, where true, relative
    to the value. 0: not even if it were known exactly; inf: whatever it is; of all others 1 where it is met as planned.
    ``scale`` (2, a) is by how much an estimate that is not linear has found more than this one, in units and relative.
    Also the prior stds (2, B) of the others, in their units and relative to their values.
    """
    _, sensitivities = tangents.whitened(planned)
    information = np.einsum("rki,rkj->rij", sensitivities, sensitivities)
    rows = planned.root[planned.order][planned.asked :]
    directions, count = rows / np.linalg.norm(rows, axis=1, keepdims=True), len(rows)

    def measured(some: Array, at: tuple[int, int], factor: float) -> float:
        prior = np.eye(directions.shape[1]) + (factor**-2 - 1) * (directions.T * some) @ directions
        ratio = shared_spread(planned, information, alike, prior)[1]
        return float((np.stack(in_units(planned, planned.about, ratio, tangents.u)) * scale)[at])

    largest = np.empty((len(wanted), count + 1))
    for factors, (name, (most, relative)) in zip(largest, wanted.items(), strict=True):
        at = int(relative), planned.about.index(name)
        for b, some in enumerate(np.vstack([np.eye(count), np.ones(count)])):
            factors[b] = _largest(partial(measured, some, at), most, MOST if b < count else 1.0)
    others = in_units(planned, planned.names[planned.asked :], np.ones((len(tangents.u), count)), tangents.u)
    return largest, np.stack(others)


def _largest(measure: Callable[[float], float], wanted: float, most: float) -> float:
    """The largest factor at which a measure that grows with it is at most what is ``wanted``."""
    if measure(most) <= wanted:
        return np.inf if most == MOST else most
    if measure(LEAST) > wanted:
        return 0.0
    low, high = np.log(LEAST), np.log(most)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if measure(float(np.exp(middle))) <= wanted else (low, middle)
    return float(np.exp(low))
