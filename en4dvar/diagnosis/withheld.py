r"""The readings after the window, which the estimate has not seen: what it expects of them, and how that came out.

Member i of the posterior, run on to the last reading, expects of a later one N(m_i + δ_i, s_i²), with what the
residuals in the window say of the discrepancy there and of the errors
(:meth:`~en4dvar.data.noise.Noise.continued`). The mixture over members has the distribution function

    F(y) = (1/N) Σ_i Φ((y − m_i − δ_i)/s_i),

whose 5 and 95 % quantiles are a band that a reading lies in with a chance of 90 %, if model, errors and posterior are
right. Quantities that the model calls :attr:`~en4dvar.model.forward.ForwardModel.unforeseen` change at the last maximum
of the window, each by normal scores in a fixed order of its own.

Readings of one path err together. If member i is the truth, reading k lies in its band with the probability
q_ik = F_i(95 %) − F_i(5 %), each by itself, and how many do is a sum of coins of these probabilities. The chance
that no more do than came out is the mean of its distribution function over members. Of 48 members, drawn at random like
the truth, 1 to 2 % of right estimates have a chance below 1 %: their bands are not known to better. Nothing was fitted
to these readings: how many of them lie in their bands is the one test of a real experiment that no choice of priors or
errors has passed beforehand.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from en4dvar.ensemble.forecast import Composite
from en4dvar.executor import Executor
from en4dvar.model.state import Array, Field
from en4dvar.priors.varying import StateChanges
from en4dvar.problem import InverseProblem

BAND = (0.05, 0.95)
SEEN, FEWEST = 0.6, 5  # the share in their bands, of so many readings or more, below which the estimate is doubted
BISECTIONS = 50
MANY = 500  # readings: an exact sum takes a time that grows with their square


@dataclass(frozen=True)
class Withheld:
    """Readings ``values`` (K,) at ``times`` (K,) after the window, and 5, 50 and 95 % of what was expected (K,). In the
    units of the model and of the observable. ``runs``: forward runs it took; ``chance``: that no more of them lie in
    their bands, if model, errors and posterior are right.
    """

    times: Array
    values: Array
    low: Array
    median: Array
    high: Array
    runs: int
    chance: float

    @property
    def inside(self) -> float:
        """The share of the readings that lie in their 90 % bands."""
        return float(np.mean((self.low <= self.values) & (self.values <= self.high)))

    @property
    def missed(self) -> bool:
        """Whether so few of them lie in their bands that the estimate is in doubt."""
        return self.inside < SEEN and len(self.values) >= FEWEST

    @property
    def rms(self) -> float:
        """Root mean square of the readings less the medians, in the observable's unit."""
        return float(np.sqrt(np.mean((self.values - self.median) ** 2)))


def predict_withheld(problem: InverseProblem, members: Array, executor: Executor) -> Withheld | None:
    """What posterior ``members`` (N, n), transformed, expect of the readings after the window. None where there are
    none, or fewer than two members can be run so far.
    """
    whole, begin = problem.observations.continued, len(problem.observations)
    expected = expectations(problem, members, executor)
    if whole is None or expected is None:
        return None
    low, median, high = (quantile(*expected, level) for level in (BAND[0], 0.5, BAND[1]))
    later = whole.values[begin:]
    chance = chance_of(int(np.sum((low <= later) & (later <= high))), low, high, *expected)
    return Withheld(whole.times[begin:], later, low, median, high, len(members), chance)


def chance_of(inside: int, low: Array, high: Array, mean: Array, std: Array) -> float:
    """That no more than so many readings lie in bands (K,), by what each of the members (M, K) expects. A sum of more
    than :data:`MANY` coins is taken for Gaussian.
    """
    own = ndtr((high - mean) / std) - ndtr((low - mean) / std)
    if own.shape[1] > MANY:
        spread = np.sqrt(np.sum(own * (1 - own), axis=1)) + np.finfo(float).tiny
        return float(ndtr((inside + 0.5 - own.sum(axis=1)) / spread).mean())
    counts = np.eye(1, own.shape[1] + 1).repeat(len(own), axis=0)  # of each member, that so many of the first k do
    for q in own.T[..., None]:
        counts = (1 - q) * counts + q * np.roll(counts, 1, axis=1)
    return float(counts[:, : inside + 1].sum(axis=1).mean())


def expectations(problem: InverseProblem, members: Array, executor: Executor) -> tuple[Array, Array] | None:
    """Means and standard deviations (members that can be run so far, K) of what each expects of the readings after the
    window; None as of :func:`predict_withheld`.
    """
    within, whole = problem.observations, problem.observations.continued
    if whole is None:
        return None
    changed, count = unforeseen(problem), len(members)
    names, scores, stream = changed.prior.names, ndtri((np.arange(count) + 0.5) / count), np.random.default_rng(count)
    theirs = np.zeros((count, len(names)))
    theirs[:, [names.index(name) for name in problem.prior.names]] = members
    for quantity, spread in problem.model.unforeseen.items():
        last = max(j for j, name in enumerate(names) if name.startswith(f"{quantity}_change_"))
        theirs[:, last] += spread * stream.permutation(scores)
    run = Composite(replace(changed, observations=whole), executor)(theirs)
    alive = np.flatnonzero(np.isfinite(run.predicted.values).all(axis=1))
    if len(alive) < 2:
        return None
    expected = [whole.noise.continued(within.values, run.predicted[int(i)]) for i in alive]
    mean, std = (np.stack(part) for part in zip(*expected, strict=True))
    return mean, std


def unforeseen(problem: InverseProblem) -> InverseProblem:
    """The problem with a change, at the last maximum of the window, of each quantity that its model does not foresee; a
    change that is estimated there, or later, is that one.
    """
    within, values = problem.constant, problem.observations.values
    top = len(values) - 1
    while top > 1 and max(values[top - 2 : top]) > values[top]:  # one reading that is lower is noise
        top -= 1
    fields, knot = {field.name: field for field in within.model.layout.fields}, float(problem.observations.times[top])
    varying = {change.name: change for change in problem.varying}
    for name, std in within.model.unforeseen.items():
        before = varying.get(name)
        knots, changes = (before.knots, before.changes) if before else ((), ())
        if not knots or knots[-1] < knot:
            field = fields.get(name, Field(name, unit="1"))
            more = StateChanges.of(within.model, field, [*knots, knot], std, relative=True)
            varying[name] = replace(more, changes=(*changes, more.changes[-1]))
    return within.varied([*varying.values()]) if varying else problem


def quantile(mean: Array, std: Array, level: float) -> Array:
    """(K,) of the mixture of Gaussians of equal weight with these means and standard deviations (N, K)."""
    low, high = (mean - 8 * std).min(axis=0), (mean + 8 * std).max(axis=0)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = ndtr((middle - mean) / std).mean(axis=0) < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high))
