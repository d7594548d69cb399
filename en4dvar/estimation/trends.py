"""Do the values of single data sets follow something that they should not depend on?

A value of the material that rises with the size of the bubble, with the order in which data sets were taken or with the
time between readings is what a wrong scale, a wall, a drift or a wrong law leaves behind.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.problem import InverseProblem

FEWEST = 6  # data sets; of fewer no order is improbable enough
CHANCE = 0.01  # probability below which a trend is told, that any of those looked at be there by chance


def trends(problems: Sequence[InverseProblem], values: Array, names: Sequence[str]) -> Iterator[Caution]:
    """Of ``values`` (S, p) of the parameters ``names`` that S data sets give one by one; NaN where one has none.

    By Kendall's rank correlation (1938, Biometrika 30, 81), whose probability is exact for few data sets. Nothing is
    said of data sets with fewer readings than parameters: each tells a combination, which its size decides.
    """
    if min((len(p.observations.used) for p in problems), default=0) < max(2, len(names)):
        return
    from scipy.stats import kendalltau  # whose import takes longer than all of this

    covariates = list(_covariates(problems))
    for j, name in enumerate(names):
        has = np.isfinite(values[:, j])
        if has.sum() < FEWEST:
            continue
        for what, along in covariates:
            if np.ptp(along[has]) == 0:
                continue
            tau, chance = kendalltau(along[has], values[has, j])
            if chance * len(covariates) * len(names) < CHANCE:
                words = (
                    f"{name} of single data sets {'rises' if tau > 0 else 'falls'} with {what} (rank correlation "
                    f"{tau:.2f}, probability {chance:.1g} by chance)"
                )
                yield caution("trend", words, parameters=(name,))


def _covariates(problems: Sequence[InverseProblem]) -> Iterator[tuple[str, Array]]:
    """What values are held against, and it (S,)."""
    yield "the order of the data sets", np.arange(len(problems), dtype=float)
    yield "the largest reading", np.array([float(p.observations.values.max()) for p in problems])
    yield "the time between readings", np.array([_step(p) for p in problems])


def _step(problem: InverseProblem) -> float:
    step = float(np.median(np.diff(problem.observations.instants[0])))
    return float(f"{step:.4g}")  # of one camera they differ by rounding alone
