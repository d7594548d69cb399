"""The forward model: a state-vector operator F, seen through an observation operator H.

A model author writes ``layout``, ``parameters``, ``initial_state`` and ``step``; everything else has a default.
A model that can integrate many members at once overrides ``trajectories``, the fast path, and may then do without
``step``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, Self, cast, overload, runtime_checkable

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array, Field, Parameter, Shown, StateLayout, floats
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.user_code import ReturnedError, loss_of


def instants_of(times: npt.ArrayLike, unit: str) -> Array:
    """Instants (K,) on a model's clock. Raises :class:`ConfigError` where they do not increase."""
    try:
        instants = floats(times)
    except (TypeError, ValueError):
        instants = np.empty(0)
    if instants.ndim != 1 or not (len(instants) and np.all(np.diff(instants) > 0) and np.all(np.isfinite(instants))):
        raise ConfigError(f"times: give a one-dimensional sequence of increasing numbers, in {unit}")
    return instants


def _require_path(times: Array, states: Array, layout: StateLayout) -> None:
    """ValueError unless ``states`` (…, K, n_state) are real numbers at ``times`` (K,) or (…, K)."""
    if np.iscomplexobj(states):
        raise ValueError("the states of a path are complex numbers; give real ones")
    if np.shape(states)[-1 - np.ndim(times) :] != (*np.shape(times), layout.size):
        shapes = f"shape {np.shape(states)} at times of shape {np.shape(times)}"
        raise ValueError(f"a path has states of {shapes}, where its layout has {layout.size} numbers at each time")


@dataclass(frozen=True)
class Trajectory:
    """One member's path: ``states`` (K, n_state) at ``times`` (K,) in seconds (or the model's own time unit)."""

    times: Array
    states: Array
    layout: StateLayout

    def __post_init__(self) -> None:
        _require_path(self.times, self.states, self.layout)

    def __getitem__(self, name: str) -> Array:
        """The field ``name`` along the path: (K,) or (K, size)."""
        return self.layout.part(self.states, name)

    def largest(self, name: str) -> float:
        """The largest value of a quantity of the model's ``validity`` along the path; by default |field of that name|.

        A model whose quantity peaks between the stored instants overrides this.
        """
        return float(np.max(np.abs(self[name])))

    def beyond(self, limit: "ValidityLimit") -> float:
        """When the path first exceeds a limit, +inf where it does not: the first stored instant that does.

        Where it does between them only, or the quantity is no field, the whole path counts. A model that knows better
        overrides this.
        """
        if not self.largest(limit.name) > limit.value:
            return math.inf
        if limit.name not in self.layout.names:
            return -math.inf
        over = np.abs(self[limit.name]).reshape(len(self.times), -1).max(axis=1) > limit.value
        return float(self.times[np.argmax(over)]) if over.any() else -math.inf


@dataclass(frozen=True)
class Failure:
    """A member that could not be integrated. A value, never an exception: it is carried through the iterations."""

    reason: str
    time: float = float("nan")


@dataclass(frozen=True)
class ValidityLimit:
    """A quantity that must stay below ``value`` along a path for the model's own assumptions to hold.

    The model computes on beyond it; a result says where its members went (see :mod:`en4dvar.diagnosis.honesty`).
    ``label`` is in words, e.g. "Mach number of the wall"; ``source`` says where the limit comes from.
    """

    name: str
    value: float
    unit: str = "1"
    label: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name)


@dataclass(frozen=True)
class Alternative:
    """The same experiment with one assumption changed: what a result would be then is told beside it.

    ``words`` complete "if …", e.g. "the pulse were 5 % stronger". ``model`` takes the place of the model, with the same
    observables and parameters, but for those that it has in addition, whose values are ``constants``; ``values`` and
    ``times`` multiply the observations and their errors; ``parameters`` are factors of a parameter's value where it is
    fixed, of the centre of its prior where it is estimated. One about the readings of an ``observable`` is told where
    all readings are of that. ``options`` are those of ``en4dvar run`` that make it the assumption of a run, "" where
    what is to be entered is for the user to say.
    """

    name: str
    words: str
    model: "ForwardModel | None" = None
    values: float = 1.0
    times: float = 1.0
    parameters: Mapping[str, float] = field(default_factory=dict)
    observable: str = ""
    constants: Mapping[str, float] = field(default_factory=dict)
    options: str = ""


