r"""A proposal that is the emulated posterior itself, for posteriors that are too thin and bent for a mixture.

    x_i ~ exp(−Ĵ/τ),   w_i = exp(Ĵ(x_i)/τ − J(x_i)),   ∫ exp(−J) dx = ∫ exp(−Ĵ/τ) dx · E[w]

Where ten parameters are tied together to some thousandths of their spread, a mixture fitted to a few hundred draws
keeps 2 to 5 % of its draws effective and loses the tails. Predictions bend far less than J does, and J of polynomial
predictions costs microseconds: of it tens of thousands of draws can be made, which show the whole of that valley, and
10 to 60 % of them stay effective under the model. The emulator is fitted to all runs made so far, and learns where it
is wrong from runs at its own draws, first hot (τ > 1), so that they reach beyond the runs before them. The more runs
there are, the higher is the degree of its polynomials: with quadratic ones a valley that turns by a right angle, as of
a stiffness and a stiffening that stand for each other, lost up to a third of its probability.

Source: surrogates refined where they say that the posterior is, Li & Marzouk (2014), SIAM J. Sci. Comput. 36, A1163.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.ensemble.forecast import Forecast, costs
from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.sampling.emulated_cost import RUNS_PER_TERM, EmulatedCost, ModelRuns, fitted_cost, needed_runs
from en4dvar.sampling.mixture import StudentMixture
from en4dvar.sampling.walkers import advance

NEAR = 3.0  # n τ above the lowest J: runs up to there are fitted
WALKERS, MOVES = 600, 20  # they are drawn by their weights, and move about where they were so many moves before;
RENEWED, PARTS = 25, 8  # so many draws of a mixture of so many parts may then replace each of them;
FIRST_TURNS, TURNS = 10, 3  # both so often
STILL = 1e-4  # of the logarithm of a ratio of two integrals from turn to turn
HALF = 0.5  # of the walkers stay effective from a density to the next
HIGHEST = 8  # degree of polynomials, where runs are many
LARGEST = 2000  # outputs of a run beyond which emulating them costs more than it is worth


class RecordedRuns:
    """J (B,) of a problem at control vectors (B, n) by the model, +inf where that fails; what the runs gave is kept. An
    emulator of many runs has polynomials up to degree :data:`HIGHEST`.
    """

    def __init__(self, run: Callable[[Array], Forecast], problem: InverseProblem):
        self._run, self.problem, self.prior = run, problem, problem.prior
        self._wanted = needed_runs(len(problem.prior.names))
        self.runs: ModelRuns | None = None

    def __call__(self, x: Array) -> Array:
        outcome = self._run(x)
        J = costs(self.problem, x, outcome)
        if outcome.predicted.stacked.shape[1] <= LARGEST:
            new = ModelRuns.of(x, outcome, J)
            self.runs = new if self.runs is None else self.runs.joined(new)
        return J

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
        while degree < HIGHEST and RUNS_PER_TERM * math.comb(n + degree + 1, n) <= len(chosen):
            degree += 1
        return fitted_cost(self.problem, degree, self.runs[chosen], n * heat)


@dataclass(frozen=True)
class EmulatedProposal:
    """exp(−Ĵ/τ), normalised by exp(``log``), in the coordinates z in which the prior is N(0, 1).

    ``walkers`` (W, n) sample it. From a ``mixture`` to the first proposal, and from proposal to proposal, they are
    drawn by the ratio of both densities, in steps that leave half of them effective, and move in each (Del Moral,
    Doucet & Jasra 2006, J. R. Stat. Soc. B 68, 411).
    """

    cost: Callable[[Array], Array]
    mixture: StudentMixture
    walkers: Array
    log: float

    @classmethod
    def fitted(
        cls, runs: RecordedRuns, start: "StudentMixture | EmulatedProposal", stream: np.random.Generator, heat: float
    ) -> "EmulatedProposal | None":
        """To the runs so far, from a mixture about them or the proposal before; None where runs are too few."""
        emulated = runs.emulated(heat)
        if emulated is None:
            return None

        def cost(z: Array) -> Array:
            return emulated.cost(runs.prior.from_white(z)) / heat

        if isinstance(start, StudentMixture):
            made, turns = cls.bridged_from(start, cost, stream), FIRST_TURNS
        else:
            made, turns = start.bridged(cost, stream), TURNS
        for _ in range(turns):
            made = made.settled(stream)
        return made

    @classmethod
    def bridged_from(
        cls, start: StudentMixture, cost: Callable[[Array], Array], stream: np.random.Generator
    ) -> "EmulatedProposal":
        """The proposal exp(−``cost``), from a mixture."""
        return cls(lambda z: -start.log_density(z), start, start.draw(WALKERS, stream), 0.0).bridged(cost, stream)

    def bridged(self, cost: Callable[[Array], Array], stream: np.random.Generator) -> "EmulatedProposal":
        """The proposal exp(−``cost``), from this one."""

        def between(at: float) -> Callable[[Array], Array]:
            return lambda z: (1 - at) * self.cost(z) + at * cost(z)

        at, z = 0.0, self.walkers
        while at < 1.0:
            change, step = self.cost(z) - cost(z), 1.0 - at
            while effective_number(shares_of(step * change)) < HALF * WALKERS and step > 1e-3:
                step *= 0.8
            at = at + step if at + step < 1.0 - 1e-9 else 1.0
            z = z[resampled(shares_of(step * change), WALKERS, stream)]
            z = _moved(cost if at == 1.0 else between(at), z, z, stream)
        return replace(self, cost=cost, walkers=z)

    def settled(self, stream: np.random.Generator) -> "EmulatedProposal":
        """After moves of the walkers, and with draws of a mixture about them in the place of those that their weights
        say: small moves do not take them from end to end of a thin valley (iterated sampling importance resampling:
        Andrieu, Lee & Vihola 2018, Bernoulli 24, 842).
        """
        z = _moved(self.cost, self.walkers, self.walkers, stream)
        mixture = StudentMixture.fitted(z, stream, PARTS)
        tried = np.concatenate([z, mixture.draw(RENEWED * WALKERS, stream)])
        logs = (-self.cost(tried) - mixture.log_density(tried)).reshape(1 + RENEWED, WALKERS)
        best = np.argmax(logs + stream.gumbel(size=logs.shape), axis=0)
        log = log_ratio(logs[1:].ravel(), logs[0])
        walkers = tried.reshape(1 + RENEWED, WALKERS, -1)[best, np.arange(WALKERS)]
        return replace(self, mixture=mixture, walkers=walkers, log=log)

    def draw(self, count: int, stream: np.random.Generator) -> Array:
        """(count, n)."""
        return _moved(self.cost, self.walkers[stream.permutation(WALKERS)[:count]], self.walkers, stream)

    def log_density(self, x: Array) -> Array:
        """(B,) at points (B, n)."""
        return np.asarray(-self.cost(x) - self.log)


def log_ratio(of_first: Array, of_second: Array) -> float:
    """ln of ∫ of a second density over that of a first, from the logarithms of second over first at draws of the first
    (D,) and of the second (W,).

    Where the first is thin in a tail of the second, the mean over its draws alone is that of a few; draws of the second
    are there. Source: bridge sampling, Meng & Wong (1996), Stat. Sinica 6, 831.
    """
    counts = np.log([len(of_first), len(of_second)])
    first, second = counts - np.logaddexp(*counts)
    log = change = 1.0
    while abs(change) > STILL:
        at_first, at_second = (np.logaddexp(first, second + of - log) for of in (of_first, of_second))
        change = np.logaddexp.reduce(of_first - log - at_first) - np.logaddexp.reduce(-at_second) - first + second
        log += 0.5 * change  # which falls by up to 2 for each 1 of log: whole steps may go to and fro
    return float(log)


def _moved(cost: Callable[[Array], Array], z: Array, others: Array, stream: np.random.Generator) -> Array:
    """Walkers (B, n) after moves about ``others`` (W, n) on exp(−``cost``)."""
    return advance(cost, z, cost(z), others, stream, MOVES)[0]
