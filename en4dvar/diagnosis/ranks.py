r"""Are the ranks of truths among posterior members uniform? Simulation-based calibration, tested on its distribution.

Where a truth is drawn from the prior and readings from the model, its rank among N members of the posterior takes each
of the N + 1 places with the same chance, whatever the readings tell (Cook, Gelman & Rubin 2006, J. Comput. Graph. Stat.
15, 675; Talts et al. 2018, arXiv:1804.06788). Of S sets the number with a rank below k is then binomial, of the chance
k/(N + 1). The least likely of these N numbers is the statistic, whose distribution is simulated (Säilynoja, Bürkner &
Vehtari 2022, Stat. Comput. 32, 32): it sees ranks that are too low, too central or too extreme alike.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import binom

from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream

SIMULATED = 4000  # sets of uniform ranks
BAND = 0.95  # chance that the whole distribution of uniform ranks lies within the band


@dataclass(frozen=True)
class Uniform:
    """What uniform ranks of ``sets`` truths among N ``members`` look like; ``least`` (M,) are simulated statistics."""

    sets: int
    members: int
    least: Array

    @property
    def shares(self) -> Array:
        """(N,) chance of a rank below 1, 2, …, N."""
        return np.arange(1, self.members + 1) / (self.members + 1)

    @property
    def band(self) -> tuple[Array, Array]:
        """Lowest and highest share of the sets (N,) with a rank below 1, 2, …, N that uniform ranks have."""
        level = float(np.quantile(self.least, 1 - BAND)) / 2
        low, high = binom.ppf(level, self.sets, self.shares), binom.isf(level, self.sets, self.shares)
        return low / self.sets, high / self.sets

    def distribution(self, ranks: Array) -> Array:
        """Share of the sets (N,) with a rank below 1, 2, …, N."""
        return np.asarray(np.searchsorted(np.sort(ranks), np.arange(1, self.members + 1)) / self.sets)

    def p_value(self, ranks: Array) -> float:
        """The chance of ranks (S,) as far from uniform as these; small where they are not uniform."""
        least = _least(np.rint(self.distribution(ranks) * self.sets), self.sets, self.shares)
        return float((1 + np.sum(self.least <= least)) / (1 + len(self.least)))


@lru_cache(maxsize=8)
def uniform_ranks(sets: int, members: int) -> Uniform:
    """The reference for ``sets`` ranks among ``members``; the same in every call."""
    stream = member_stream(0, f"uniform ranks of {sets} among {members}")
    places = stream.multinomial(sets, np.full(members + 1, 1 / (members + 1)), size=SIMULATED)
    shares = np.arange(1, members + 1) / (members + 1)
    return Uniform(sets, members, _least(np.cumsum(places[:, :-1], axis=1), sets, shares))


def _least(counts: Array, sets: int, shares: Array) -> Array:
    """(…,) the smallest two-sided probability of counts (…, N), each binomial with its share."""
    below, above = binom.cdf(counts, sets, shares), binom.sf(counts - 1, sets, shares)
    return np.asarray(np.min(np.minimum(1.0, 2 * np.minimum(below, above)), axis=-1))