@dataclass(frozen=True)
class PathQuantity(Shown):
    """A quantity that acts along a path, e.g. a strain rate: ``trajectory[name]`` (K,) in ``unit``; its size is of
    interest.
    """

    name: str
    unit: str
    label: str = ""
    symbol: str = ""
    display_unit: str = ""


@runtime_checkable
class ObservationOperator(Protocol):
    """H: maps a trajectory to predictions (Ny,), one per observation time.

    One with an attribute ``batched = True`` gives, by the same expression, (N, Ny) for a
    :class:`~en4dvar.model.forward.Batch`, whose fields have members as their first axis.
    """

    def __call__(self, trajectory: Trajectory) -> Array: ...


@runtime_checkable
class RateOperator(Protocol):
    """The time derivative of an observation operator's output (Ny,); needed where ``time_std`` is given."""

    def rate(self, trajectory: Trajectory) -> Array: ...


@dataclass(frozen=True)
class StateField:
    """H that reads one scalar field of the state, and its rate from another field where the model has it.

    >>> import numpy as np
    >>> from en4dvar.model.state import Field
    >>> layout = StateLayout((Field("x"), Field("v")))
    >>> path = Trajectory(np.array([0.0, 1.0]), np.array([[1.0, 2.0], [3.0, 4.0]]), layout)
    >>> StateField("x", rate_of="v")(path), StateField("x", rate_of="v").rate(path)
    (array([1., 3.]), array([2., 4.]))
    """

    name: str
    rate_of: str | None = None
    batched: ClassVar[bool] = True

    def __call__(self, trajectory: Trajectory) -> Array:
        return trajectory[self.name]

    def rate(self, trajectory: Trajectory) -> Array:
        """Time derivative of the observable (K,). Raises NotImplementedError where the model has none."""
        if self.rate_of is None:
            raise NotImplementedError(f"the model does not provide d({self.name})/dt")
        return trajectory[self.rate_of]


def gives_rate(operator: ObservationOperator) -> bool:
    """Whether an operator gives its rate; a :class:`StateField` does where ``rate_of`` names a field."""
    unnamed = isinstance(operator, StateField) and type(operator).rate is StateField.rate and operator.rate_of is None
    return isinstance(operator, RateOperator) and not unnamed


@dataclass(frozen=True)
class Observable(Shown):
    """A quantity that can be measured: its name in YAML and netCDF, its units, and the operator H that predicts it.

    ``positive``: it cannot be zero, so that numbers of 0 or below in a file say that there was nothing to read.
    ``fewest`` readings make a data set: 1 of a quantity of the whole path, 3 of one that is followed in time.
    ``event``: NaN is of a path on which what was read does not happen, so that the reading itself excludes it.
    """

    name: str
    unit: str
    operator: ObservationOperator
    symbol: str = ""
    display_unit: str = ""
    label: str = ""
    positive: bool = False
    fewest: int = 3
    event: bool = False


def read_along(read: Callable[[Any], Any], what: str, of_field: bool | None, path: "Trajectory | Batch") -> Array:
    """``what`` the user's ``read``, H or its rate, gives of a path: (…, K), or (…, K, size) where it is ``of_field``;
    None: either.

    Raises :class:`ReturnedError` where it gives something else; what ``read`` itself raises goes through.
    """
    asked, who = np.shape(path.times), f"{what} ({getattr(read, '__qualname__', f'{type(read).__name__}.__call__')}): "
    try:
        raw = read(path)
    except KeyError as error:
        if (name := str(error.args[0])) in path.layout.names:
            raise
        raise ReturnedError(f"{who}{name!r} is not in the layout{suggest(name, path.layout.names)}") from error
    with retold((TypeError, ValueError), ReturnedError, who):
        values = floats(raw)
    axes = (0, 1) if of_field is None else (int(of_field),)
    if values.shape[: len(asked)] != asked or values.ndim - len(asked) not in axes:
        came = "None" if raw is None else f"shape {values.shape}"
        cells = ", and each place of the field" if of_field else ""
        raise ReturnedError(f"{who}{came} instead of shape {asked}: one real number for each time{cells}")
    return values


