"""The bubble as a forward model: state vector {R, Ṙ, p_b, S, T, C, …, parameters}, observed through its radius."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import ClassVar, Literal

import numpy as np

from en4dvar.forward import Failure, ForwardModel, Observable, Shared, StateField, Trajectory, ValidityLimit
from en4dvar.state import Array, Field, Parameter, StateLayout
from en4dvar_bubble.driving import Driving, Reading, histotripsy, silence
from en4dvar_bubble.laws import ConstitutiveLaw, QuadraticKelvinVoigt
from en4dvar_bubble.laws.parameters import R0, R_EQ, R_MAX
from en4dvar_bubble.medium import WATER_25C, Medium, saturated_vapour_pressure
from en4dvar_bubble.packing import constants, hottest_wall, law_tables, mass_fraction, pack
from en4dvar_bubble.paths import Paths
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.solver.driver import Accuracy, Queue, Radial, Solution, System, preset, ready

Gas = Literal["heat", "polytropic", "isothermal", "adiabatic"]
Start = Literal["acoustic", "laser"]
Vapour = Literal["none", "frozen", "transport"]
Heat = Literal["cold", "conducting"]

FIRST_ORDER = "an expansion to first order in the Mach number: Prosperetti & Lezzi (1986), J. Fluid Mech. 168, 457"
MACH_LIMITS: Mapping[Radial, tuple[float, str]] = {
    "rayleigh-plesset": (0.3, "an incompressible liquid; 0.3 is the usual limit"),
    "keller-miksis": (1.0, FIRST_ORDER),
    "keller-miksis-enthalpy": (1.0, FIRST_ORDER),
    "gilmore": (2.2, "the usual limit of the Kirkwood-Bethe hypothesis: Hickling & Plesset (1964), Phys. Fluids 7, 7"),
}


@dataclass(frozen=True, eq=False)
class BubbleModel(ForwardModel):
    """One spherical gas bubble in a viscoelastic medium.

    ``start="acoustic"``: at rest at R0 until the driving (by default the histotripsy pulse) arrives; parameters of the
    law and ``R0``.
    ``start="laser"``: released from ``R_max`` at the ambient temperature with the amount of gas that is in
    equilibrium at ``R_eq``, the stress-free radius: p_g(R_max) = p_g(R_eq) (R_eq/R_max)³, whatever the gas does
    afterwards. Before time zero the released bubble is taken to be symmetric in time, R(−t) = R(t). Memory variables
    start relaxed.

    ``gas``: the energy equation (``heat``) or a polytropic law with exponent κ (``polytropic``, ``adiabatic``) or 1
    (``isothermal``). ``vapour="frozen"``: the saturated vapour of time zero stays in the bubble as if it were gas. With
    ``heat``: ``vapour="transport"`` keeps it in equilibrium at the wall and lets it diffuse in the gas,
    ``medium_heat="conducting"`` solves the temperature of the medium. Equations: ``solver.equations``,
    ``solver.general``.

    Raises
    ------
    ValueError: options that exclude each other.
    """

    law: ConstitutiveLaw = field(default_factory=QuadraticKelvinVoigt)
    gas: Gas = "heat"
    start: Start = "acoustic"
    driving: Driving = None  # type: ignore[assignment]  # chosen by the start
    reading: Reading = "instantaneous"
    medium: Medium = WATER_25C
    accuracy: Accuracy = None  # type: ignore[assignment]  # ``standard`` for the start
    radial: Radial = "keller-miksis"
    vapour: Vapour = "none"
    medium_heat: Heat = "cold"

    Settings: ClassVar[type[BubbleSettings]] = BubbleSettings
    time_display_unit: ClassVar[str] = "us"
    batch: ClassVar[int] = 8
    compiled: ClassVar[bool] = True
    observables = (
        Observable(
            "radius", "m", StateField("R", rate_of="Rdot"), symbol="R", display_unit="um", label="bubble radius"
        ),
    )

    def __post_init__(self) -> None:
        if self.driving is None:
            object.__setattr__(self, "driving", histotripsy() if self.start == "acoustic" else silence())
        if self.accuracy is None:
            object.__setattr__(self, "accuracy", preset("standard", self.start))
        if self.gas != "heat" and (self.vapour == "transport" or self.medium_heat != "cold"):
            raise ValueError("vapour transport and a conducting medium need gas: heat")
        if self.vapour != "none" and self.medium.p_v:
            raise ValueError(f"vapour: {self.vapour} and a constant vapour_pressure exclude each other")
        if self.vapour == "transport" and self.start == "acoustic" and self.medium.D_p == 0:
            raise ValueError(
                "a driven bubble grows until it is nearly all vapour, for which a diffusivity that does not depend on "
                "the pressure has no solution that a grid can hold: vapour: transport with start: acoustic needs D_p, "
                "e.g. constants: {D_p: 1, D_T: 1.75} (kinetic theory)"
            )

    @classmethod
    def from_settings(cls, settings: BubbleSettings) -> BubbleModel:
        """The model of a ``model:`` section."""
        return cls(
            law=settings.constitutive_law,
            gas=settings.gas,
            start=settings.start,
            driving=settings.driving.build(),
            reading=settings.driving_read,
            medium=settings.medium,
            accuracy=settings.solver_accuracy,
            radial=settings.radial,
            vapour=settings.vapour,
            medium_heat=settings.medium_heat,
        )

    @cached_property
    def system(self) -> System:
        """The unknowns and equations of the compiled solver."""
        heat = self.gas == "heat"
        return System(
            gas=self.accuracy.nodes if heat else 0,
            vapour=self.accuracy.nodes if self.vapour == "transport" else 0,
            medium=self.accuracy.medium_nodes if self.medium_heat == "conducting" else 0,
            memory=len(self.law.relaxed(np.ones(1), self.law.example_values())[0]),
            radial=self.radial,
            shear=self.law.shear_dependent,
        )

    @cached_property
    def constants(self) -> Array:
        """What all members have in common among the parameters of the compiled solver, (rows,)."""
        return constants(self)

    @property
    def validity(self) -> tuple[ValidityLimit, ...]:  # type: ignore[override]
        """The largest Mach number of the wall that the radial equation can bear, and where that is said."""
        value, source = MACH_LIMITS[self.radial]
        return (ValidityLimit("wall_mach", value, label="Mach number of the bubble wall", source=source),)

    @property
    def exponent(self) -> float:
        """Polytropic exponent (used without the energy equation)."""
        return 1.0 if self.gas == "isothermal" else self.medium.kappa

    @property
    def stress_free_radius(self) -> str:
        """Name of the parameter that is the stress-free radius."""
        return "R0" if self.start == "acoustic" else "R_eq"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        """Those of the law, then R0, or R_eq and R_max for the laser start."""
        return (*self.law.parameters, *((R0,) if self.start == "acoustic" else (R_EQ, R_MAX)))

    @cached_property
    def layout(self) -> StateLayout:  # type: ignore[override]
        """R, Rdot, p_b, S (stress integral); T of the gas (wall last where the medium conducts), C (mass fraction of
        vapour), T_m of the medium, Z (memory variables) where the model has them; the parameters.
        """
        system = self.system
        positive = (0.0, np.inf)
        state = [
            Field("R", unit="m", bounds=positive),
            Field("Rdot", unit="m/s"),
            Field("p_b", unit="Pa", bounds=(self.medium.p_v, np.inf)),
            Field("S", unit="Pa"),
        ]
        blocks = (
            Field("T", system.gas + system.wall, "K", positive),
            Field("C", system.vapour, "1", (0.0, 1.0)),
            Field("T_m", system.medium, "K", positive),
            Field("Z", system.memory, "Pa"),
        )
        state += [block for block in blocks if block.size]
        return StateLayout((*state, *(Field(p.name, unit=p.unit) for p in self.parameters)))

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({p.name: np.array([theta[p.name]]) for p in self.parameters})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """States (N, n_state) at time zero for parameters name → (N,), SI.

        Raises
        ------
        ValueError: a parameter outside its bounds, or a radius whose equilibrium gas pressure is not positive.
        """
        for p in self.parameters:
            value = np.asarray(theta[p.name], dtype=float)
            if not np.all((value >= p.bounds[0]) & (value <= p.bounds[1]) & np.isfinite(value)):
                raise ValueError(f"{p.name} must lie in {p.bounds} {p.unit}")
        rest = np.asarray(theta[self.stress_free_radius], dtype=float)
        R = rest if self.start == "acoustic" else np.asarray(theta["R_max"], dtype=float)
        if np.any(rest <= 0) or np.any(R <= 0):
            raise ValueError("radii must be positive")
        medium, layout, system = self.medium, self.layout, self.system
        p_v = medium.p_v if self.vapour == "none" else saturated_vapour_pressure(medium.T_inf)
        gas = (medium.p_inf + 2 * medium.S / rest - p_v) * (rest / R) ** 3
        if np.any(gas <= 0):
            raise ValueError("the vapour pressure exceeds the equilibrium pressure: no gas would be in the bubble")
        x = np.empty((len(rest), layout.size))
        values = {p.name: np.asarray(theta[p.name], dtype=float) for p in self.parameters}
        fields = {"R": R, "Rdot": 0.0, "p_b": gas + p_v, "T": medium.T_inf, "T_m": medium.T_inf, **values}
        law_values = {p.name: values[p.name] for p in self.law.parameters}
        relaxed = self.law.relaxed(R / rest, law_values)
        fields["Z"] = relaxed
        fields["S"] = relaxed.sum(axis=1)
        if self.start == "laser":  # at rest there is no elastic stress
            fields["S"] = fields["S"] + self.law.elastic_stress((R / rest)[:, None], law_values)[:, 0]
        if system.vapour:
            fields["C"] = mass_fraction(p_v / (gas + p_v), medium)[:, None]
        for name, where in layout.slices.items():
            value = np.asarray(fields[name])
            x[:, where] = value[:, None] if value.ndim == 1 else value
        return x

    def law_values(self, x: Array) -> dict[str, Array]:
        """The law's parameters, name → (N,), of states (N, n_state)."""
        return {p.name: x[:, self.layout[p.name].start] for p in self.law.parameters}

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Restart from any state: F_{t1←t0}. Raises RuntimeError with the solver's reason where it fails."""
        path = self.integrate(x[None, :], np.array([[t1]]), t0)
        if path.solution.status[0]:
            raise RuntimeError(path.solution.reason(0))
        return np.asarray(path.states[0, 0])

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        shared = self.share(x, times)
        shared.work()
        return shared.results()

    def share(self, x: Array, times: Array) -> Shared:
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return Shared(*self.prepared(np.asarray(x, dtype=float), times))

    def integrate(self, x: Array, times: Array, t0: float = 0.0) -> Paths:
        """All members from their states ``x`` (N, n_state) at ``t0`` (s) to ``times`` (N, K) (s, increasing)."""
        work, finish = self.prepared(x, times, t0)
        work()
        return finish()

    def prepared(self, x: Array, times: Array, t0: float = 0.0) -> tuple[Callable[[], object], Callable[[], Paths]]:
        """:meth:`integrate` of states (N, n_state) in two: the work, without the interpreter, which threads can share,
        and its result.
        """
        initial, par = pack(self, x)
        queue = Queue.longest_first(par)
        tables, complete = law_tables(self, self.law_values(x), queue)
        start = np.full(len(x), t0 * 1e6)
        micro = times * 1e6
        mirror = self.start == "laser" and t0 == 0.0 and bool(np.any(times < 0))
        order = np.argsort(np.abs(micro), axis=1, kind="stable") if mirror else None
        if order is not None:
            micro = np.take_along_axis(np.abs(micro), order, axis=1)
        options = (self.driving, self.reading, self.accuracy, hottest_wall(self))
        kernel, solved = ready(self.system, initial, par, tables, start, micro, queue, *options)
        once = Lock()

        def work() -> None:
            if once.acquire(blocking=False):
                complete()
            kernel()

        def finish() -> Paths:
            solution = solved
            if order is not None:
                back = np.argsort(order, axis=1)
                states = np.take_along_axis(solution.states, back[:, :, None], axis=1)
                states[:, :, -2] *= np.where(times < 0, -1.0, 1.0)
                solution = Solution(states, solution.status, solution.record)
            return Paths(self, x, times, solution, par)

        return work, finish
