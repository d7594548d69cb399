"""The compiled loops of this package, each used once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from en4dvar.estimation.population.campaign import white_prior
from en4dvar.estimation.population.effort import Effort
from en4dvar.estimation.population.estimate import estimate_population
from en4dvar.estimation.population.hierarchy import Hierarchy
from en4dvar.estimation.population.hyper import HyperPrior
from en4dvar.estimation.population.own import OwnDraws, own_likelihoods
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling.forward_runs import Sets


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    return {"population": _estimate, "hierarchy of a population": _hierarchy}


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


def _hierarchy() -> None:
    """Two parameters that vary, and one in common."""
    draws = np.random.default_rng(0).standard_normal((4, 200, 3)) * [0.1, 0.2, 1.0]
    drawn = [OwnDraws(z, 0.0, 100.0, 0) for z in draws]
    likelihoods = own_likelihoods(drawn, [0, 1], [2], 0, "abcd")
    effort = Effort(draws=100, hyper_walkers=16, hyper_rounds=6, hyper_components=2)
    Hierarchy(likelihoods, white_prior(["a", "b"]), HyperPrior()).sampled(0, effort)
