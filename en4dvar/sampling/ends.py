r"""The ends of the interval of each parameter, of a posterior that its ensemble as a Gaussian may not be.

    p(x_j) ∝ exp(−J(x*)) V(x*),   x* = argmin J at x_j

Points at multiples of the spread of a Gaussian that is too narrow do not reach a long tail. So each parameter is moved
outwards, the others to where J is lowest, until J has risen by what leaves no tail. Where J is lowest, and the volume V
of the others there, is what an emulator says that is fitted to the runs there are, which costs none; J is the model's,
with the prior that the prior's members have. Where no emulator says it, J on the straight way is no less than at x*,
and only a lower one counts. Of a linear model the ends are the Gaussian's, whatever the points are.

Source: marginals by Laplace's approximation at each value, Tierney & Kadane (1986), J. Am. Stat. Assoc. 81, 82.
"""

import math
from typing import NamedTuple

import numpy as np

from en4dvar.descent.beyond_gaussian import Drawn
from en4dvar.descent.minima import Minimum
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.response.ledger import QUANTILES, weighted_quantiles
from en4dvar.ensemble.linalg import shares_of
from en4dvar.model.state import Array, Mask
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.emulated_cost import DEGREES, RUNS_PER_TERM, EmulatedCost, ModelRuns, fitted_cost
from en4dvar.sampling.emulated_draws import LARGEST

NEARLY = 0.01  # of the Gaussian's rise, and beside it, by which J may differ from it at all members
END = 3.0  # standard deviations to either side of the minimum, where J of the Gaussian has risen by 4.5
WITHIN, STEEP = (END / 2, END / 4, END / 8), 3.0  # places before that, each after a rise of J by so much to the last
SHORT = 1.5  # less than that by which J rises to a point beyond which there may be a tail: it is followed
FURTHER = 1.5  # times as far
NEAR = 1000.0  # above the lowest J: runs up to there are fitted, where they suffice for more than the Gaussian has
MISLED = 0.5  # of J, by which it may exceed emulated J, and this the lowest there: beyond, a point is not x*
TRIED, WIDTHS, AGAIN = 128, (2.0, 1.0, 0.5, 0.25), 4  # points about x*, so wide and so often, of lowest emulated J
PLACES = 2001  # of a parameter, at which its density is known
Costs = list[dict[float, float]]


class Intervals(NamedTuple):
    """The 5, 50 and 95 % points (3, n) of the posterior in what is printed, and by how much the 5 or 95 % point both of
    what members are drawn from and of them is off (n,), in posterior standard deviations: members alone may be by
    chance, and are what is printed. Whether J ``rises`` to all points at :data:`END`.
    """

    quantiles: Array
    off: Array
    rises: bool


