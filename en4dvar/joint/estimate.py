"""A joint estimate from single ones: where it starts, the descents, the members and what they predict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.assimilate import assimilate
from en4dvar.caution import Caution, caution
from en4dvar.ensemble.forecast import Forecast, plotting_times
from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.joint.challenge import challenger
from en4dvar.joint.descent import JointDescent, Place, assembled, cost, descend
from en4dvar.joint.members import JointMembers, gaussian, sampled
from en4dvar.joint.problem import JointProblem
from en4dvar.joint.tangent import Experiment
from en4dvar.prior import Prior, own_seed
from en4dvar.problem import AssimilationSettings
from en4dvar.state import Array

TOLD = 0.5  # of J, by which descents differ that ended in different minima
CHALLENGES = 3  # rounds of looking for lower minima of single experiments
TRIED = 6  # experiments whose own estimate of what is shared is tried as a start


@dataclass(frozen=True)
class Single:
    """The estimate of one experiment by itself: mode (n,) and posterior precision (n, n), in units of the prior."""

    mode: Array
    precision: Array

    @classmethod
    def of_physical(cls, prior: Prior, members: Array, mode: Array) -> Single:
        """From the members (N, n) alive and the mode (n,) of a posterior. Raises ValueError outside a map's range."""
        z = (prior.from_physical(np.vstack([members, mode])) - prior.mean) / prior.std
        return cls(z[-1], np.linalg.inv(np.atleast_2d(np.cov(z[:-1].T))))


@dataclass(frozen=True)
class JointEstimate:
    """Posterior of a joint problem.

    ``members`` in units of the prior, ``mode`` where J is lowest, ``chi2`` (E,) per observation there, ``forecasts`` of
    the N members and, last, the mode, each read at ``grids`` too; ``cautions`` why not to trust it.
    """

    joint: JointProblem
    mode: Place
    members: JointMembers
    chi2: Array
    forecasts: tuple[Forecast, ...]
    grids: tuple[Array, ...]
    costs: tuple[float, ...]
    converged: bool
    stop_reason: str
    log_evidence: float
    forward_runs: int
    cautions: tuple[Caution, ...]

    @property
    def shared(self) -> Array:
        """(N, c) members of what is shared, physical."""
        return _physical(self.joint, self.members.border)

    @property
    def shared_mode(self) -> Array:
        """(c,) what is shared at the mode, physical."""
        return _physical(self.joint, self.mode.border)

    def control(self, e: int) -> Array:
        """(N + 1, n) physical members of experiment e and, last, the mode."""
        z = _points(self.joint, self.members, self.mode, e)
        return self.joint.experiments[e].prior.to_physical(self.joint.control(e, z))


def estimate_jointly(
    joint: JointProblem,
    settings: AssimilationSettings,
    seed: int,
    executor: Executor | None = None,
    singles: Sequence[Single] = (),
    tell: Callable[[str], None] = lambda words: None,
) -> JointEstimate:
    """Estimate all experiments together.

    Parameters
    ----------
    settings: members, epsilon, tolerances and ``refine`` (auto: corrected by importance where all models are cheap).
    singles: the estimates of the experiments alone, in their order, where the descents start; made where missing.
    tell: called with a line about each stage.

    Raises
    ------
    TooFewMembersError: no start can be run, or fewer members survive than ``min_active_fraction``.
    """
    with one_blas_thread():
        return _Estimate(joint, settings, seed, executor or SerialExecutor(), tell).result(singles)


