"""J of one data set, as the loop minimises it: its runs, how far a step goes, records, and when a descent has ended.

A scheme that searches minimises J: steps are judged by J of the central run, and none that raises it is accepted. A
regression over the ensemble settles in the end (:class:`~en4dvar.descent.step_control.Settling`). Any other scheme
takes its steps as they are; J and its Gauss–Newton step, from a regression over the ensemble, are then there for the
record only.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.data.noise import Linearisation, Predicted
from en4dvar.descent.loop import Descends, Objective
from en4dvar.descent.step_control import NEAR, STEP_CONTROLS, Move, Point, Search, Settling, Tangent, Trials, each_once
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import IterationRecord, Record
from en4dvar.diagnosis.diagnostics import SHORT_STEP, UNSEEN
from en4dvar.ensemble.forecast import NO_TIMES, Forecast
from en4dvar.ensemble.linalg import LowRank
from en4dvar.ensemble.missing import filled
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.plumbing.hints import counted
from en4dvar.priors.prior import member_stream
from en4dvar.schemes.asked import is_done, linearised, members_of, step_of
from en4dvar.schemes.base import Evaluation, GaussNewtonStep, Runs, Step, Weights, gauss_newton, regression

WIDER, WIDEST = 5.0, 25.0  # factors of a bundle where J does not fall along the step: of each further look, in all
FAKED = 3.0  # posterior standard deviations: a longer step does not come from the model's own error


@dataclass(frozen=True)
class Iterate:
    """What the runs at the weights of a descent say: ``members`` beside the ``central`` run, J_b and J_o at the centre.

    ``linear`` is the linearisation there, in coordinates of the basis, once it is known.
    """

    members: Forecast
    central: Forecast
    background: float
    observation: float
    linear: Linearisation | None = None

    @property
    def cost(self) -> float:
        return self.background + self.observation


@dataclass
class Descent(Descends):
    """One descent: where it stands, the records of its iterations, and why it ended.

    ``worst_loss`` are the reasons of failure in the iteration that lost most members, or empty. ``cost`` is J where it
    was last evaluated. A descent whose ``stop`` is set ends with the next iterate, which is recorded and not left.
    ``members`` are those of the prior ensemble from which descents go on as this one: its own, and of those that met
    it, at J of up to ``highest``; ``passed`` are steps of theirs, and J to which these led by the linearisation.
    ``settling`` is there once a regression has come close to its end. ``at`` and ``step`` belong to the iteration under
    way.
    """

    weights: Weights
    records: tuple[IterationRecord, ...] = ()
    worst_loss: tuple[str, ...] = ()
    cost: float = math.inf
    members: tuple[int, ...] = ()
    highest: float = -math.inf
    settling: Settling | None = None
    passed: tuple[tuple[GaussNewtonStep, float], ...] = ()
    at: Iterate | None = None
    step: Step | GaussNewtonStep | None = field(default=None, kw_only=True)

    @property
    def iteration(self) -> int:
        """Number of the iteration under way, from 0."""
        return len(self.records)

    @property
    def newton(self) -> GaussNewtonStep:
        """The step, of a scheme that searches, or of J for the record."""
        assert isinstance(self.step, GaussNewtonStep)
        return self.step

    @property
    def at_minimum(self) -> bool:
        """Whether J may be expanded about where it ended."""
        return self.converged or self.newton.norm <= SHORT_STEP

    @property
    def iterate(self) -> Iterate:
        assert self.at is not None
        return self.at


class DataWindow(Objective[Descent]):
    """The window of an estimate: one descent, to the minimum of J or through the passes of a scheme.

    ``first`` is the forecast of the members and the centre where it starts, which a scheme that runs its whole ensemble
    does not repeat; with ``grid`` (M,) its last forecast is read along these times as well, as that of the posterior.
    """

    def __init__(
        self,
        space: WeightSpace,
        tell: Callable[[Record], None] = lambda record: None,
        first: Forecast | None = None,
        grid: Array = NO_TIMES,
    ):
        self.space, self.tell, self.first, self.grid = space, tell, first, grid
        self.scheme, self.observations = space.scheme, space.problem.observations
        self.tangents: list[tuple[Array, Array, Array]] = []  # weights (N,), reference (Ky,) and anomalies there

    def linearise(self, going: Sequence[Descent]) -> list[Step | GaussNewtonStep | None]:
        self.tangents = []
        each = zip(going, self.run(going), strict=True)
        return [None if runs is None else self._advanced(descent, runs) for descent, runs in each]

    def _advanced(self, descent: Descent, runs: Runs) -> Step | GaussNewtonStep:
        reference, anomalies = linearised(self.scheme, descent.weights, runs)
        self.tangents.append((descent.weights.w, reference, anomalies))
        evaluation = self.whiten(descent, reference, anomalies)
        return step_of(self.scheme, descent.weights, evaluation, descent.iteration, self.draw)

    def run(self, going: Sequence[Descent]) -> list[Runs | None]:
        """The members of the scheme through F and H, all descents in one call; None where too few of them survive."""
        space, scheme = self.space, self.scheme
        if not scheme.minimiser:
            return [self._run_ensemble(descent) for descent in going]
        rows = [[*members_of(scheme, d.weights, space.basis), d.weights.w] for d in going]
        runs = space.about(space.control(np.array([row for each in rows for row in each])), list(map(len, rows)))
        return [self._arrive(descent, run) for descent, run in zip(going, runs, strict=True)]

    def whiten(self, descent: Descent, reference: Array, anomalies: Array) -> Evaluation:
        """By Fisher scoring; for a scheme that runs its whole ensemble with the R at its mean."""
        like = descent.iterate.central.predicted[0]
        if self.scheme.minimiser:
            return self._evaluation(descent, Linearisation.of_stacked(like, reference, anomalies))
        mean, k = like.unstacked(reference), like.values.shape[-1]
        linear = Linearisation(Predicted(mean.values), anomalies[:, :k])
        noise = self.observations.noise.frozen(mean)
        return Evaluation(*noise.whiten(self.observations.values, self.observations.weights, linear))

    def draw(self, purpose: str, columns: int | None = None) -> Array:
        n_members, size = len(self.space.members), columns or len(self.observations)
        return np.stack([member_stream(self.space.seed, purpose, i).standard_normal(size) for i in range(n_members)])

    def judge(self, going: Sequence[Descent]) -> None:
        for descent in going:
            self._require_step(descent)
            if self.scheme.minimiser is None or descent.stop:
                continue
            scheme, norm = self.space.minimiser, descent.newton.norm
            if norm <= scheme.step_tolerance:
                descent.stop, descent.converged = f"step of {norm:.2g} posterior standard deviations", True
            elif descent.iteration == scheme.max_iterations:
                descent.stop = f"iteration limit ({scheme.max_iterations}) reached"

    def search(self, descent: Descent) -> Search | None:
        return None if self.scheme.minimiser is None or self._settles(descent) else self.searched(descent)

    def try_out(self, candidates: Array) -> Trials:
        return self.space.try_out(candidates, self._expected)

    def _expected(self, w: Array) -> Array:
        """Predictions (B, Ky) at weights (B, N), by the linearisation about the closest of the descents."""
        basis, centres = self.space.basis, np.array([centre for centre, _, _ in self.tangents])
        closest = np.argmin(np.linalg.norm(w[:, None] - centres, axis=2), axis=1)
        each = ((at, *self.tangents[i]) for at, i in zip(w, closest, strict=True))
        return np.array([reference + (at - centre) @ basis @ anomalies for at, centre, reference, anomalies in each])

    def searched(self, descent: Descent) -> Search:
        point = self._point(descent)
        search = STEP_CONTROLS[self.space.minimiser.step_control](point)
        return each_once(search) if point.sparing else search

    def move(self, going: Sequence[Descent], moves: Sequence[Move | None]) -> None:
        for descent, move in zip(going, moves, strict=True):
            if self.scheme.minimiser:
                self._go_on(descent, move)
            else:
                self._take(descent)
            self.tell(descent.records[-1])

    def record(self, descent: Descent, transform: Array | LowRank, step_length: float) -> None:
        """Add the record of an iterate: the ensemble of ``transform`` (N, N) there, and how far it is left."""
        space, at, step = self.space, descent.iterate, descent.newton
        ensemble = space.ensemble(descent.weights.w, transform)
        physical = space.problem.prior.to_physical(ensemble)
        record = IterationRecord(
            iteration=descent.iteration,
            cost=at.cost,
            background=at.background,
            observation=at.observation,
            step_norm=step.norm,
            step_length=step_length,
            chi2_per_observation=float(self.observations.chi2_per_observation(at.central.predicted)[0]),
            dfs=diag.dfs(step.hessian.singular_values, len(space.members)),
            spread=float(diag.spread(ensemble[:-1], space.prior_variance)),
            active=self._informing(at),
            members=physical[:-1],
            centre=physical[-1],
        )
        descent.records += (record,)
        descent.worst_loss = max(descent.worst_loss, at.members.failures, key=lambda lost: sum(map(bool, lost)))

    def small(self, cost: float) -> float:
        """A decrease of J that counts as none; below J = 1 it is absolute, for there J has no more to tell."""
        return self.space.minimiser.cost_tolerance * max(cost, 1.0)

    @property
    def _flat(self) -> str:
        return f"relative decrease of J below {self.space.minimiser.cost_tolerance:g}"

    def _go_on(self, descent: Descent, move: Move | None) -> None:
        at, step, again = descent.iterate, descent.newton, None
        if move is None and not descent.stop and not self._settles(descent):
            again = self._look_again(descent)
            if again is None:
                self._no_decrease(descent)
        if not descent.stop and move is None and again is None:
            self._settle(descent)
            return
        self.record(descent, step.hessian.economical_transform, move.step_length if move else 0.0)
        descent.ended = bool(descent.stop)
        if again is not None:
            descent.weights = again
        if move is None:
            return
        if at.cost - move.cost <= self.small(at.cost) and step.predicted_decrease <= self.small(at.cost):
            descent.stop, descent.converged = self._flat, True  # after one more forecast, to linearise at the end point
        descent.weights = self._onwards(descent, move.w)

    def _no_decrease(self, descent: Descent) -> None:
        """The search by J has ended; a regression goes on to settle."""
        if self.space.minimiser.regresses:
            return
        promised, small = descent.newton.predicted_decrease, self.small(descent.iterate.cost)
        descent.stop = self._flat if promised <= small else "no decrease possible along the step"
        descent.converged = promised <= max(small, 0.5 * UNSEEN**2)

    def _settles(self, descent: Descent) -> bool:
        near = descent.settling is not None or descent.newton.norm <= NEAR
        return self.space.minimiser.regresses and near

    def _settle(self, descent: Descent) -> None:
        step = descent.newton
        descent.settling = settling = (descent.settling or Settling()).after(step.norm)
        self.record(descent, step.hessian.economical_transform, settling.share)
        w = descent.weights.w + settling.share * step.direction
        descent.weights = replace(descent.weights, w=w) if settling.held else self._onwards(descent, w)

    def _look_again(self, descent: Descent) -> Weights | None:
        """The same centre with members that may show the way down, where J does not fall along the step; else None.

        For a regression that is a narrower ensemble. Of finite differences the step may come from the model's own
        error, which jumps where its solver takes other time steps: a wider bundle feels that less.
        """
        weights = descent.weights
        onwards = self._onwards(descent, weights.w)
        if not self.space.minimiser.regresses:
            doubtful = UNSEEN < descent.newton.norm < FAKED and weights.wider < WIDEST
            return replace(onwards, wider=WIDER * weights.wider) if doubtful else None
        apart = np.abs(self.scheme.members(onwards) - self.scheme.members(weights))
        return None if np.max(apart) <= self.space.minimiser.step_tolerance else onwards  # it would run the same again

    def _onwards(self, descent: Descent, w: Array) -> Weights:
        """Weights at w (N,), with the transform of where the descent comes from and a bundle as wide."""
        return replace(self.space.weights_at(w, descent.newton.hessian), wider=descent.weights.wider)

    def _take(self, descent: Descent) -> None:
        """The whole step; the iterate after the last one is recorded, too."""
        # The Gauss–Newton step of J that an ensemble that was run as a whole tells
        at = descent.iterate
        runs = Runs(at.members.predicted.stacked, at.central.predicted.stacked[0], at.members.active)
        reference, anomalies = self._regressed(descent, runs)
        linear = Linearisation.of_stacked(at.central.predicted[0], reference, anomalies)
        taken, descent.step = descent.step, gauss_newton(descent.weights.w, self._evaluation(descent, linear))
        self.record(descent, descent.weights.T, 0.0 if descent.stop else 1.0)
        descent.ended = bool(descent.stop)
        if descent.ended:
            descent.converged = descent.newton.norm <= SHORT_STEP
            return
        assert taken is not None
        count = descent.iteration
        if is_done(self.scheme, count - 1, taken):
            descent.stop = counted(count, "assimilation")
        basis = self.space.basis  # of the weights of the mean, those that move no parameter are no part of J_b
        descent.weights = Weights(basis @ (basis.T @ taken.weights.w), taken.weights.dense)

    def _run_ensemble(self, descent: Descent) -> Runs | None:
        space, rows, w = self.space, self._rows(descent), descent.weights.w
        run, self.first = self.first, None
        if run is None or not np.array_equal(rows, descent.weights.rows):
            run = space.forecast(space.control(np.array([*rows, w])), self.grid if descent.stop else NO_TIMES)
        runs = self._arrive(descent, run)
        if descent.stop or runs is None or runs.active is None or runs.active.all():
            return None if descent.stop else runs
        # a failed member takes the prediction that the regression on the survivors gives it
        zeros = np.zeros(runs.predictions.shape[1])
        reference, anomalies = self._regressed(descent, Runs(runs.predictions, zeros, runs.active))
        regressed = reference + (rows - w) @ space.basis @ anomalies
        return Runs(np.where(runs.active[:, None], runs.predictions, regressed))

    def _arrive(self, descent: Descent, run: Forecast) -> Runs | None:
        """J at the new iterate; what its runs, members and centre, are to the scheme."""
        space, weights = self.space, descent.weights
        if any(run.failures[:-1]) or run.partial.any():
            x = space.control(np.array([*self._rows(descent), weights.w]))
            directions = len(run) <= len(space.members)  # one is lost: run all members
            run = space.whole(x) if directions else filled(run, x)
        members, central = run[:-1], run[-1:]
        background = float(diag.background_cost(weights.w))
        descent.at = at = Iterate(members, central, background, float(self.observations.cost(central.predicted)[0]))
        descent.cost = at.cost
        if self._informing(at) < space.needed_members or not math.isfinite(at.cost):
            return None
        return Runs(members.predicted.stacked, central.predicted.stacked[0], members.active, space.basis)

    def _informing(self, at: Iterate) -> int:
        """How many members inform the step: N where fewer runs stand for all."""
        n_members = len(self.space.members)
        return n_members if len(at.members) < n_members else int(at.members.active.sum())

    def _evaluation(self, descent: Descent, linear: Linearisation) -> Evaluation:
        descent.at = replace(descent.iterate, linear=linear)
        return Evaluation(*self.observations.whiten(linear), self.space.basis)

    def _rows(self, descent: Descent) -> Array:
        """The members (M, N) of an ensemble as a whole: those of the scheme, in the end those of the posterior."""
        over = descent.stop and not self.scheme.minimiser
        return descent.weights.rows if over else members_of(self.scheme, descent.weights)

    def _regressed(self, descent: Descent, runs: Runs) -> tuple[Array, Array]:
        return regression((self._rows(descent) - descent.weights.w) @ self.space.basis, runs)

    def _point(self, descent: Descent) -> Point:
        at, tangent = descent.iterate, None
        if (linear := at.linear) is not None and not self.space.minimiser.regresses:

            def precision_times(vectors: Array) -> Array:
                return self.observations.precision_times(linear.prediction, vectors)

            tangent = Tangent(linear.prediction.values, linear.anomalies, precision_times, self.space.basis)
        return Point(descent.weights.w, at.cost, descent.newton, tangent, self.space.derivatives is not None)

    def _require_step(self, descent: Descent) -> None:
        at = descent.iterate
        if descent.step is not None or (descent.stop and self._informing(at) >= self.space.needed_members):
            return
        stage = f"forecast of iteration {descent.iteration + 1}"
        self.space.require_members(at.members, stage)
        raise TooFewMembersError(f"{self.observations.name}: the centre cannot be run in the {stage}")
