"""A plain function ``f(parameters, times) -> values`` as a forward model.

The state of such a model is its parameters; the path is what the function returns, seen at the times it was asked for.
"""

import functools
import hashlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import CodeType
from typing import Any

import numpy as np

from en4dvar.model.forward import Failure, ForwardModel, Observable, Trajectory
from en4dvar.model.state import Array, Field, Parameter, StateLayout, floats
from en4dvar.plumbing.user_code import loss_of

Function = Callable[[dict[str, Any], Array], Any]


@dataclass(frozen=True)
class Returned:
    """H: what the function returned under a name."""

    name: str

    def __call__(self, trajectory: Trajectory) -> Array:
        return trajectory[self.name]


class FunctionModel(ForwardModel):
    """``function(parameters, times)`` gives one number a time: an array (K,), or a dict of one a name.

    Parameters
    ----------
    function: gets ``parameters``, a dict of name → float in the parameters' own units, and ``times`` (K,); it may raise
        or return nothing but NaN, which loses that member; where some are NaN (or masked), others tell them.
        It is called once a member and keeps nothing between calls.
    parameters: what the function reads.
    observables: name → unit of what it returns; the first is the default.
    dense: whether times beside the observations cost next to nothing, for smooth curves in plots. A function that is
        not dense is asked for the observation times alone.
    jacobian: ``jacobian(parameters, times)`` gives the derivatives of what the function returns, parameter → array
        (K,), or observable → parameter → array, as ``jax.jacfwd(function)`` does; a parameter that is not estimated
        may be left out.
    members: the function takes so many members in one call, each parameter (members, 1) and ``times`` (members, K), and
        returns arrays (members, K). The last call is filled up, so that shapes are always the same (nothing is compiled
        twice). An exception loses all of them; a member is lost by NaN.
    cheap: whether ten thousand calls take seconds, so that a doubt about a posterior is settled by sampling it.
    """

    def __init__(
        self,
        function: Function,
        parameters: Sequence[Parameter],
        observables: Mapping[str, str],
        time_unit: str = "1",
        dense: bool = False,
        jacobian: Function | None = None,
        members: int | None = None,
        cheap: bool = False,
    ):
        self.function, self.parameters, self.cheap = function, tuple(parameters), cheap or self.compiled
        self.jacobian, self.members, self.batch = jacobian, members, members or 1
        self.observables = tuple(Observable(name, unit, Returned(name), fewest=1) for name, unit in observables.items())
        self.time_unit = time_unit
        self.dense = dense
        self.layout = StateLayout((Field("theta", len(self.parameters)),))
        self._path = StateLayout(tuple(Field(observable.name, unit=observable.unit) for observable in self.observables))

    @property
    def differentiable(self) -> bool:
        """Whether it has a :attr:`jacobian`."""
        return self.jacobian is not None

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        """The parameters themselves, in the order of :attr:`parameters`."""
        return np.array([theta[p.name] for p in self.parameters])

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        if self.members is not None:
            firsts = range(0, len(x), self.members)
            return [path for i in firsts for path in self._run_many(x[i : i + self.members], own[i : i + self.members])]
        return [self._run(theta, np.array(at)) for theta, at in zip(x, own, strict=True)]

    def _run(self, theta: Array, times: Array) -> Trajectory | Failure:
        try:
            states = self._states(self.function(self._named(theta), times.copy()), times.shape)
        except BaseException as error:  # a function may fail in any way; the reason is kept
            return Failure(loss_of(error))
        return Trajectory(times, states, self._path)

    def _run_many(self, theta: Array, times: Array) -> list[Trajectory]:
        """Of up to :attr:`members`, in one call for as many."""
        every = np.minimum(np.arange(self.members or 1), len(theta) - 1)
        parameters = {p.name: theta[every, j, None] for j, p in enumerate(self.parameters)}
        states = self._states(self.function(parameters, times[every]), (len(every), times.shape[1]))
        return [Trajectory(np.array(at), path, self._path) for at, path in zip(times, states, strict=False)]

    def tangent(self, x: Array, directions: Array, times: Array) -> tuple[Trajectory, Array]:
        """By the :attr:`jacobian`. Raises ValueError where the function fails."""
        assert self.jacobian is not None
        paths = self.trajectories(x[None], times)
        if isinstance(paths[0], Failure):
            raise ValueError(paths[0].reason)
        returned = self.jacobian(self._named(x), times.copy())
        whole = returned if all(isinstance(part, Mapping) for part in returned.values()) else self._alone(returned)
        along = np.zeros((len(directions), len(times), len(self._path.names)))
        for parameter, changes in zip(self.parameters, directions.T, strict=True):
            if changes.any():
                of_all = {name: whole[name][parameter.name] for name in self._path.names}
                along += changes[:, None, None] * self._states(of_all, times.shape)
        return paths[0], along

    def _named(self, theta: Array) -> dict[str, float]:
        return {p.name: float(value) for p, value in zip(self.parameters, theta, strict=True)}

    def _states(self, returned: Any, shape: tuple[int, ...]) -> Array:
        """(…, K, observables) of what a function returned. Raises ValueError, in words for its author."""
        columns = returned if isinstance(returned, Mapping) else self._alone(returned)
        return np.stack([_values(columns, name, shape) for name in self._path.names], axis=-1)

    def _alone(self, values: Any) -> Mapping[str, Any]:
        """Values without a name are those of the only observable. Raises ValueError where there are more."""
        if len(self._path.names) > 1:
            words = " and ".join(self._path.names)
            raise ValueError(f"the function returned one array, but {words} were observed; return a dict of arrays")
        return {self._path.names[0]: values}


def _values(columns: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    """One observable of what a function returned. Raises ValueError, in words for its author."""
    if name not in columns:
        raise ValueError(f"the function returned {', '.join(map(str, columns)) or 'nothing'}, but no {name!r}")
    if np.iscomplexobj(columns[name]):
        raise ValueError(f"the function returned complex numbers for {name}; return real ones")
    values = floats(columns[name])
    if values.shape != shape:
        raise ValueError(f"the function returned shape {values.shape} for {name}, expected {shape}, one per time")
    return values


def name_of(function: object) -> str:
    """``module:name`` of a function, or of the class of an object that can be called."""
    while isinstance(function, functools.partial):
        function = function.func
    kind = function if hasattr(function, "__qualname__") else type(function)
    return f"{kind.__module__}:{kind.__qualname__}"


def digest_of(function: object) -> str:
    """SHA-256 of what a function says: its file or, of one that was typed in, its compiled code. Values that it reads
    from outside are not part of it.
    """
    while isinstance(function, functools.partial):
        function = function.func
    called: Any = function if hasattr(function, "__code__") else vars(type(function)).get("__call__", function)
    code = getattr(called, "__code__", None)
    try:
        text = inspect.getsource(inspect.unwrap(called))
    except (OSError, TypeError):
        text = repr(_content(code)) if isinstance(code, CodeType) else name_of(function)
    return hashlib.sha256(text.encode()).hexdigest()


def _content(code: CodeType) -> tuple[Any, ...]:
    constants = tuple(_content(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts)
    return code.co_code, constants, code.co_names
