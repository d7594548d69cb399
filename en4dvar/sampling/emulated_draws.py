r"""A proposal that is the emulated posterior itself, for posteriors that are too thin and bent for a mixture.

    x_i ~ exp(−Ĵ/τ),   w_i = exp(Ĵ(x_i)/τ − J(x_i)),   ∫ exp(−J) dx = ∫ exp(−Ĵ/τ) dx · E[w]

Where ten parameters are tied together to some thousandths of their spread, a mixture fitted to a few hundred draws
keeps 2 to 5 % of its draws effective and loses the tails. Predictions bend far less than J does, and J of quadratic
predictions costs microseconds: of it tens of thousands of draws can be made, which show the whole of that valley, and
10 to 60 % of them stay effective under the model. The emulator is fitted to all runs made so far, and learns where it
is wrong from runs at its own draws, first hot (τ > 1), so that they reach beyond the runs before them.

Source: surrogates refined where they say that the posterior is, Li & Marzouk (2014), SIAM J. Sci. Comput. 36, A1163.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import Forecast
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior
from en4dvar.sampling.emulated_cost import EmulatedCost, ModelRuns, fitted_cost, needed_runs
from en4dvar.sampling.importance import ClosingDraws, FixedDraws
from en4dvar.sampling.mixture import StudentMixture, resampled
from en4dvar.sampling.walkers import advance

NEAR = 3.0  # n τ above the lowest J: runs up to there are fitted
COUNT, CLOSING = 2000, 5  # draws of a round, rounds that close in, on the emulator
ROUNDS = 20  # more, at most
WALKERS, MOVES = 600, 30  # they start from the draws, and move about where they were so many moves before,
TURNS = 3  # so often: the tails that the mixture misses are found, and from fit to fit they go on
LARGEST = 2000  # outputs of a run beyond which emulating them costs more than it is worth


class RecordedRuns:
    """J (B,) of control vectors (B, n) by the model, +inf where that fails; what the runs gave is kept."""

    def __init__(
        self,
        run: Callable[[Array], Forecast],
        costs: Callable[[Array, Forecast], Array],
        prior: Prior,
        observations: Observations,
    ):
        self._run, self._costs, self.prior, self.observations = run, costs, prior, observations
        self._wanted = needed_runs(len(prior.names))
        self.runs: ModelRuns | None = None

    def __call__(self, x: Array) -> Array:
        outcome = self._run(x)
        costs = self._costs(x, outcome)
        if outcome.predicted.stacked.shape[1] <= LARGEST:
            new = ModelRuns.of(x, outcome, costs)
            self.runs = new if self.runs is None else self.runs.joined(new)
        return costs

    @property
    def emulates(self) -> bool:
        """Whether there are enough runs that an emulator can be fitted to."""
        return self.runs is not None and self._wanted is not None and len(self.runs.x) >= self._wanted[1]

    def emulated(self, heat: float) -> EmulatedCost | None:
        """J emulated by the runs so far, those of low J most; None where there are too few of them."""
        if self.runs is None or self._wanted is None or not self.emulates:
            return None
        (degree, fewest), n = self._wanted, len(self.prior.names)
        near = int(np.sum(self.runs.costs - self.runs.costs.min() < NEAR * n * heat))
        chosen = np.argsort(self.runs.costs, kind="stable")[: max(fewest, near)]
        return fitted_cost(self.prior, self.observations, degree, self.runs[chosen], n * heat)


@dataclass(frozen=True)
class EmulatedProposal:
    """exp(−Ĵ/τ), normalised, in the coordinates z in which the prior is N(0, 1).

    ``pool``: weighted draws of it, from ``mixture``, which tell its norm; ``walkers`` (W, n) that sample it.
    """

    emulated: EmulatedCost
    heat: float
    mixture: StudentMixture
    pool: FixedDraws
    walkers: Array

    @classmethod
    def fitted(
        cls, runs: RecordedRuns, start: "StudentMixture | EmulatedProposal", stream: np.random.Generator, heat: float,
        enough: float,
    ) -> "EmulatedProposal | None":  # fmt: skip
        """Fitted to the runs so far, with so many effective draws; ``start`` is a mixture about them, or the proposal
        before, whose walkers go on. None where runs are too few.
        """
        emulated = runs.emulated(heat)
        if emulated is None:
            return None

        def add(sampler: ClosingDraws | FixedDraws) -> None:
            z = sampler.draw()
            sampler.add(z, 0.5 * np.sum(z**2, axis=1) - _white(emulated, z) / heat)

        closing = ClosingDraws(start if isinstance(start, StudentMixture) else start.mixture, stream, COUNT, wider=1.3)
        for _ in range(CLOSING):
            add(closing)
        mixture = closing.next_proposal()
        pool = FixedDraws(mixture, stream, COUNT)
        for _ in range(ROUNDS):
            add(pool)
            if pool.effective >= enough:
                break
        if not np.isfinite(pool.log):
            return None
        walkers = pool.z[resampled(pool.shares, WALKERS, stream)]
        if not isinstance(start, StudentMixture):
            walkers[::2] = start.walkers[::2]
        made = cls(emulated, heat, mixture, pool, walkers)
        for _ in range(TURNS):
            made = replace(made, walkers=made.moved(made.walkers, stream))
        return made

    def moved(self, z: Array, stream: np.random.Generator) -> Array:
        """Walkers (W, n) after moves about those of the proposal."""
        return advance(self._cost, z, self._cost(z), self.walkers, stream, MOVES)[0]

    @property
    def dimensions(self) -> int:
        """n."""
        return self.pool.z.shape[1]

    def draw(self, count: int, stream: np.random.Generator) -> Array:
        """(count, n)."""
        return self.moved(self.walkers[stream.permutation(WALKERS)[:count]], stream)

    def log_density(self, x: Array) -> Array:
        """(B,) at points (B, n)."""
        return np.asarray(-self._cost(x) - 0.5 * x.shape[1] * np.log(2 * np.pi) - self.pool.log)

    def _cost(self, z: Array) -> Array:
        return _white(self.emulated, z) / self.heat


def _white(emulated: EmulatedCost, z: Array) -> Array:
    """Ĵ (B,) at white coordinates (B, n)."""
    return emulated.cost(emulated.prior.from_white(z))
