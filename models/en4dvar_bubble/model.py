"""The bubble as a forward model: state vector {R, Ṙ, p_b, S, T, C, …, parameters}, observed through its radius."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from threading import Lock
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from en4dvar.model.forward import (
    Alternative,
    Failure,
    ForwardModel,
    Observable,
    PathQuantity,
    Shared,
    StateField,
    Trajectory,
    ValidityLimit,
)
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution
from en4dvar_bubble.alternatives import alternatives
from en4dvar_bubble.collapse import doubts
from en4dvar_bubble.dynamics import MACH_LIMITS, Dynamics, Wall
from en4dvar_bubble.emission import OBSERVABLE
from en4dvar_bubble.events import OBSERVABLES
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.laws.tabulate import GRID, ends
from en4dvar_bubble.numbers import NAMES
from en4dvar_bubble.packing import pack, with_gas
from en4dvar_bubble.paths import Paths
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.solver.arrays import Members
from en4dvar_bubble.solver.driver import Solution
from en4dvar_bubble.solver.integrate import NON_FINITE

_LIKE_KEYS = "gas", "start", "radial", "vapour", "medium_heat", "hydrophone", "gas_change", "viscosity_change"


@dataclass(frozen=True, eq=False)
class BubbleModel(Dynamics, ForwardModel):  # type: ignore[override]
    """A spherical gas bubble in a viscoelastic medium.

    What it assumes and its options: :class:`Dynamics`.
    """

    Settings: ClassVar[type[BubbleSettings]] = BubbleSettings
    time_display_unit = "us"
    batch = 8
    compiled = True
    observables = (
        Observable(
            "radius",
            "m",
            StateField("R", rate_of="Rdot"),
            symbol="R",
            display_unit="um",
            label="bubble radius",
            positive=True,
        ),
        *OBSERVABLES,
        OBSERVABLE,
    )

    known_by = MappingProxyType({"medium": ("rho", "c")})
    path_quantities = (
        PathQuantity("strain_rate", "s^-1", "hoop strain rate at the wall, |Ṙ|/R", r"$|\dot{R}|/R$"),
        PathQuantity("stretch", "1", "hoop stretch at the wall, R over the stress-free radius", r"$R/R_0$"),
    )

    @classmethod
    def from_settings(cls, settings: BubbleSettings) -> "BubbleModel":
        """The model of a ``model:`` section."""
        return cls(
            law=get_law(settings.law),
            driving=settings.driving.build(),
            reading=settings.driving_read,
            medium=settings.liquid,
            accuracy=settings.solver_accuracy,
            wall=None if settings.wall is None else Wall(settings.wall.distance, settings.wall.kind),
            **{name: getattr(settings, name) for name in _LIKE_KEYS},
        )

    def with_parameters(self, names: Collection[str]) -> "BubbleModel":
        """See :mod:`en4dvar_bubble.numbers`."""
        asked = NAMES.intersection(names)  # seldom any, and to know which of them the equations contain takes longer
        named = tuple(p.name for p in self.optional_parameters if p.name in asked) if asked else ()
        return self if named == self.named else replace(self, named=named)

    @property
    def validity(self) -> tuple[ValidityLimit, ...]:  # type: ignore[override]
        """The largest Mach number of the wall that the radial equation can bear, and where that is said."""
        value, source = MACH_LIMITS[self.radial]
        return (ValidityLimit("wall_mach", value, label="Mach number of the bubble wall", source=source),)

    @property
    def path_parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those of the law."""
        return tuple(p.name for p in self.law.parameters)

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """See :mod:`en4dvar_bubble.alternatives`."""
        return alternatives(self)

    @property
    def unforeseen(self) -> Mapping[str, float]:  # type: ignore[override]
        """The amount of gas, vapour apart: a bubble breaks up, gas dissolves, or is set free. The viscosity: what takes
        the energy of the first collapses beside it is booked as viscosity, and acts no more.
        """
        return {name: std for name, std in (("gas", self.gas_change), ("viscosity", self.viscosity_change)) if std}

    def changed(self, name: str, x: Array, change: Array) -> Array:
        """See :meth:`ForwardModel.changed`; ``gas`` changes at the temperature and the vapour pressure that it has,
        ``viscosity`` is every viscosity of the law, and consistency index (Pa s^n).
        """
        if name == "viscosity":
            for p in self.law.parameters:
                x = super().changed(p.name, x, change) if p.unit.startswith("Pa s") else x
            return x
        return with_gas(self, x, np.exp(change)) if name == "gas" else super().changed(name, x, change)

    def doubts(
        self, observable: str, times: Array, values: Array, predicted: Array, members: Mapping[str, Array]
    ) -> Sequence[Caution]:
        """Whether the collapse time can be right, see :mod:`en4dvar_bubble.collapse`."""
        return doubts(times, values, predicted, members, self.medium) if observable == "radius" else ()

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({p.name: np.array([theta[p.name]]) for p in self.parameters})[0])

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Restart from any state: F_{t1←t0}. Raises RuntimeError with the solver's reason where it fails."""
        path = self.integrate(x[None, :], np.array([[t1]]), t0)
        if path.solution.status[0]:
            raise RuntimeError(path.solution.reason(0))
        return np.asarray(path.states[0, 0])

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        return self.integrate(np.asarray(x, dtype=float), np.broadcast_to(times, (len(x), np.shape(times)[-1])))

    def share(self, x: Array, times: Array) -> Shared:
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return Shared(*self.prepared(np.asarray(x, dtype=float), times))

    def integrate(self, x: Array, times: Array, t0: Array | float = 0.0) -> Paths:
        """All members from states ``x`` (N, n_state) at ``t0`` (s, one or (N,)) to ``times`` (N, K) (s, increasing)."""
        work, finish = self.prepared(x, times, t0)
        work()
        return finish()

    def resumed(self, x: Array, start: Array, times: Array) -> Sequence[Trajectory | Failure]:
        return self.integrate(np.asarray(x, dtype=float), times, start)

    def prepared(
        self, x: Array, times: Array, t0: Array | float = 0.0, halved: bool = False
    ) -> tuple[Callable[[], object], Callable[[], Paths]]:
        """:meth:`integrate` of states (N, n_state) in two: the work, without the interpreter, which threads can share,
        and its result. Members that come to where a table ends are run again with ``halved`` cells, which end where
        the law does.
        """
        micro = times * 1e6
        mirror = self.start == "laser" and not np.any(t0) and bool(np.any(times < 0))
        order = np.argsort(np.abs(micro), axis=1, kind="stable") if mirror else None
        if order is not None:
            micro = np.take_along_axis(np.abs(micro), order, axis=1)
        packed = pack(self, x, t0 * 1e6, micro, halved)
        kernel, solved = self.solver.prepared(packed.members, packed.memory, packed.viscous, packed.pulse)
        once = Lock()

        def work() -> None:
            if once.acquire(blocking=False):
                packed.complete()
            kernel()

        def finish() -> Paths:
            solution = solved
            if order is not None:
                back = np.argsort(order, axis=1)
                states = solution.states[np.arange(len(x))[:, None], back]
                states[:, :, -2] *= np.where(times < 0, -1.0, 1.0)
                solution = Solution(states, solution.status, solution.record)
            return self._followed(Paths(self, x, times, solution, packed.members.parameters, t0), packed.members)

        return work, finish

    def _followed(self, paths: Paths, members: Members) -> Paths:
        """The same, with members run again that left their tables where the law still may have values."""
        solution, tables = paths.solution, members.tables
        lost = np.flatnonzero(solution.status == NON_FINITE)
        unknown = np.isnan((tables if len(tables) else members.samples)[lost])
        lost = lost[unknown.any(axis=tuple(range(1, unknown.ndim)))]
        if tables.shape[1] > GRID.cells:
            solution.ends.update(zip(lost, ends(tables[lost]), strict=True))
        elif len(lost):
            start = np.broadcast_to(paths.start, len(paths))[lost]
            work, finish = self.prepared(paths.initial[lost], paths.times[lost], start, halved=True)
            work()
            again = finish().solution
            solution.states[lost], solution.status[lost] = again.states, again.status
            solution.record[lost] = again.record
            solution.ends.update({lost[i]: words for i, words in again.ends.items()})
        return paths
