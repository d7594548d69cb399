"""The compiled loops of this package, each used once."""

from collections.abc import Callable

import numpy as np

from en4dvar.estimation.population.hierarchy import Effort, Hierarchy, HyperPrior
from en4dvar.estimation.population.own import OwnDraws, own_likelihoods


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    return {"hierarchy of a population": _hierarchy}


def _hierarchy() -> None:
    draws = np.random.default_rng(0).standard_normal((4, 200, 3)) * [0.1, 0.2, 1.0]
    drawn = [OwnDraws(z, 0.0, 100.0, 0) for z in draws]
    likelihoods = own_likelihoods(drawn, [0, 1], [2], 0, "abcd", np.zeros(2))
    effort = Effort(draws=100, hyper_walkers=16, hyper_rounds=6, hyper_components=2)
    Hierarchy(likelihoods, HyperPrior()).sampled(0, effort)
