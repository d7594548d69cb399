"""A joint estimate from single ones: where it starts, the descents, the members and what they predict."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.observations import require_distinct
from en4dvar.descent.loop import minimise
from en4dvar.descent.weight_space import require_members
from en4dvar.diagnosis.diagnostics import active_members
from en4dvar.diagnosis.honesty import checks
from en4dvar.ensemble.forecast import Forecast, plotting_times
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.conclusions import missing_readings
from en4dvar.estimation.joint.agreement import (
    AT_MOST,
    Agreement,
    Statement,
    agreement,
    doubts,
    is_odd,
    left_out,
    oddest,
)  # fmt: skip
from en4dvar.estimation.joint.descent import Experiment, JointDescent, JointObjective, Place, assembled
from en4dvar.estimation.joint.members import JointMembers, challenger, gaussian, sampled, span_of_runs
from en4dvar.estimation.joint.problem import JointProblem, Single
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.plumbing.hints import counted, rounded
from en4dvar.priors.prior import Prior, own_seed
from en4dvar.schemes import MINIMISERS
from en4dvar.schemes.settings import AssimilationSettings

TOLD = 0.5  # of J, by which descents differ that ended in different minima
CHALLENGES = 3  # rounds of looking for lower minima of single experiments
TRIED = 6  # experiments whose own estimate of what is shared is tried as a start


@dataclass(frozen=True)
class JointEstimate:
    """Posterior of a joint problem.

    ``members`` in units of the prior, ``mode`` where J is lowest, ``chi2`` (E,) per observation there, of others than
    odd experiments without these, ``forecasts`` of the N members and, last, the mode, each read at ``grids`` too;
    ``cautions`` why not to trust it. ``agreement`` of each experiment with all others; ``without`` the oddest of them
    the same estimate, None where none is odd. Where one is, members are those of the Gaussian about the mode: no
    interval with an odd experiment is quoted, and to draw them would take as long as those without it.
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
    agreement: Agreement
    without: "JointEstimate | None" = None

    @property
    def odd(self) -> tuple[str, ...]:
        """Names of the experiments that do not share the values of the others."""
        return tuple(name for name in self.joint.names if name not in self.rest.joint.names)

    @property
    def rest(self) -> "JointEstimate":
        """The estimate without any odd experiment."""
        return self.without.rest if self.without else self

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
        prior = self.joint.experiments[e].prior
        return prior.to_physical(prior.from_white(_points(self.joint, self.members, self.mode, e)))


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
    ConfigError: a scheme that does not minimise J; readings that would count twice.
    TooFewMembersError: no start can be run, or fewer members survive than ``min_active_fraction``.
    """
    require_distinct([problem.observations for problem in joint.experiments])
    with one_blas_thread():
        return _Estimate(joint, settings, seed, executor or SerialExecutor(), tell).result(singles)


class _Estimate:
    """One estimate; see :func:`estimate_jointly`."""

    def __init__(
        self, joint: JointProblem, settings: AssimilationSettings, seed: int, executor: Executor,
        tell: Callable[[str], None],
    ):  # fmt: skip
        self.joint, self.settings, self.seed, self.executor, self.tell = joint, settings, seed, executor, tell
        if settings.own.minimiser is None:
            others = " or ".join(MINIMISERS)
            raise ConfigError(f"{settings.scheme} does not minimise J, as a joint estimate must; use {others}")
        scheme = settings.own.minimiser
        self.experiments = [Experiment(joint, e, scheme.epsilon, executor) for e in range(len(joint.experiments))]
        self.objective = JointObjective(joint, self.experiments, scheme)
        self.other_runs = 0

    def result(self, singles: Sequence[Single]) -> JointEstimate:
        if self.samples:
            runs = f"{rounded(*span_of_runs(len(self.experiments)))} forward runs, beside some thousands of the search"
            self.tell(f"cost: members of {len(self.experiments)} data sets are drawn by about {runs}")
        singles = singles or self._singles()
        return self._concluded(singles, *self._minimised(singles), int(AT_MOST * len(self.experiments)))

    def _minimised(self, singles: Sequence[Single]) -> tuple[list[JointDescent], JointDescent]:
        """The descents, and that of lowest J."""
        descents = self._descents(self._starts(singles))
        lowest = self._challenged(min(descents, key=lambda descent: descent.at.cost))
        self.tell(f"J {lowest.at.cost:.4g} after {counted(len(lowest.costs) - 1, 'iteration')}, {lowest.stop}")
        return descents, lowest

    def _concluded(
        self, singles: Sequence[Single], descents: Sequence[JointDescent], lowest: JointDescent, most: int
    ) -> JointEstimate:
        """The estimate, and that without the experiments, at ``most`` so many, that are odd."""
        joint, experiments = self.joint, self.experiments
        own = [single.mode[joint.columns(e)[1]] for e, single in enumerate(singles)]  # J_o + J_b of these, alone
        each = zip(experiments, singles, own, strict=True)
        alone = np.array([float(e.costs(s.mode[None])[0] + 0.5 * v @ v) for e, s, v in each])
        said = [Statement.of(joint, e, single) for e, single in enumerate(singles)]
        without = self._without(lowest.at.cost, singles, said, alone, most) if most else None
        members, cautions = self._members(lowest, drawn=self.samples and not without)
        grids, stage = tuple(map(plotting_times, joint.experiments)), "forecast of the joint posterior"
        forecasts = tuple(
            experiment.run(_points(joint, members, lowest.at.place, experiment.e), grids[experiment.e])
            for experiment in experiments
        )
        needed = math.ceil(self.settings.min_active_fraction * len(members.border))
        for problem, run in zip(joint.experiments, forecasts, strict=True):
            require_members(problem, run[:-1], needed, stage)
        lost = [
            next(filter(None, reasons), "") for reasons in zip(*(run.failures[:-1] for run in forecasts), strict=True)
        ]
        if any(lost):
            if (alive := active_members(lost)).sum() >= needed:  # else no interval is trusted
                members = members.of(alive)
                forecasts = tuple(run[np.flatnonzero([*alive, True])] for run in forecasts)  # the mode is last
            advice = "the posterior holds only where all models run: find out why they fail, or give narrower priors"
            cautions += [replace(c, advice=advice) for c in checks.loss(stage, lost, Prior(()))]
        cautions += missing_readings(max(forecast.filled for forecast in forecasts))
        if not lowest.converged:
            advice = "make the runs again with a larger assimilation.max_iterations (that of the first counts)"
            told = caution("not-converged", f"the joint estimate has not converged: {lowest.stop}")
            cautions.append(replace(told, advice=f"{advice}, or narrower priors"))
        if _agreeing(descents) < 2:
            words = f"none of {len(descents) - 1} further descents of the joint estimate ended in its lowest minimum"
            advice = "a lower one may not have been found: make the runs again with narrower priors"
            cautions.append(replace(caution("starts-disagree", words), advice=advice))
        names = without.rest.joint.names if without else joint.names
        kept = [e for e, name in enumerate(joint.names) if name in names]
        costs = [form.cost + 0.5 * float(v @ v) for form, v in zip(lowest.at.forms, lowest.at.place.own, strict=True)]
        agreed = agreement(joint, said, kept, 2 * np.maximum(costs - alone, 0))
        chi2 = lowest.at.chi2(joint)
        if without:
            chi2[kept] = without.rest.chi2
            cautions += left_out(joint, chi2, agreed, kept, without.rest.cautions)
        else:
            cautions += doubts(joint, lowest.at.place, chi2, agreed, singles)
        normalisation = sum(problem.observations.log_normalisation() for problem in joint.experiments)
        return JointEstimate(
            joint=joint,
            mode=lowest.at.place,
            members=members,
            chi2=chi2,
            forecasts=forecasts,
            grids=grids,
            costs=tuple(lowest.costs),
            converged=lowest.converged,
            stop_reason=lowest.stop,
            log_evidence=members.log_evidence - normalisation,
            forward_runs=self.forward_runs,
            cautions=tuple(cautions),
            agreement=agreed,
            without=without,
        )

    def _without(
        self, cost: float, singles: Sequence[Single], said: Sequence[Statement], alone: Array, most: int
    ) -> JointEstimate | None:
        """The estimate without the oddest experiment, if J is then lower by more than chance explains."""
        e = oddest(said)
        if e is None:
            return None
        kept = [i for i in range(len(singles)) if i != e]
        self.tell(f"once more without {self.joint.names[e]}")
        estimate = _Estimate(self.joint.of(kept), self.settings, self.seed, self.executor, self.tell)
        others = [singles[i] for i in kept]
        descents, lowest = estimate._minimised(others)
        odd = is_odd(said, e, 2 * (cost - lowest.at.cost - alone[e]))
        rest = estimate._concluded(others, descents, lowest, most - 1) if odd else None
        self.other_runs += estimate.forward_runs
        return rest

    def _singles(self) -> list[Single]:
        settings = replace(self.settings, refine="none", emulator="off", what_if=False)
        singles = []
        for problem in self.joint.experiments:
            self.tell(f"{problem.observations.name} alone")
            analysis = assimilate(problem, settings, own_seed(self.seed, problem.observations.name), self.executor)
            self.other_runs += analysis.forward_runs
            singles.append(Single.of_physical(problem.prior, analysis.survivors, analysis.centre))
        return singles

    def _starts(self, singles: Sequence[Single]) -> list[Place]:
        """Where the quadratic forms of the single estimates meet, and where what is shared is as in one of them, with
        what is each experiment's own followed there from its single estimate.
        """
        joint = self.joint
        likelihoods = [single.precision - np.eye(len(single.mode)) for single in singles]
        arrow, a, b = assembled(joint, likelihoods, [single.precision @ single.mode for single in singles])
        meeting, _ = arrow.solve(a, b)
        tried = np.linspace(0, len(singles) - 1, min(TRIED, len(singles))).astype(int).tolist()
        border = np.tile(meeting, (1 + len(tried), 1))
        for row, e in zip(border[1:], tried, strict=True):
            row[joint.of_border(e)] = singles[e].mode[joint.columns(e)[0]]
        own = []
        for e, (experiment, single) in enumerate(zip(self.experiments, singles, strict=True)):
            (shared, rest), origin = joint.columns(e), np.zeros(len(meeting))
            origin[joint.of_border(e)] = single.mode[shared]
            edge = arrow.edges[e]
            own.append(experiment.followed(border, origin, single.mode[rest], arrow.blocks[e], edge)[0])
        return [Place(row, tuple(v[i] for v in own)) for i, row in enumerate(border)]

    def _descents(self, starts: Sequence[Place]) -> list[JointDescent]:
        """From one start after the other, that of lowest J first, until two have ended in the lowest minimum."""
        costs = np.array([self.objective.try_out([start]) for start in starts])
        descents = list[JointDescent]()
        for i in np.argsort(costs, kind="stable"):
            if np.isfinite(costs[i]):
                descents += self._descended(starts[i])
            if _agreeing(descents) >= 2:
                break
        if not descents:
            raise TooFewMembersError("the joint estimate: one of the experiments cannot be run from any start")
        return descents

    def _descended(self, start: Place) -> list[JointDescent]:
        descent = JointDescent(start)
        minimise(self.objective, [descent])
        return [descent] if descent.system else []

    def _challenged(self, lowest: JointDescent) -> JointDescent:
        """Or the descent from a lower minimum that single experiments have, looked for where runs are cheap."""
        for _ in range(CHALLENGES if all(problem.model.cheap for problem in self.joint.experiments) else 0):
            place = challenger(self.experiments, lowest.at, self.seed)
            lower = self._descended(place) if place else []
            if not lower or lower[0].at.cost >= lowest.at.cost:
                break
            lowest = lower[0]
        return lowest

    @property
    def samples(self) -> bool:
        """Whether members are drawn by importance where no experiment is odd."""
        return self.settings.refine != "none" and all(problem.model.cheap for problem in self.joint.experiments)

    @property
    def forward_runs(self) -> int:
        return self.other_runs + sum(each.composite.forward_runs for each in self.experiments)

    def _members(self, lowest: JointDescent, drawn: bool) -> tuple[JointMembers, list[Caution]]:
        laplace = gaussian(lowest.at, self.seed, self.settings.members)
        if not drawn:
            return laplace, []
        members = sampled(self.experiments, lowest.at, self.seed, self.settings.members, self.tell)
        if members is not None:
            return members, []
        words = "the joint posterior is far from Gaussian, and importance sampling did not reach it"
        advice = "share fewer parameters, or ask how much they vary, by chains (en4dvar population)"
        return laplace, [replace(caution("non-gaussian", words), advice=advice)]


def _agreeing(descents: Sequence[JointDescent]) -> int:
    lowest = min((descent.at.cost for descent in descents), default=np.inf)
    return sum(descent.at.cost - lowest < TOLD for descent in descents)


def _points(joint: JointProblem, members: JointMembers, mode: Place, e: int) -> Array:
    """(N + 1, n) members of experiment e and, last, the mode, in units of its prior."""
    return joint.standard(e, np.vstack([members.border, mode.border]), np.vstack([members.own[e], mode.own[e]]))


def _physical(joint: JointProblem, z: Array) -> Array:
    columns = [term.to_physical(term.mean + term.std * z[..., j]) for j, term in enumerate(joint.terms)]
    return np.stack(columns, axis=-1)