class _Walk:
    """Along each parameter j, to both sides, from a minimum; ``runs`` are there.

    ``costs`` of each side are J − ln V (relative to that at the minimum) by the distance in standard deviations, and
    those of what members are ``drawn`` from likewise, if that is no Gaussian.
    """

    def __init__(self, space: WeightSpace, minimum: Minimum, runs: ModelRuns, drawn: Drawn | None):
        self.space, self.runs, self.start, self.drawn, n = space, runs, minimum.x, drawn, len(minimum.x)
        self.std = np.sqrt(np.diag(minimum.covariance))
        correlation = minimum.covariance / np.outer(self.std, self.std)
        self.ways = np.array([side * self.std * correlation[j] for j in range(n) for side in (-1, 1)])
        half = member_stream(space.seed, "ends").standard_normal((TRIED // 2, n - 1))
        self.normal = np.concatenate([half, -half])
        roots = [self.std[:, None] * _conditional(correlation, j) for j in range(n) for _ in range(2)]
        self.about = np.array([self.normal @ root.T for root in roots])  # (2n, T, n) of the others, about each point
        self.bends = np.zeros_like(self.ways)  # of the last x* from the way, relative to the distance
        self.costs: Costs = [{0.0: minimum.cost} for _ in self.ways]
        self.of_drawn: Costs = []
        if drawn:
            at_start = float(drawn.cost(self.start[None])[0])
            self.of_drawn = [{0.0: at_start} for _ in self.ways]

    def go(self, sides: list[int], far: float) -> None:
        """So ``far`` on ``sides``."""
        straight, n = self.start + far * (self.ways + self.bends)[sides], len(self.start)
        x, log_volume, expected = straight.copy(), np.zeros(len(sides)), np.full(len(sides), np.inf)
        lowest = np.zeros(len(sides), dtype=bool)  # whether x is x*
        near = self.runs[np.flatnonzero(self.runs.costs - self.runs.costs.min() < NEAR)]
        degree = next((d for d in DEGREES if RUNS_PER_TERM * math.comb(n + d, d) <= len(near.x)), None)
        if degree and near.outputs.shape[1] <= LARGEST and self.space.settings.emulator != "off":
            emulated = fitted_cost(self.space.problem, degree, near, 2 * n)
            x, log_volume, lowest = self._lowest(emulated, x, self.about[sides])
            expected = emulated.cost(x)
        costs = self._run(x)
        misled = np.flatnonzero(costs > expected + MISLED)
        if len(misled):
            instead = self._run(straight[misled])
            lowest[misled] = False
            misled, instead = misled[instead < costs[misled]], instead[instead < costs[misled]]
            x[misled], costs[misled] = straight[misled], instead
        self.bends[sides] = (x - self.start) / far - self.ways[sides]
        of_drawn = self.drawn.cost(x) if self.drawn else np.full(len(sides), self.costs[0][0.0] + 0.5 * far**2)
        as_drawn = of_drawn - self.of_drawn[0][0.0] + self.costs[0][0.0] if self.drawn else of_drawn
        costs, log_volume = self.space.with_sampled_prior(x, costs), np.where(lowest, log_volume, 0.0)
        costs = np.where(lowest, costs, np.minimum(costs, as_drawn))  # a higher J on the way is not that of x*
        for i, side in enumerate(sides):
            self.costs[side][far] = float(costs[i] - log_volume[i])
            if self.drawn:
                self.of_drawn[side][far] = float(of_drawn[i] - log_volume[i])

    def _run(self, x: Array) -> Array:
        """J (S,) of points (S, n), by which an emulator learns."""
        outcome = self.space.forecast(x)
        costs = self.space.costs(x, outcome)
        self.runs = self.runs.joined(ModelRuns.of(x, outcome, costs))
        return costs

    def _lowest(self, emulated: EmulatedCost, x: Array, about: Array) -> tuple[Array, Array, Mask]:
        """The points x* (S, n) among those ``about`` (S, T, n) the points ``x`` (S, n), ln V (S,), and whether none
        about them is lower (S,).
        """

        def costs(tried: Array) -> Array:
            x = tried.reshape(-1, tried.shape[-1])
            return self.space.with_sampled_prior(x, emulated.cost(x)).reshape(tried.shape[:-1])

        def falls(at: Array) -> Array:
            return np.asarray(costs(at)[:, None] - costs(at[:, None] + about))

        def log_volume(falls: Array) -> Array:
            return np.asarray(np.logaddexp.reduce(falls + 0.5 * np.sum(self.normal**2, axis=1), axis=1))

        for width in WIDTHS:
            for _ in range(AGAIN):
                tried = np.concatenate([x[:, None], x[:, None] + width * about], axis=1)
                lowest = np.argmin(costs(tried), axis=1)
                x = tried[np.arange(len(x)), lowest]
                if not lowest.any():
                    break
        at, at_start = falls(x), falls(np.broadcast_to(self.start, x.shape))
        return x, log_volume(at) - log_volume(at_start), np.max(at, axis=1) < MISLED

    def rise(self, side: int, far: float) -> float:
        """Of J on a side, to where it was so far."""
        return self.costs[side][far] - _least(self.costs)

    def short(self, far: float, sides: list[int]) -> list[int]:
        """Those of the ``sides`` beyond whose distance ``far`` there may be a tail."""
        return [side for side in sides if self.rise(side, far) < 0.5 * END**2 - SHORT]

    def density(self, j: int, sides: Costs) -> tuple[Array, Array]:
        """Distances (P,) along parameter j and shares (P,) of its density there, from costs of all ``sides``.

        Between the points √(2 (J − min J)) is interpolated, which is the distance itself where J is quadratic; beyond
        the last, as far again, it goes on as before.
        """
        distances, roots = [0.0], [0.0]
        for sign, costs in zip((-1, 1), sides[2 * j : 2 * j + 2], strict=True):
            far = sorted(costs)
            root = [min(2 * END, math.sqrt(2 * max(0.0, costs[d] - _least(sides)))) if d else 0.0 for d in far]
            slope = max(0.0, root[-1] - root[-2]) / (far[-1] - far[-2])
            root.append(root[-1] + slope * far[-1])
            far.append(2 * far[-1])
            distances += [sign * d for d in far[1:]]
            roots += [sign * r for r in root[1:]]
        order = np.argsort(distances)
        z = np.linspace(min(distances), max(distances), PLACES)
        return z, shares_of(-0.5 * np.interp(z, np.array(distances)[order], np.array(roots)[order]) ** 2)


def _least(sides: Costs) -> float:
    return min(min(costs.values()) for costs in sides)


def _conditional(correlation: Array, j: int) -> Array:
    """Root (n, n − 1) of the covariance of the others where parameter j stands still, in their standard deviations."""
    others = np.delete(np.arange(len(correlation)), j)
    root = np.zeros((len(correlation), len(others)))
    left = correlation - np.outer(correlation[j], correlation[j])
    root[others] = np.linalg.cholesky(left[np.ix_(others, others)])
    return root


def examine_ends(
    space: WeightSpace, minimum: Minimum, ensemble: Array, runs: ModelRuns, drawn: Drawn | None = None
) -> Intervals | None:
    """Of an ensemble (N, n) about a minimum, Gaussian or ``drawn`` otherwise, by 2n runs beside the ``runs`` there are,
    and more where J rises too little; none, and None, where J of all runs there are is what the ensemble was drawn by.
    """
    own = drawn.cost(runs.x) - minimum.cost if drawn else [0.5 * minimum.distance(x) ** 2 for x in runs.x]
    if np.allclose(space.with_sampled_prior(runs.x, runs.costs) - minimum.cost, own, rtol=NEARLY, atol=NEARLY):
        return None
    walk, prior, far = _Walk(space, minimum, runs, drawn), space.problem.prior, END
    sides = list(range(len(walk.ways)))
    walk.go(sides, END)
    left = walk.short(END, sides)
    bent = [side for side in sides if side in left or walk.rise(side, END) > 0.5 * END**2 + SHORT]
    rises = not left
    while left:
        far *= FURTHER
        walk.go(left, far)
        left = walk.short(far, left)
    for far in WITHIN:
        if bent:  # how it rises there
            walk.go(bent, far)
            bent = [side for side in bent if walk.rise(side, far) > STEEP]
    quantiles, off = np.empty((len(QUANTILES), len(walk.start))), np.empty(len(walk.start))
    printed = diag.member_quantiles(prior.to_physical(ensemble), QUANTILES, axis=0)
    for j in range(len(off)):
        z, shares = walk.density(j, walk.costs)
        x = np.tile(walk.start, (len(z), 1))
        x[:, j] += walk.std[j] * z
        theta = prior.to_physical(x)[:, j]
        quantiles[:, j] = weighted_quantiles(theta, shares)
        of_drawn = walk.density(j, walk.of_drawn)[1] if drawn else shares_of(-0.5 * z**2)
        of_both = np.array([weighted_quantiles(theta, of_drawn), printed[:, j]]) - quantiles[:, j]
        off[j] = np.abs(of_both).min(axis=0)[[0, 2]].max() / math.sqrt(shares @ (theta - shares @ theta) ** 2)
    return Intervals(quantiles, off, rises)
