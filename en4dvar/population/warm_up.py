"""The compiled loops of this package, each used once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from en4dvar.population.effort import Effort
from en4dvar.population.estimate import estimate_population
from en4dvar.prior import Prior, PriorTerm
from en4dvar.sampling.forward_runs import Sets
from en4dvar.state import Array, Parameter


def examples() -> dict[str, Callable[[], object]]:
    """What is compiled, in words, and a call that does; for ``en4dvar warm-up``."""
    return {"population": _estimate}


class _Direct:
    """Four data sets that observe their one parameter and twice it."""

    values, weight = np.outer([-0.5, 0.0, 0.4, 1.0], [1.0, 2.0]), np.full((4, 2), 25.0)

    def predictions(self, x: Array, sets: Sets = None) -> Array:
        return np.concatenate([x, 2 * x], axis=-1)


def _estimate() -> None:
    start = _Direct.values[:, None, :1] + 0.2 * np.random.default_rng(0).standard_normal((4, 20, 1))
    prior = Prior((PriorTerm.normal(Parameter("a", "1"), 0.0, 1.0),))
    effort = Effort(rounds=30, refits=1, degree=2, components=2, hyper_walkers=8, hyper_rounds=20, hyper_components=2)
    estimate_population(_Direct(), start, prior, ["a"], seed=0, effort=effort)
