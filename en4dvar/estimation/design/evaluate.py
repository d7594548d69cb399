r"""The worth of a design: expected information with its error, and what each parameter would be known to; and what else
must be known, and how well, for what is asked to become as well known as is wanted; and which readings to take.

Scale, density and pressure cannot be told from what is asked by more readings. A measurement of parameter b alone makes
its prior std f times as large: it adds (f⁻² − 1) w wᵀ / (w wᵀ) to the prior's precision in the coordinates u of
:class:`Planned`, w the row of W of this parameter. The posterior of what is asked, by linearisation, then grows with f,
also where priors are correlated, and the largest f that allows what is wanted is found by bisection.

The most informative few of many candidate readings are found by adding one at a time and then exchanging. The expected
information by linearisation grows by each reading's own rows of S alone, so that one set of runs at all candidates
tells it for every choice. To add the best one at a time comes within 1 − 1/e of the best choice where the information
is submodular (Krause & Guestrin 2005, UAI), as it is of independent readings about everything; exchanges then end in a
choice that no single exchange improves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge

from en4dvar.ensemble.forecast import plotting_times
from en4dvar.estimation.design.nested import Decision, deciding, nested, span_of_rounds
from en4dvar.estimation.design.planned import Planned, Tangents, expected, require_alive, shared_spread
from en4dvar.model.state import Array, Indices, Mask
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import own_seed
from en4dvar.problem import InverseProblem

Method = Literal["linear", "laplace", "nested"]
FAN = (0.05, 0.25, 0.5, 0.75, 0.95)
LEAST, MOST, HALVINGS = 1e-4, 1e3, 20  # factors: below it is exactly known, above it anything; to 2e-5
SWEEPS = 10  # of exchanges of the readings that are chosen, at most
WORTH = 1e-9  # nats: an exchange that gains less is none


@dataclass(frozen=True)
class SampleSizes:
    """How many draws and runs an evaluation takes; the one declaration of these keys of ``design:``."""

    draws: Annotated[int, Ge(20), "Draws of the prior at which the model is linearised."] = 200
    simulated: Annotated[int, Ge(20), "Draws whose readings are simulated and explained anew (``nested``)."] = 100
    inner: Annotated[int, Ge(50), "Runs behind each of two densities of simulated readings (``nested``)."] = 200


@dataclass(frozen=True)
class Evaluated:
    """One design, or so many ``alike``.

    ``gain`` nats with its Monte Carlo ``error``, by ``method``. ``std`` (a,) expected posterior std of each parameter
    that is asked for in its unit, ``relative`` (a,) to the value, ``ratio`` (a,) of posterior to prior std in
    transformed space. ``lost``: share of the draws at which the model fails; ``beyond``: share that leaves what the
    model is valid for. ``readings`` (k,) are taken, at ``times`` (k,). ``fan`` (5, M) are quantiles of what will be
    seen at ``grid`` (M,). ``forward_runs`` it took. ``thin``: share of the simulated readings that nested sampling
    explains by few effective draws. ``decision``: what it tells of which of several laws holds.
    ``needed`` (W, B + 1): how much larger the prior std of each of the B others, or of all, may be for what is wanted;
    ``others`` (2, B): those stds, in units and relative to the values.
    """

    gain: float
    error: float
    method: str
    std: Array
    relative: Array
    ratio: Array
    lost: float
    beyond: float
    readings: Array
    times: Array
    grid: Array
    fan: Array
    alike: int = 1
    forward_runs: int = 0
    thin: float = 0.0
    decision: Decision | None = None
    needed: Array | None = None
    others: Array | None = None

    @property
    def worth(self) -> float:
        """What designs are ranked by, nats: information about the law where that is asked, else :attr:`gain`."""
        return self.decision.information if self.decision else self.gain

    @property
    def worth_error(self) -> float:
        """Its Monte Carlo standard error."""
        return self.decision.information_error if self.decision else self.error


def span_of_runs(
    planned: Planned, sizes: SampleSizes, method: Method, choice: bool = False, laws: int = 0
) -> tuple[int, int]:
    """Forward runs of :func:`evaluate`, about, at least and as a rule at most."""
    n, simulated = len(planned.names), min(sizes.simulated, sizes.draws)
    runs = sizes.draws + n + 1 if method == "linear" else sizes.draws * (n + 1)
    runs += (choice * sizes.draws + laws * sizes.simulated) * (n + 1)
    integrals = laws**2 * sizes.simulated
    if method == "nested":
        runs += simulated * (n + 1)
        integrals += simulated * (1 if planned.asked == n else 2)
    least, most = span_of_rounds(integrals, sizes.inner)
    return runs + least * sizes.inner, runs + most * sizes.inner


def evaluate(
    problem: InverseProblem,
    about: Sequence[str],
    sizes: SampleSizes,
    method: Method,
    seed: int,
    alike: Sequence[int] = (1,),
    choice: tuple[int, float] | None = None,
    laws: Sequence[InverseProblem] = (),
    common: Sequence[str] = (),
    wanted: Mapping[str, tuple[float, bool]] | None = None,
    check: bool = False,
) -> tuple[Evaluated, ...]:
    """Evaluate a design, for every number of experiments ``alike``.

    ``choice``: how many of the readings are to be chosen, and how far apart in time. Several alike are evaluated by
    linearisation. ``laws``: the same experiment explained by each of several laws, read as ``problem`` is; which
    of them holds is asked as well. ``common``: parameters that experiments alike share beside those asked for.
    ``wanted``: name → std to which it is to be known, in its unit, or relative to the value where true; what the others
    must be known to for it is found by linearisation. ``check``: a nested estimate is ended as soon as it is known to
    be rough.

    Raises ConfigError: a name that is not estimated; a choice that is not possible. TooFewMembersError: the model
    fails.
    """
    before = 0
    if choice is not None:  # on draws of its own
        whole, weights = Planned(problem, about), np.zeros(len(problem.observations))
        weights[choose(whole, whole.draws(sizes.draws, own_seed(seed, "choice of readings")), *choice)] = 1
        problem = replace(problem, observations=replace(problem.observations, weights=weights))
        before = whole.forward_runs
    planned = Planned(problem, about, common)
    u = planned.draws(sizes.draws, seed)
    grid = plotting_times(problem)
    run = planned.run(u, grid)
    require_alive(int(run.active.sum()), len(u))
    tangents = planned.tangents(np.zeros((1, u.shape[1]))) if method == "linear" else planned.tangents(u, run)
    tried = 1 if method == "linear" else len(u)
    exceeds = np.isfinite(run.beyond[run.active]).any(axis=1)
    used = problem.observations.used
    designs, decision = [], None
    if laws:
        own = [Planned(replace(law, observations=problem.observations)) for law in laws]
        decision = deciding(own, sizes.simulated, sizes.inner, seed)
        before += sum(law.forward_runs for law in own)
    for n in alike:
        values = expected(planned, tangents, tried, n)
        gain, error, by = values.gain, values.error, str("laplace" if method == "nested" else method)
        thin = 0.0
        std, relative = in_units(planned, planned.about, values.std, tangents.u)
        linearised = np.stack([std, relative])
        ratio = values.std.mean(axis=0)
        if method == "nested" and n == 1:
            simulated = nested(planned, u[: sizes.simulated], sizes.inner, seed, check)
            more, its_error = simulated.correction
            gain, error, by = gain + more, float(np.hypot(error, its_error)), method
            thin = simulated.thin
            std, ratio = simulated.std.mean(axis=0), simulated.ratio.mean(axis=0)
            relative = np.median(simulated.relative, axis=0)
        more_than_linear = np.ones_like(linearised)
        np.divide([std, relative], linearised, out=more_than_linear, where=np.isfinite(linearised))
        needs = needed(planned, tangents, wanted, n, more_than_linear) if wanted else (None, None)
        designs.append(
            Evaluated(
                gain=gain,
                error=error,
                method=by,
                std=std,
                relative=relative,
                ratio=ratio,
                lost=values.lost,
                beyond=float(exceeds.mean()) if len(exceeds) else 0.0,
                readings=used.astype(float),
                times=problem.observations.times[used],
                grid=grid[: run.path.shape[1]],  # of a field there is no path
                fan=np.quantile(run.path[run.active][:, : len(grid)], FAN, axis=0),
                alike=n,
                forward_runs=before + planned.forward_runs,
                thin=thin,
                decision=decision,
                needed=needs[0],
                others=needs[1],
            )
        )
    return tuple(designs)


def in_units(planned: Planned, names: tuple[str, ...], ratio: Array, u: Array) -> tuple[Array, Array]:
    """Standard deviations of parameters (a,), given relative to the prior's in transformed space at draws ``u``.

    ``ratio`` (R, a). In their units, the mean over the draws (R, n), and relative to the value, the median; with the
    slope of the parameter map at each draw.
    """
    prior, std, relative = planned.problem.prior, np.empty(len(names)), np.empty(len(names))
    x, physical = planned.control(u), prior.to_physical(planned.control(u))
    for a, name in enumerate(names):
        j = prior.names.index(name)
        slopes = np.array([prior.terms[j].slope(float(value)) for value in x[:, j]])
        of_draws = ratio[:, a] * prior.std[j] * np.abs(slopes)
        with np.errstate(divide="ignore"):
            std[a], relative[a] = of_draws.mean(), np.median(of_draws / np.abs(physical[:, j]))
    return std, relative


def needed(
    planned: Planned, tangents: Tangents, wanted: Mapping[str, tuple[float, bool]], alike: int, scale: Array
) -> tuple[Array, Array]:
    """Factors (W, B + 1) of the prior stds of the B others, one by one and (the last) all at once.

    They are the largest that allow each of ``wanted``: name → standard deviation in its unit, or, where true, relative
    to the value. 0: not even if it were known exactly; inf: whatever it is; of all others 1 where it is met as planned.
    ``scale`` (2, a) is by how much an estimate that is not linear has found more than this one, in units and relative.
    Also the prior stds (2, B) of the others, in their units and relative to their values.
    """
    _, sensitivities = tangents.whitened(planned)
    information = np.einsum("rki,rkj->rij", sensitivities, sensitivities)
    rows = planned.root[planned.order][planned.asked :]
    directions, count = rows / np.linalg.norm(rows, axis=1, keepdims=True), len(rows)

    def measured(some: Array, at: tuple[int, int], factor: float) -> float:
        prior = np.eye(directions.shape[1]) + (factor**-2 - 1) * (directions.T * some) @ directions
        ratio = shared_spread(planned, information, alike, prior)[1]
        return float((np.stack(in_units(planned, planned.about, ratio, tangents.u)) * scale)[at])

    largest = np.empty((len(wanted), count + 1))
    for factors, (name, (most, relative)) in zip(largest, wanted.items(), strict=True):
        at = int(relative), planned.about.index(name)
        for b, some in enumerate(np.vstack([np.eye(count), np.ones(count)])):
            factors[b] = _largest(partial(measured, some, at), most, MOST if b < count else 1.0)
    others = in_units(planned, planned.names[planned.asked :], np.ones((len(tangents.u), count)), tangents.u)
    return largest, np.stack(others)


def _largest(measure: Callable[[float], float], wanted: float, most: float) -> float:
    """The largest factor at which a measure that grows with it is at most what is ``wanted``."""
    if measure(most) <= wanted:
        return np.inf if most == MOST else most
    if measure(LEAST) > wanted:
        return 0.0
    low, high = np.log(LEAST), np.log(most)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if measure(float(np.exp(middle))) <= wanted else (low, middle)
    return float(np.exp(low))


def choose(planned: Planned, u: Array, count: int, apart: float = 0.0) -> Indices:
    """The ``count`` readings that tell most, each ``apart`` from the others in time, from draws (R, n) of the prior.
    Readings of weight 0 are none to choose from.

    Raises ConfigError: errors that are correlated; no such choice is possible. TooFewMembersError: the model mostly
    fails.
    """
    observations = planned.problem.observations
    if not observations.noise.independent:
        raise ConfigError("readings can be chosen where their errors are independent of each other")
    tangents = planned.tangents(u)
    require_alive(len(tangents.at), len(u))
    _, rows = tangents.whitened(planned)
    counted = np.flatnonzero(observations.weights)
    counted = counted[np.argsort(observations.times[counted], kind="stable")]  # those of several series, too
    search = _Search(rows.reshape(len(rows), -1, len(observations), rows.shape[2])[:, :, counted], planned.asked)
    times = observations.times[counted]
    near = np.abs(np.subtract.outer(times, times)) < apart * (1 - 1e-9)
    np.fill_diagonal(near, True)
    chosen: list[int] = []
    for _ in range(count):
        order = np.argsort(-search.gains(), kind="stable").tolist()
        possible = (k for k in order if not near[chosen, k].any() and _room(near, [*chosen, k]) >= count)
        best = next(possible, None)
        if best is None:
            raise ConfigError(f"no {count} of {len(counted)} readings lie so far apart from each other")
        chosen.append(best)
        search.add(best, 1)
    for _ in range(SWEEPS):
        moved = False
        for place, reading in enumerate(chosen):
            search.add(reading, -1)
            others = [k for k in chosen if k != reading]
            gains = np.where(near[others].any(axis=0), -np.inf, search.gains())
            better = int(np.argmax(gains))
            if gains[better] > gains[reading] + WORTH:
                chosen[place], moved = better, True
            search.add(chosen[place], 1)
        if not moved:
            break
    return np.sort(counted[np.array(chosen, dtype=np.intp)])


class _Search:
    """Information of a growing set of readings, from their rows (R, B, K, n): B of each reading, of R draws."""

    def __init__(self, rows: Array, asked: int):
        self.rows, self.others = rows.transpose(0, 2, 1, 3), rows.transpose(0, 2, 1, 3)[..., asked:]
        self.precision = np.tile(np.eye(rows.shape[-1]), (len(rows), 1, 1))
        self.asked = asked

    def add(self, k: int, sign: int) -> None:
        """Reading k, or take it away."""
        own = self.rows[:, k]
        self.precision = self.precision + sign * np.einsum("rbi,rbj->rij", own, own)

    def gains(self) -> Array:
        """(K,) mean information, nats, that each reading would add."""
        a = self.asked
        return _added(self.rows, self.precision) - _added(self.others, self.precision[:, a:, a:])


def _room(near: Mask, chosen: list[int]) -> int:
    """How many readings can be chosen in all beside these, the earliest that is free each time."""
    blocked, count = np.asarray(near[chosen].any(axis=0)), len(chosen)
    for k in range(len(blocked)):
        if not blocked[k]:
            blocked, count = blocked | near[k], count + 1
    return count


def _added(rows: Array, precision: Array) -> Array:
    """(K,) mean ½ ln det(I + s M⁻¹ sᵀ) of rows s (R, K, B, n)."""
    if not rows.shape[-1]:
        return np.zeros(rows.shape[1])
    half = np.einsum("rkbi,rij->rkbj", rows, np.linalg.inv(precision))
    inner = np.eye(rows.shape[2]) + np.einsum("rkbj,rkcj->rkbc", half, rows)
    return np.asarray(0.5 * np.linalg.slogdet(inner)[1].mean(axis=0))
