"""The physics of a bubble: what is assumed, which quantities its state has, and the state it starts from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from scipy.special import digamma

from en4dvar.model.state import Array, Field, Parameter, StateLayout
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown, suggest
from en4dvar_bubble.collapse import RAYLEIGH
from en4dvar_bubble.driving import Driving, Reading, histotripsy, silence
from en4dvar_bubble.laws import ConstitutiveLaw, QuadraticKelvinVoigt
from en4dvar_bubble.laws.exactness import refuse_unfit
from en4dvar_bubble.laws.loading import require_parameters
from en4dvar_bubble.laws.parameters import MANCIA, positive
from en4dvar_bubble.medium import CRITICAL_TEMPERATURE, WATER_25C, Medium, saturated_vapour_pressure
from en4dvar_bubble.numbers import ACCOMMODATION, ALL, GAS_CONTENT, OF_MEDIUM, P_A, R_START, RDOT_START, WALL_DISTANCE
from en4dvar_bubble.solver.driver import GAS_CLUSTERING, MEDIUM_LENGTHS, Accuracy, Radial, Solver, System, preset

FIRST_ORDER = "an expansion to first order in the Mach number: Prosperetti & Lezzi (1986), J. Fluid Mech. 168, 457"
MACH_LIMITS: Mapping[Radial, tuple[float, str]] = {
    "rayleigh-plesset": (0.3, "an incompressible liquid; 0.3 is the usual limit"),
    "keller-miksis": (1.0, FIRST_ORDER),
    "keller-miksis-enthalpy": (1.0, FIRST_ORDER),
    "gilmore": (2.2, "the usual limit of the Kirkwood-Bethe hypothesis: Hickling & Plesset (1964), Phys. Fluids 7, 7"),
}

Gas = Literal["heat", "polytropic", "isothermal", "adiabatic"]
Start = Literal["acoustic", "laser"]
Vapour = Literal["none", "frozen", "transport"]
Heat = Literal["cold", "conducting"]


@cache
def _kinds(declared: type) -> dict[str, Any]:
    """The fields of a dataclass that are declared as one of several names, or as a class of this package."""
    hints = get_type_hints(declared)
    named = {f.name: hints[f.name] for f in fields(declared)}
    return {name: kind for name, kind in named.items() if get_origin(kind) is Literal or "en4dvar_bubble" in str(kind)}


def require_kinds(whole: Any, declared: type) -> None:
    """Raise :class:`ConfigError` where a field is not what the dataclass ``declared`` says."""
    for name, kind in _kinds(declared).items():
        value, literal = getattr(whole, name), get_origin(kind) is Literal
        if literal and value not in get_args(kind):
            raise ConfigError(f"{name}: unknown name {shown(value)}{suggest(value, get_args(kind))}")
        if not literal and not isinstance(value, kind):
            raise ConfigError(f"{name}: {shown(value)} is no {str(kind).rpartition('.')[2].strip(chr(39) + '>')}")


@dataclass(frozen=True)
class Wall:
    """A plane at ``distance`` (m; of R_max if ``relative``) from the centre of the bubble: ``rigid``, or the ``free``
    surface of the medium; a ``slit`` has a rigid one on either side.
    """

    distance: float
    kind: Literal["rigid", "free", "slit"] = "rigid"
    relative: bool = False

    def __post_init__(self) -> None:
        require_kinds(self, Wall)

    def __str__(self) -> str:
        return f"{self.kind}, {self.distance:.6g} {'R_max' if self.relative else 'm'}"

    def away(self, values: Mapping[str, Array]) -> Array:
        """The distance in m for members with parameters name → (N,)."""
        unit = values["R_max"] if self.relative else 1.0
        return np.asarray(values.get(WALL_DISTANCE.name, self.distance * unit))


R0 = positive("R0", "m", "stress-free radius", "$R_0$", MANCIA, "um")
R_EQ = positive(
    "R_eq", "m", "equilibrium (and stress-free) radius", r"$R_{\mathrm{eq}}$", "Estrada et al. (2018)", "um"
)
R_MAX = positive(
    "R_max", "m", "maximum radius, where the bubble is released", r"$R_{\max}$", "Estrada et al. (2018)", "um"
)


@cache
def _usual_driving(start: Start) -> Driving:
    return histotripsy() if start == "acoustic" else silence()


@dataclass(frozen=True, eq=False)
class Dynamics:
    """One spherical gas bubble in a viscoelastic medium.

    ``start="acoustic"``: at rest at R0 until the driving (by default the histotripsy pulse) arrives; parameters of the
    law and ``R0``.
    ``start="laser"``: released from ``R_max`` at the ambient temperature with the amount of gas that is in
    equilibrium at ``R_eq``, the stress-free radius: p_g(R_max) = p_g(R_eq) (R_eq/R_max)³, whatever the gas does
    afterwards. Before time zero the released bubble is taken to be symmetric in time, R(−t) = R(t). Memory variables
    start relaxed.

    ``gas``: the energy equation (``heat``) or a polytropic law with exponent κ (``polytropic``, ``adiabatic``) or 1
    (``isothermal``). ``vapour="frozen"``: the saturated vapour of time zero stays in the bubble as if it were gas. With
    ``heat``: ``vapour="transport"`` keeps it in equilibrium at the wall, or with ``accommodation`` among the parameters
    lets it condense and evaporate at the rate of Hertz and Knudsen, and lets it diffuse in the gas,
    ``medium_heat="conducting"`` solves the temperature of the medium. Equations: ``solver.equations``,
    ``solver.general``.

    Raises
    ------
    ConfigError: a name that is none of those, another object, or a parameter of the law that is called like another.
    ValueError: options that exclude each other; a law of a user's that the solver's table cannot hold.
    """

    law: ConstitutiveLaw = field(default_factory=QuadraticKelvinVoigt)
    gas: Gas = "heat"
    start: Start = "acoustic"
    driving: Driving = None  # type: ignore[assignment]  # chosen by the start
    reading: Reading = "instantaneous"
    medium: Medium = WATER_25C
    accuracy: Accuracy = None  # type: ignore[assignment]  # or its name; by default ``standard`` for the start
    radial: Radial = "keller-miksis"
    vapour: Vapour = "none"
    medium_heat: Heat = "cold"
    hydrophone: float = 1.0
    """Its distance from the bubble, m (:mod:`events`)."""
    wall: Wall | None = None
    """A plane whose image of the bubble, taken to move at the same instant, adds its pressure."""
    gas_change: float = 0.0
    """Standard deviation of ln of what the amount of gas is multiplied by at a collapse, by what no equation says."""
    viscosity_change: float = 0.0
    """Standard deviation of ln of what the viscosity is multiplied by at a collapse: it is not all that damps one."""
    named: tuple[str, ...] = ()
    """Those of the :attr:`optional_parameters` that are parameters."""

    def __post_init__(self) -> None:
        if self.driving is None:
            object.__setattr__(self, "driving", _usual_driving(self.start))
        accuracy: Any = self.accuracy or "standard"
        is_name = isinstance(accuracy, str)
        if is_name:
            object.__setattr__(self, "accuracy", preset(accuracy, self.start))
        require_kinds(self, Dynamics)
        require_parameters(type(self.law), self.law.name)
        refuse_unfit(type(self.law))
        if self.law.released and self.start != "laser":
            raise ValueError(f"{self.law.name} needs start: laser: only a released bubble has an R_max at time zero")
        if self.wall and self.start != "laser":
            if self.wall.kind == "slit":
                raise ValueError("a slit needs start: laser: how many of its images are heard follows from R_max")
            if self.wall.relative:
                raise ValueError("a distance of a wall in R_max needs start: laser: no other bubble has an R_max")
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

    @cached_property
    def system(self) -> System:
        """The unknowns and equations of the compiled solver."""
        heat = self.gas == "heat"
        return System(
            gas=self.accuracy.nodes if heat else 0,
            vapour=self.accuracy.nodes if self.vapour == "transport" else 0,
            medium=self.accuracy.medium_nodes if self.medium_heat == "conducting" else 0,
            kinetic=self.vapour == "transport" and ACCOMMODATION.name in self.named,
            memory=self.law.memory_count,
            radial=self.radial,
            shear=self.law.shear_dependent,
            strain=self.law.strain_dependent,
            clustering=GAS_CLUSTERING[self.start],
            medium_length=MEDIUM_LENGTHS[self.start],
            image=self.wall is not None,
        )

    @cached_property
    def solver(self) -> Solver:
        """The compiled solver of these equations."""
        hottest = np.inf
        if self.system.vapour and self.system.wall:
            hottest = float(self.medium.kirchhoff(CRITICAL_TEMPERATURE / self.medium.T_inf))
        valid, _ = MACH_LIMITS[self.radial]
        return Solver(self.system, self.driving, self.reading, self.accuracy, hottest, valid)

    def exponent(self, medium: Medium) -> float | Array:
        """Polytropic exponent in a medium of :meth:`medium_of` (used without the energy equation)."""
        return 1.0 if self.gas == "isothermal" else medium.kappa

    @property
    def stress_free_radius(self) -> str:
        """Name of the parameter that is the stress-free radius."""
        return "R0" if self.start == "acoustic" else "R_eq"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of the law, then R0, or R_eq and R_max for the laser start, then the optional ones that are named."""
        radii = (R0,) if self.start == "acoustic" else (R_EQ, R_MAX)
        named = [p for p in self.optional_parameters if p.name in self.named] if self.named else []
        return (*self.law.parameters, *radii, *named)

    @cached_property
    def optional_parameters(self) -> tuple[Parameter, ...]:
        """The :mod:`numbers` that the equations contain."""
        pulse = {number.parameter.name: number.parameter for number in self.driving.numbers}
        return tuple(pulse.get(p.name, p) for p in ALL if self._contains[p.name][0])

    @property
    def absent_parameters(self) -> Mapping[str, str]:
        """The other numbers, each with the settings with which the equations contain it."""
        return {name: needed for name, (there, needed) in self._contains.items() if not there}

    @cached_property
    def _contains(self) -> Mapping[str, tuple[bool, str]]:
        """Number → whether the equations contain it, and with which settings they do."""
        heat, transport, wall = self.gas == "heat", self.vapour == "transport", bool(self.system.wall)
        pulse = {number.parameter.name for number in self.driving.numbers}
        of_pulse = "a driving that has it (docs/physics.md)"
        acts = {p.name: (not p.name.startswith("pulse_") or p.name in pulse, of_pulse) for p in ALL}
        acts |= dict.fromkeys(("A", "B"), (heat, "gas: heat"))
        acts |= dict.fromkeys(("K_m", "c_m"), (wall, "medium_heat: conducting"))
        tait = self.radial in ("keller-miksis-enthalpy", "gilmore")
        acts |= dict.fromkeys(("tait_B", "tait_n"), (tait, "radial: keller-miksis-enthalpy or gilmore"))
        acts |= dict.fromkeys(("D_v", "D_p", "D_T", ACCOMMODATION.name), (transport, "vapour: transport"))
        both = "vapour: transport and medium_heat: conducting"
        acts |= dict.fromkeys(("L_v", "M_v"), (transport and wall, both))
        # a constant vapour pressure would not follow the temperature
        warm = (heat or self.vapour != "none") and not self.medium.p_v
        acts |= {
            "p_v": (self.vapour == "none", "vapour: none"),
            "T_inf": (warm, "gas: heat or a vapour, and no constant vapour pressure"),
            "c": (self.radial != "rayleigh-plesset", "a radial other than rayleigh-plesset"),
            "kappa": (self.gas != "isothermal", "a gas other than isothermal"),
            WALL_DISTANCE.name: (self.wall is not None, "wall: {distance: …}"),
            P_A.name: (not self.driving.silent, "a driving"),
            "surface_tension": (not self.law.rest_tension, "a law that has no tension of its own"),
        }
        return acts | dict.fromkeys((R_START.name, RDOT_START.name), (self.start == "acoustic", "start: acoustic"))

    def medium_of(self, values: Mapping[str, Array], axes: int = 0) -> Medium:
        """The medium of members with parameters name → (N,): constants that are parameters are (N, 1, …), with as
        many further ``axes`` as what they meet has.
        """
        own: dict[str, Any] = {
            constant: values[p.name].reshape(-1, *[1] * axes)
            for constant, p in OF_MEDIUM.items()
            if p.name in self.named
        }
        if self.law.rest_tension:
            own["S"] = values[self.law.rest_tension].reshape(-1, *[1] * axes)
        return replace(self.medium, **own) if own else self.medium

    def image(self, values: Mapping[str, Array]) -> float | Array:
        """±1/(2h) in 1/m for members with parameters name → (N,): + a rigid plane at the distance h, − a free one. In
        a slit 1/h (1 + 1/2 + … + 1/n), of the images whose sound arrives within growth and collapse: n = c t_c/h.
        """
        if self.wall is None:
            return 0.0
        h = self.wall.away(values)
        if self.wall.kind == "slit":
            medium = self.medium_of(values)
            heard = medium.c * RAYLEIGH * values["R_max"] * np.sqrt(medium.rho / medium.p_inf) / h
            return np.asarray((digamma(1 + heard) + np.euler_gamma) / h)
        return (0.5 if self.wall.kind == "rigid" else -0.5) / h

    @cached_property
    def layout(self) -> StateLayout:
        """R, Rdot, p_b, S (stress integral); T of the gas (wall last where the medium conducts), C (mass fraction of
        vapour; wall last where it crosses that at a finite rate), T_m of the medium, Z (memory variables) where the
        model has them; the parameters.
        """
        system, above_zero = self.system, (0.0, np.inf)
        least_pressure = 0.0 if "p_v" in self.named else self.medium.p_v
        state = (
            Field("R", unit="m", bounds=above_zero, symbol="$R$"),
            Field("Rdot", unit="m/s", symbol="$Ṙ$"),
            Field("p_b", unit="Pa", bounds=(least_pressure, np.inf), symbol=r"$p_{\mathrm{b}}$", display_unit="kPa"),
            Field("S", unit="Pa", symbol="$S$", display_unit="kPa"),
            Field("T", system.gas + system.wall, "K", above_zero, symbol="$T$"),
            Field("C", system.vapour + system.kinetic, "1", (0.0, 1.0), symbol="$C$"),
            Field("T_m", system.medium, "K", above_zero, symbol=r"$T_{\mathrm{m}}$"),
            Field("Z", system.memory, "Pa", symbol="$Z$", display_unit="kPa"),
            *(Field(p.name, unit=p.unit) for p in self.parameters),
        )
        return StateLayout(tuple(block for block in state if block.size))

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """States (N, n_state) at time zero for parameters name → (N,), SI.

        Raises
        ------
        ValueError: a parameter outside its bounds, or a radius whose equilibrium gas pressure is not positive.
        """
        for p in self.parameters:
            value = np.asarray(theta[p.name], dtype=float)
            low, high = float(value.min()), float(value.max())  # NaN if one is
            if not (p.bounds[0] <= low and high <= p.bounds[1] and math.isfinite(low) and math.isfinite(high)):
                raise ValueError(f"{p.name} must lie in {p.bounds} {p.unit}")
        values = {p.name: np.asarray(theta[p.name], dtype=float) for p in self.parameters}
        rest = values[self.stress_free_radius]
        R = values.get(R_START.name, rest) if self.start == "acoustic" else values["R_max"]
        if np.any(rest <= 0) or np.any(R <= 0):
            raise ValueError("radii must be positive")
        if self.wall is not None and np.any(self.wall.away(values) <= R):
            raise ValueError("the bubble reaches the wall: R at time zero must be less than the distance of the wall")
        medium, layout, system = self.medium_of(values), self.layout, self.system
        p_v = medium.p_v if self.vapour == "none" else saturated_vapour_pressure(medium.T_inf)
        gas = (medium.p_inf + 2 * medium.S / rest - p_v) * (rest / R) ** 3 * values.get(GAS_CONTENT.name, 1.0)
        if np.any(gas <= 0):
            raise ValueError(
                "the vapour pressure exceeds the equilibrium pressure: there would be no gas in the bubble"
            )
        x = np.empty((len(rest), layout.size))
        Rdot = values.get(RDOT_START.name, 0.0)
        fields = {"R": R, "Rdot": Rdot, "p_b": gas + p_v, "T": medium.T_inf, "T_m": medium.T_inf, **values}
        law_values = self.law_values(values)
        relaxed = self.law.relaxed(R / rest, law_values)
        fields["Z"] = relaxed
        fields["S"] = relaxed.sum(axis=1)
        if R is not rest:  # there is no elastic stress at the stress-free radius
            fields["S"] = fields["S"] + self.law.elastic_stress((R / rest)[:, None], law_values)[:, 0]
        if system.vapour:
            fields["C"] = medium.mass_fraction(p_v / (gas + p_v))[:, None]
        for name, where in layout.slices.items():
            value = np.asarray(fields[name])
            x[:, where] = value[:, None] if value.ndim == 1 else value
        return x

    def parameter_values(self, x: Array) -> dict[str, Array]:
        """All parameters, name → (N,), of states (N, n_state)."""
        return {p.name: x[:, self.layout[p.name].start] for p in self.parameters}

    def law_values(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """What the law reads of all parameters name → (N,)."""
        own = {p.name: values[p.name] for p in self.law.parameters}
        if self.law.sized:
            own["R0"] = values[self.stress_free_radius]
        return own | {"R_max": values["R_max"]} if self.law.released else own