class _Estimate:
    """One estimate; see :func:`estimate_jointly`."""

    def __init__(
        self, joint: JointProblem, settings: AssimilationSettings, seed: int, executor: Executor,
        tell: Callable[[str], None],
    ):  # fmt: skip
        self.joint, self.settings, self.seed, self.executor, self.tell = joint, settings, seed, executor, tell
        self.experiments = [Experiment(joint, e, settings.epsilon, executor) for e in range(len(joint.experiments))]
        self.runs_of_singles = 0

    def result(self, singles: Sequence[Single]) -> JointEstimate:
        joint, experiments = self.joint, self.experiments
        descents = self._descents(self._starts(singles or self._singles()))
        lowest = self._challenged(min(descents, key=lambda one: one.at.cost))
        self.tell(f"J {lowest.at.cost:.4g} after {len(lowest.costs) - 1} iterations, {lowest.stop}")
        members, cautions = self._members(lowest)
        grids = tuple(plotting_times(one) for one in joint.experiments)
        forecasts = tuple(one.run(_points(joint, members, lowest.at.place, one.e), grids[one.e]) for one in experiments)
        self._require(forecasts)
        if not lowest.converged:
            cautions.append(caution("not-converged", f"the joint estimate has not converged: {lowest.stop}"))
        if _agreeing(descents) < 2:
            words = f"none of {len(descents) - 1} further descents of the joint estimate ended in its lowest minimum"
            cautions.append(caution("starts-disagree", words))
        normalisation = sum(one.observations.log_normalisation() for one in joint.experiments)
        return JointEstimate(
            joint=joint,
            mode=lowest.at.place,
            members=members,
            chi2=np.array(
                [
                    float(one.observations.chi2_per_observation(local.central.predicted)[0])
                    for one, local in zip(joint.experiments, lowest.at.locals, strict=True)
                ]
            ),
            forecasts=forecasts,
            grids=grids,
            costs=tuple(lowest.costs),
            converged=lowest.converged,
            stop_reason=lowest.stop,
            log_evidence=members.log_evidence - normalisation,
            forward_runs=self.runs_of_singles + sum(one.forward_runs for one in experiments),
            cautions=tuple(cautions),
        )

    def _singles(self) -> list[Single]:
        """Each experiment by itself."""
        settings = replace(self.settings, refine="none", emulator="off", what_if=False)
        found = []
        for one in self.joint.experiments:
            self.tell(f"{one.observations.name} alone")
            analysis = assimilate(one, settings, own_seed(self.seed, one.observations.name), self.executor)
            self.runs_of_singles += analysis.forward_runs
            alive = np.isfinite(analysis.posterior).all(axis=1)
            found.append(Single.of_physical(one.prior, analysis.posterior[alive], analysis.centre))
        return found

    def _starts(self, singles: Sequence[Single]) -> list[Place]:
        """Where the quadratic forms of the single estimates meet, and where what is shared is as in one of them."""
        joint = self.joint
        likelihoods = [one.precision - np.eye(len(one.mode)) for one in singles]
        arrow, shared_pull, own_pulls = assembled(joint, likelihoods, [one.precision @ one.mode for one in singles])
        x, y = arrow.solve(shared_pull, own_pulls)
        starts = [Place(x, tuple(y))]
        for e in np.linspace(0, len(singles) - 1, min(TRIED, len(singles))).astype(int).tolist():
            shared, _ = joint.columns(e)
            own_value = x.copy()
            own_value[joint.of_border(e)] = singles[e].mode[shared]
            rest_modes = tuple(single.mode[joint.columns(i)[1]] for i, single in enumerate(singles))
            starts.append(Place(own_value, rest_modes))
        return starts

    def _descents(self, starts: Sequence[Place]) -> list[JointDescent]:
        """From one start after the other, that of lowest J first, until two have ended in the lowest minimum."""
        costs = np.array([cost(self.joint, self.experiments, start) for start in starts])
        found = list[JointDescent]()
        for i in np.argsort(costs, kind="stable"):
            if np.isfinite(costs[i]):
                found += self._descended(starts[i])
            if _agreeing(found) >= 2:
                break
        if not found:
            raise TooFewMembersError("the joint estimate: one of the experiments cannot be run from any start")
        return found

    def _descended(self, start: Place) -> list[JointDescent]:
        """One descent; none where the start cannot be run."""
        s = self.settings
        one = descend(self.joint, self.experiments, start, s.max_iterations, s.step_tolerance, s.cost_tolerance)
        return [one] if one else []

    def _challenged(self, lowest: JointDescent) -> JointDescent:
        """Or the descent from a lower minimum that single experiments have, looked for where runs are cheap."""
        for _ in range(CHALLENGES if all(one.model.cheap for one in self.joint.experiments) else 0):
            place = challenger(self.experiments, lowest.at, self.seed)
            lower = self._descended(place) if place else []
            if not lower or lower[0].at.cost >= lowest.at.cost:
                break
            lowest = lower[0]
        return lowest

    def _members(self, lowest: JointDescent) -> tuple[JointMembers, list[Caution]]:
        laplace = gaussian(lowest.at, self.seed, self.settings.members)
        if self.settings.refine == "none" or not all(one.model.cheap for one in self.joint.experiments):
            return laplace, []
        found = sampled(self.joint, self.experiments, lowest.at, self.seed, self.settings.members)
        if found is not None:
            return found, []
        words = "the joint posterior is far from Gaussian, and importance sampling did not reach it"
        return laplace, [caution("non-gaussian", words)]

    def _require(self, forecasts: Sequence[Forecast]) -> None:
        needed = self.settings.min_active_fraction
        for one, run in zip(self.joint.experiments, forecasts, strict=True):
            alive = int(run.active[:-1].sum())
            if alive < needed * (len(run) - 1):
                name, lost, count = one.observations.name, len(run) - 1 - alive, len(run) - 1
                raise TooFewMembersError(f"{name}: {lost} of {count} members of the joint posterior fail")


def _agreeing(descents: Sequence[JointDescent]) -> int:
    """How many descents ended in the lowest minimum."""
    lowest = min((one.at.cost for one in descents), default=np.inf)
    return sum(one.at.cost - lowest < TOLD for one in descents)


def _points(joint: JointProblem, members: JointMembers, mode: Place, e: int) -> Array:
    """(N + 1, n) members of experiment e and, last, the mode, in units of its prior."""
    return joint.standard(e, np.vstack([members.border, mode.border]), np.vstack([members.own[e], mode.own[e]]))


def _physical(joint: JointProblem, z: Array) -> Array:
    columns = [term.to_physical(term.mean + term.std * z[..., j]) for j, term in enumerate(joint.terms)]
    return np.stack(columns, axis=-1)
