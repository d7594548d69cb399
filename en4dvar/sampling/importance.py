r"""A posterior as weighted draws, by adaptive importance sampling with forward runs.

    p(y) = ∫ L(x) N(x; prior) dx ≈ (1/TM) Σ_i L(x_i) N(x_i) / q(x_i),     q = (1/T) Σ_t q_t

The draws of the first round come from a proposal given from outside, those of a later round from one that is fitted to
all before, and q is the mixture of all rounds (Cornuet, Marin, Mira & Robert 2012, Scand. J. Stat. 39, 798).
Coordinates z are those in which the prior is N(0, 1).

Such a mixture is dense where the draws lie that it was fitted to, which makes the weights of these too small; and where
none of them lies nothing tells that something is missing. :class:`ClosingDraws` therefore fits its proposals to a power
of the posterior, with covariances that few draws do not make flat; what judges the posterior are :class:`FixedDraws` of
the last proposal alone, made afresh: their mean weight is unbiased.
"""

import numpy as np

from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.model.state import Array
from en4dvar.sampling.emulated_draws import EmulatedProposal
from en4dvar.sampling.mixture import StudentMixture

SETTLED, PARTS = 150.0, 8  # effective draws that a proposal is fitted to, with fewer to tempered weights; components
MOST_FITTED = 1000  # points that it is fitted to
EACH = 4  # effective draws for each coordinate of a component: fitted to fewer it is flat in some direction
MOST = 3.0  # times √D mean weights of D draws: more than that none counts (Ionides 2008)
Proposal = StudentMixture | EmulatedProposal


class Importance:
    """The draws of one data set from its proposals, ``count`` in a round, the first of them from ``first``.

    ``z`` (D, n) are all draws, ``log_weights`` (D,) their weights, ``log`` is ln ∫ L N dz and ``effective`` the number
    of draws behind it. ``settled``: whether the rounds that trained the proposal had ceased to reach farther.
    """

    def __init__(self, first: Proposal, stream: np.random.Generator, count: int):
        self.stream, self.count = stream, count
        self.proposals: list[Proposal] = [first]
        self.z, self.target, self.mixture = np.empty((0, 0)), np.empty(0), np.empty(0)  # mixture: ln Σ_t q_t
        self.log_weights, self.log, self.effective, self.settled = np.empty(0), -np.inf, 0.0, True

    @property
    def costs(self) -> Array:
        """J (D,) of the draws."""
        return np.asarray(-self.target - 0.5 * self.z.shape[1] * np.log(2 * np.pi))

    @property
    def shares(self) -> Array:
        """Weights (D,) of the draws, which sum to one; some draw must have one."""
        return shares_of(self.log_weights)

    def draw(self) -> Array:
        """(M, n) draws of the next round."""
        return self.proposals[-1].draw(self.count, self.stream)

    def add(self, z: Array, log_likelihood: Array) -> None:
        """Draws (M, n) and what came of them (M,); weights and evidence of all draws follow."""
        target = log_likelihood - 0.5 * np.sum(z**2, axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi)
        own = np.logaddexp.reduce([q.log_density(z) for q in self.proposals], axis=0)
        self.mixture = np.concatenate([self.mixture, own])
        self.z = np.concatenate([self.z, z]) if len(self.z) else z
        self.target = np.concatenate([self.target, target])
        self.log_weights = self.target - self.mixture + np.log(len(self.proposals))
        if np.isfinite(self.log_weights.max()):
            self.log = float(np.logaddexp.reduce(self.log_weights) - np.log(len(self.z)))
            self.effective = effective_number(self.shares)


class ClosingDraws(Importance):
    """A proposal each round, fitted to the posterior to the power of ``wider``⁻², which of a Gaussian is wider by that
    factor, and of another shape most where that has tails, so that thin tails are found as well.
    """

    def __init__(self, first: StudentMixture, stream: np.random.Generator, count: int, wider: float):
        super().__init__(first, stream, count)
        self.first, self.wider = first, wider

    def draw(self) -> Array:
        if len(self.z):
            self.proposals.append(self.next_proposal())
            self.mixture = np.logaddexp(self.mixture, self.proposals[-1].log_density(self.z))
        return super().draw()

    @property
    def tempered(self) -> Array:
        """Log weights (D,) of that power."""
        alive = np.isfinite(self.log_weights)
        return np.where(alive, self.log_weights - (1 - self.wider**-2) * np.where(alive, self.target, 0.0), -np.inf)

    @property
    def near(self) -> bool:
        """Whether so many draws tell that power that it need not be flattened further."""
        return bool(np.isfinite(self.log)) and effective_number(shares_of(self.tempered)) >= SETTLED

    def next_proposal(self) -> StudentMixture:
        n = self.z.shape[1]
        if np.isfinite(self.log_weights).sum() <= 2 * (n + 1):
            return self.first
        power, logs = 1.0, self.tempered
        while (effective := effective_number(shares := shares_of(power * logs))) < SETTLED and power > 1e-4:
            power *= 0.8
        where = resampled(shares, min(2 * self.count, MOST_FITTED), self.stream)
        parts = max(1, min(PARTS, int(effective / (EACH * n))))
        return StudentMixture.fitted(self.z[where], self.stream, parts, alike=2 * n * len(where) / effective)


class FixedDraws(Importance):
    """Draws of one proposal that stays. The largest of their weights are cut off, but not those behind ``log``.

    Source: Ionides (2008), J. Comput. Graph. Stat. 17, 295.
    """

    def add(self, z: Array, log_likelihood: Array) -> None:
        super().add(z, log_likelihood)
        if np.isfinite(self.log):
            self.log_weights = np.minimum(self.log_weights, self.log + np.log(MOST * np.sqrt(len(self.z))))
            self.effective = effective_number(self.shares)
