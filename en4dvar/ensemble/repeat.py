"""A check that a model gives the same numbers again: two members of an ensemble are run a second time, in another
order.

Noise in a model is not part of the observation errors: differences of members that are close measure it instead of the
slope, and the posterior is far too sure of itself. A state that a model keeps between members makes its numbers depend
on their order, and so on the number of workers.
"""

from collections.abc import Callable, Sequence

import numpy as np

from en4dvar.ensemble.forecast import Forecast
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem

ROUNDING = 1e-9  # of the largest value: what members of a batch may owe to those beside them
NOT_THE_MODEL = ("TimeLimitError: ", "MemoryError: ", "a worker process died")  # reasons that depend on the machine


def check_repeats(
    model: ForwardModel,
    first: Array,
    failures: Sequence[str],
    run_again: Callable[[list[int]], tuple[Array, Sequence[str]]],
    name: str = "",
) -> None:
    """Run the last and the first of the members that are alive again, in this order, and compare.

    ``first``: (N, ...) what the members gave, ``failures`` (N,) reasons, "" for those alive. ``run_again``: members →
    the same of these.

    Raises ConfigError: they differ: at all where the model runs members one by one, by more than rounding where it runs
    batches. Of these it says whether one alone gives the same twice: then the model mixes members.
    """
    alive = [i for i, reason in enumerate(failures) if not reason]
    again = list(dict.fromkeys((alive[-1], alive[0]))) if alive else []
    if not again:
        return
    second, reasons = run_again(again)
    for i, values, reason in zip(again, second, reasons, strict=True):
        if reason.startswith(NOT_THE_MODEL) or (not reason and np.array_equal(values, first[i], equal_nan=True)):
            continue
        if reason:
            difference = f"fails the second time: {reason}"
        else:
            largest = float(np.max(np.abs(first[i]), initial=0.0))
            apart = float(np.max(np.abs(values - first[i]), initial=0.0))
            if apart <= (ROUNDING * largest if _in_batches(model) else 0.0):
                continue
            difference = f"differs by up to {apart / largest if largest else apart:.2g} of its largest value"
        where = f"{name}: " if name else ""
        beside = not reason and _in_batches(model)
        if beside and np.array_equal(run_again([i])[0], run_again([i])[0], equal_nan=True):
            raise ConfigError(
                f"{where}the model mixes the members of a batch: beside other members, member {i + 1} {difference}, "
                "and alone it gives the same again. Write each row of what trajectories and initial_states return from "
                "the same row of what they get, or accept it with assimilation: {stochastic_model: true}"
            )
        raise ConfigError(
            f"{where}the model gives other numbers when a member is run again (member {i + 1} {difference}); noise or "
            "a state that it keeps makes posteriors wrong and results different each time. Seed it in each member and "
            "keep nothing between members, or accept it with assimilation: {stochastic_model: true}"
        )


def check_forecast_repeats(problem: InverseProblem, run: Forecast, again: Callable[[list[int]], Forecast]) -> None:
    """The same of the forecast of an ensemble, in which the readings that members lack are filled in: these are not
    compared. ``again``: members → their forecast, at the same instants.
    """

    def repeated(members: list[int]) -> tuple[Array, tuple[str, ...]]:
        second = again(members)
        lacks = second.partial[:, None] & np.isnan(second.predictions)
        return np.where(lacks, run.predictions[members], second.predictions), second.lost

    check_repeats(problem.model, run.predictions, run.failures, repeated, problem.observations.name)


def _in_batches(model: ForwardModel) -> bool:
    """True if the model has its own way with many members, where rounding may depend on those beside a member."""
    kind = type(model)
    own = (kind.trajectories, kind.initial_states)
    return own != (ForwardModel.trajectories, ForwardModel.initial_states)