@dataclass(frozen=True)
class Shared:
    """A batch that is ready to be integrated by any number of threads.

    Threads that call ``work``, which releases the interpreter, share the members among themselves; when all calls have
    returned, ``results`` gives the N trajectories or failures. Who did what makes no difference to them.
    """

    work: Callable[[], object]
    results: Callable[[], Sequence[Trajectory | Failure]]


class _SameAs:
    """Another attribute of a model; what a class or an instance sets instead goes before it."""

    def __init__(self, name: str):
        self.name = name

    def __get__(self, model: "ForwardModel | None", kind: "type[ForwardModel]") -> Any:
        return getattr(model or kind, self.name)


class ForwardModel(ABC):
    """F. Subclasses set ``parameters``, ``layout`` and ``observables`` (the first is the default).

    ``time_unit`` is the unit of all times, ``time_display_unit``, by default the same, that of plots. ``batch`` is the
    number of members the fast path likes to get at once (executors cut chunks at multiples of it); ``compiled`` says
    that ``trajectories`` releases the interpreter lock. Such models, unless they say otherwise, are ``threaded``
    (threads serve them), ``dense`` (a path may be asked for between the observations at next to no cost, for smooth
    curves in plots, not at the observations alone) and ``cheap`` (ten thousand runs take seconds, so that a doubt about
    a posterior is settled by sampling it). ``autonomous`` says that F depends on elapsed time alone: sequential schemes
    may start ``trajectories`` at any instant, where otherwise they repeat ``step``. ``validity`` names quantities and
    the limits beyond which the equations do not hold; :meth:`doubts` judges observations before a run. ``alternatives``
    are assumptions that could be otherwise, for :mod:`en4dvar.diagnosis.response.what_if`; ``path_quantities`` and
    ``path_parameters``, names of fields of the state that act along the path and not only at its start, are for
    :mod:`en4dvar.diagnosis.response.ledger`. ``optional_parameters`` are numbers that are known unless
    ``parameters:`` names them: :meth:`with_parameters` is the model in which they are parameters too; a setting in
    ``known_by`` says nothing but the numbers of these names, and is refused beside parameters for all of them.
    ``absent_parameters``: numbers that the model has with other settings only, each with these settings in words.

    ``defaults`` are values (SI) of parameters that ``parameters:`` need not name.

    ``unforeseen`` are quantities that may change on the way by what no model foresees, by the standard deviation of
    the change of their logarithm; what is expected of readings after the window allows for one such change of each. If
    one is no field of the state, :meth:`changed` says what its change is. ``interpolated`` are observables that are
    straight lines between outputs at times of the model's own.

    A model that has settings in YAML also has ``Settings`` (a pydantic model of its ``model:`` section) and
    ``from_settings``; without them the class is called without arguments. In a sequence, parameters that the state
    carries are fields with their names: RMSE and spread are over the others.
    """

    parameters: tuple[Parameter, ...]
    layout: StateLayout
    observables: tuple[Observable, ...]
    defaults: Mapping[str, float] = MappingProxyType({})
    time_unit: str = "s"
    time_display_unit: str = cast(Any, _SameAs("time_unit"))
    batch: int = 1
    compiled: bool = False
    threaded: bool = cast(Any, _SameAs("compiled"))
    dense: bool = cast(Any, _SameAs("compiled"))
    cheap: bool = cast(Any, _SameAs("compiled"))
    autonomous: ClassVar[bool] = False
    validity: tuple[ValidityLimit, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    path_quantities: tuple[PathQuantity, ...] = ()
    path_parameters: tuple[str, ...] = ()
    optional_parameters: tuple[Parameter, ...] = ()
    absent_parameters: Mapping[str, str] = MappingProxyType({})
    known_by: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})
    unforeseen: Mapping[str, float] = MappingProxyType({})
    interpolated: Collection[str] = ()
    _begins: float = 0.0  # on the clock of the paths, where ``trajectories`` begin
    _who: str = ""  # of whom messages about the paths speak, where not of ``trajectories``

    def changed(self, name: str, x: Array, change: Array) -> Array:
        """States (N, n_state) in which the quantity ``name`` is exp(``change``) (N,) times what it is in ``x``.

        By default every component of the field of that name.
        """
        x = np.array(x)
        x[:, self.layout[name]] *= np.exp(change)[:, None]
        return x

    def with_parameters(self, names: Collection[str]) -> "ForwardModel":
        """This model with those of its ``optional_parameters`` that are in ``names`` among its ``parameters``.

        Models that have such parameters override it.
        """
        return self

    def __new__(cls, *arguments: object, **named: object) -> Self:
        if cls.step is ForwardModel.step and cls.trajectories is ForwardModel.trajectories:
            raise TypeError(f"{cls.__name__} has neither step nor trajectories; write one of them")
        return super().__new__(cls)

    @property
    def resumable(self) -> bool:
        """True if a member can go on from its state at any instant."""
        kind = type(self)
        return kind.step is not ForwardModel.step or kind.resumed is not ForwardModel.resumed

    @abstractmethod
    def initial_state(self, theta: Mapping[str, float]) -> Array:
        """State vector (n_state,) at time zero for the physical parameters ``theta``, parameters appended."""

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """State vectors (N, n_state) of N members, parameters as name → (N,). This default repeats the above."""
        n_members = len(next(iter(theta.values())))
        each = ({k: float(v[i]) for k, v in theta.items()} for i in range(n_members))
        return np.stack([floats(self.initial_state(own), "initial_state") for own in each])

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """F_{t1←t0}: advance one state (n_state,); back from time zero where a time shift puts a reading before it. May
        raise; the caller turns it into a :class:`Failure`.

        A model that overrides :meth:`trajectories` needs no step, but what resumes a state at any instant does: schemes
        of a series and parameters that vary in time.
        """
        raise NotImplementedError(f"{type(self).__name__} has no step: it cannot be resumed from a state on its way")

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        """Integrate a batch of members from time zero.

        Parameters
        ----------
        x: initial states (N, n_state).
        times: increasing observation times (K,), or (N, K) where each member has its own; with a time shift the first
            may lie before time zero.

        Returns
        -------
        N items in the order of the members. This default repeats :meth:`step`.
        """
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return [self._march(x[i], own[i]) for i in range(len(x))]

    def resumed(self, x: Array, start: Array, times: Array) -> Sequence[Trajectory | Failure]:
        """:meth:`trajectories` from states ``x`` (N, n_state) at ``start`` (N,) instead of time zero.

        At those of the ``times`` (N, K) that lie before its start a member is where it started. This default repeats
        :meth:`step`.
        """
        return [self._march(x[i], np.maximum(times[i], start[i]), float(start[i])) for i in range(len(x))]

    @property
    def differentiable(self) -> bool:
        """True if it gives derivatives of its paths: it has a :meth:`tangent`."""
        return type(self).tangent is not ForwardModel.tangent

    def tangent(self, x: Array, directions: Array, times: Array) -> tuple[Trajectory, Array]:
        """The path of one member from its initial state ``x`` (n_state,), seen at ``times`` (K,), and the derivatives
        (D, K, n_state) of its states along ``directions`` (D, n_state) of the initial state, parameters among them, as
        large as the prior's standard deviations.

        Optional; may raise. Gauss–Newton then takes these derivatives instead of runs beside each iterate.
        """
        raise NotImplementedError

    def share(self, x: Array, times: Array) -> Shared | None:
        """:meth:`trajectories` of states (N, n_state) as work that threads share, where the model can; else None."""
        return None

    def doubts(
        self, observable: str, times: Array, values: Array, predicted: Array, members: Mapping[str, Array]
    ) -> Sequence[str | Caution]:
        """Why observations ``values`` (K,) at ``times`` (K,) cannot be what they say, in words, or as a warning where
        that is less than serious; by default nothing.

        ``predicted`` (N, K) is the same of the prior members that could be run, ``members`` are their parameters by
        name, (N,) each, physical and SI. Asked before a run and told with its
        warnings: the place for scales and units that only the model can judge.
        """
        return ()

    def _march(self, x: Array, times: Array, start: float = 0.0) -> Trajectory | Failure:
        states = np.empty((len(times), self.layout.size))
        x, t = np.array(x, dtype=float), start  # a step may work in place; the ensemble stays as it is
        for k, t_next in enumerate(times):
            if t_next != t:
                try:
                    x = floats(self.step(x, t, float(t_next)), "step")
                except BaseException as error:  # a model may fail in any way; the reason is kept
                    return Failure(loss_of(error), t)
                t = float(t_next)
            if x.shape != (self.layout.size,):
                return Failure(f"step returned shape {x.shape}, expected ({self.layout.size},)", t)
            if not np.isfinite(x).all():
                return Failure("non-finite state", t)
            states[k] = x
        return Trajectory(np.asarray(times, dtype=float), states, self.layout)


