"""The worth of a design: expected information with its error, and what each parameter would be known to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge

from en4dvar.ensemble.forecast import plotting_times
from en4dvar.estimation.design.laplace import expected, require_alive
from en4dvar.estimation.design.laws import Decision, deciding
from en4dvar.estimation.design.needed import in_units, needed
from en4dvar.estimation.design.nested import nested
from en4dvar.estimation.design.planned import Planned
from en4dvar.estimation.design.readings import choose
from en4dvar.model.state import Array
from en4dvar.priors.prior import own_seed
from en4dvar.problem import InverseProblem

Method = Literal["linear", "laplace", "nested"]
FAN = (0.05, 0.25, 0.5, 0.75, 0.95)


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
    seen at ``grid`` (M,). ``forward_runs`` it took. ``decision``: what it tells of which of several laws holds.
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
    decision: Decision | None = None
    needed: Array | None = None
    others: Array | None = None

    @property
    def worth(self) -> float:
        """The measure by which designs are ranked, nats: information about the law where that is asked, else
        :attr:`gain`.
        """
        return self.decision.information if self.decision else self.gain

    @property
    def worth_error(self) -> float:
        """Its Monte Carlo standard error."""
        return self.decision.information_error if self.decision else self.error


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
) -> tuple[Evaluated, ...]:
    """Evaluate a design, for every number of experiments ``alike``.

    ``choice``: how many of the readings are to be chosen, and how far apart in time. Several alike are evaluated by
    linearisation. ``laws``: the same experiment explained by each of several laws, read as ``problem`` is; which
    of them holds is asked as well. ``common``: parameters that experiments alike share beside those asked for.
    ``wanted``: name → std to which it is to be known, in its unit, or relative to the value where true; what the others
    must be known to for it is found by linearisation.

    Raises
    ------
    ConfigError: a name that is not estimated; a choice that is not possible. TooFewMembersError: the model fails.
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
        std, relative = in_units(planned, planned.about, values.std, tangents.u)
        linearised = np.stack([std, relative])
        ratio = values.std.mean(axis=0)
        if method == "nested" and n == 1:
            simulated = nested(planned, u[: sizes.simulated], sizes.inner, seed)
            more, its_error = simulated.correction
            gain, error, by = gain + more, float(np.hypot(error, its_error)), method
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
                grid=grid,
                fan=np.quantile(run.path[run.active][:, : len(grid)], FAN, axis=0),
                alike=n,
                forward_runs=before + planned.forward_runs,
                decision=decision,
                needed=needs[0],
                others=needs[1],
            )
        )
    return tuple(designs)
