"""Forecasts about a centre by the derivatives that a model gives of its path: F linearised, all else as it is.

Initial states, H, clocks and what else lies between a control vector and a prediction cost nothing; their derivatives
are differences over so small a part of the members' distance from the centre that these are exact to some 1e-6. The
model is asked once for its path and its derivatives, whatever the number of members.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from en4dvar.ensemble.forecast import Composite, Forecast
from en4dvar.executor import Outcome, SerialExecutor
from en4dvar.model.forward import Failure, ForwardModel, Trajectory
from en4dvar.model.state import TIME_SCALE, TIME_SHIFT, Array, floats
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.user_code import reason_of
from en4dvar.problem import InverseProblem

CLOSE = 1e-3  # of the members' distance from the centre, where all but F is differenced
STEPS = (1e-3, 1e-5, 1e-7, 3e-2)  # prior standard deviations between runs that derivatives are compared with
APART = 0.02  # of a derivative, by which it may differ from that of runs; NOTHING of the largest one
NOTHING = 1e-6
KEY = "assimilation.linearisation"


class _LinearPaths(SerialExecutor):
    """Paths of members by the tangent at the last of them, ``size`` prior standard deviations away."""

    size = 1.0

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        try:
            path, changes = model.tangent(x[-1], (x[:-1] - x[-1]) / self.size, np.array(times[-1]))
            states = path.states + self.size * floats(changes)
            return [*(Trajectory(path.times, own, path.layout) for own in states), path]
        except BaseException as error:  # a model may fail in any way; the reason is kept
            return [Failure(reason_of(error))] * len(x)


class Derivatives:
    """The predictions of members about a centre, linearised there by the model's own derivatives."""

    def __init__(self, problem: InverseProblem):
        self._paths, self._std = _LinearPaths(), problem.prior.std
        self._composite = Composite(problem, self._paths)

    def __call__(self, x: Array) -> Forecast:
        """Of control vectors (M + 1, n), their centre the last."""
        self._paths.size = CLOSE * float(np.max(np.abs(x - x[-1]) / self._std))
        run = self._composite(x[-1] + CLOSE * (x - x[-1]))
        stacked = run.predicted.stacked
        linear = np.vstack([stacked[-1] + (stacked[:-1] - stacked[-1]) / CLOSE, stacked[-1:]])
        return replace(run, predicted=run.predicted.unstacked(linear))


def derivatives_of(problem: InverseProblem, linearisation: str) -> Derivatives | None:
    """Those that a scheme linearises by, ``auto`` where the model gives them.

    Raises :class:`ConfigError`: they are asked for (``tangent``), and there are none.
    """
    if linearisation not in ("auto", "tangent"):
        return None
    shifted = next((p.name for p in (TIME_SHIFT, TIME_SCALE) if p.name in problem.prior.names), "")
    if problem.model.differentiable and not shifted:
        return Derivatives(problem)
    if linearisation == "auto":
        return None
    why = (
        f"{shifted} is estimated, which moves the readings along the path"
        if shifted
        else "the model gives no derivatives"
    )
    raise ConfigError(f"no tangent: {why}; leave this key out", KEY)


def check_derivatives(
    problem: InverseProblem, derivatives: Derivatives, at: Array, run: Callable[[Array], Forecast]
) -> None:
    """Compare the derivatives at a control vector (n,) with those of runs beside it, parameter by parameter.

    Raises :class:`ConfigError`: some differ from runs at each of several distances.
    """
    prior, std = problem.prior, problem.observations.std
    names = [j for j, name in enumerate(prior.names) if name not in problem.of_errors]
    steps = np.diag(prior.std)[names]
    told = derivatives(np.vstack([at + steps, at]))
    if told.failures[-1] and not told.partial[-1]:
        raise ConfigError(f"the model's derivatives fail where it runs: {told.failures[-1]}", KEY)
    centre, slopes = told.predictions[-1], told.predictions[:-1] - told.predictions[-1]
    doubtful, by_runs, there = np.arange(len(names)), np.zeros_like(slopes), np.isfinite(centre)
    for size in STEPS:
        by_runs[doubtful] = (run(at + size * steps[doubtful]).predictions - centre) / size
        apart, whole = (np.linalg.norm((a / std)[:, there], axis=1) for a in (by_runs - slopes, by_runs))
        wrong = apart > APART * whole + NOTHING * np.nanmax(whole, initial=0.0)
        doubtful = np.flatnonzero(wrong)
        if not len(doubtful):
            return
    j = doubtful[0]
    k = int(np.nanargmax(np.abs(by_runs[j] - slopes[j]) / std))
    raise ConfigError(
        f"the model's derivatives by {', '.join(prior.names[names[i]] for i in doubtful)} are not those of its runs: "
        f"a standard deviation of the prior of {prior.names[names[j]]} would move the prediction of reading {k + 1} by "
        f"{slopes[j, k]:.4g}, by runs close to it {by_runs[j, k]:.4g}; mend the model, or take runs: linearisation: "
        "bundle",
        KEY,
    )