def initial_states(model: ForwardModel, theta: Mapping[str, Array], n_members: int) -> Array:
    """Initial states (N, n_state) of ``n_members`` members with parameters name → (N,), which may be none."""
    return model.initial_states(theta) if theta else np.array([model.initial_state({})] * n_members)


def field_of(model: ForwardModel, observable: Observable) -> Field | None:
    """The field of the state that an observable reads, where it reads one as it is."""
    if not isinstance(observable.operator, StateField):
        return None
    return next((block for block in model.layout if block.name == observable.operator.name), None)


class Batch(Sequence[Trajectory | Failure]):
    """N trajectories or failures: ``states`` (N, K, n_state) at ``times`` (N, K).

    ``batch[i]`` is member i, ``batch["x"]`` a field along all paths, (N, K) or (N, K, size).
    A member is a :class:`Failure` from the first instant on at which its state is not finite. Where members are many
    and steps are short, as in sequential assimilation, a batch spares the making of N objects.
    """

    def __init__(self, times: Array, states: Array, layout: StateLayout):
        _require_path(times, states, layout)
        self.times = times if np.ndim(times) > 1 else np.broadcast_to(times, np.shape(states)[:2])
        self.states, self.layout = states, layout
        self.whole = bool(np.isfinite(states).all())  # no member failed

    def __len__(self) -> int:
        return len(self.states)

    @overload
    def __getitem__(self, index: int) -> Trajectory | Failure: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory | Failure]: ...
    @overload
    def __getitem__(self, index: str) -> Array: ...
    def __getitem__(self, index: int | slice | str) -> Trajectory | Failure | list[Trajectory | Failure] | Array:
        if isinstance(index, str):
            return self.layout.part(self.states, index)
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        times, states = self.times[index], self.states[index]
        if not self.whole and not (finite := np.isfinite(states).all(axis=-1)).all():
            return Failure("non-finite state", float(times[np.argmin(finite)]))
        return Trajectory(times, states, self.layout)

    @property
    def last(self) -> Array:
        """States (N, n_state) at the last instant."""
        return self.states[:, -1]

    def largest(self, name: str) -> Array:
        """(N,) how far a quantity of ``validity`` went: :meth:`~en4dvar.model.forward.Trajectory.largest`."""
        return np.array([path.largest(name) if isinstance(path, Trajectory) else np.nan for path in self])

    def beyond(self, limit: ValidityLimit) -> Array:
        """(N,) when the paths first exceed a limit, see :meth:`~en4dvar.model.forward.Trajectory.beyond`."""
        return np.array([path.beyond(limit) if isinstance(path, Trajectory) else np.nan for path in self])
