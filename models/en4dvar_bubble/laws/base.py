"""Constitutive laws. An author writes one class: its ``name``, its ``parameters`` and its elastic part, as the stress
integral or as W′(λ) (a :class:`Liquid` has none); where it has no Newtonian dashpot, its viscosity; and its memory, if
any. Everything is tabulated per member before the compiled integration starts, so the kernel does not change.
"""

from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache, partial, wraps
from typing import Any, ClassVar

import numpy as np

from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.user_file import is_from_file
from en4dvar_bubble.laws.exactness import Refined, is_sharp, refine
from en4dvar_bubble.laws.memory import MemoryTables, MemoryVariable
from en4dvar_bubble.laws.parameters import MU, Values, columns
from en4dvar_bubble.laws.tabulate import (
    GRID,
    STRETCH,
    VISCOUS_GRID,
    from_function,
    from_strain_energy,
    from_viscosity,
    slope,
)
from en4dvar_bubble.tables import evaluate, from_values

REGISTRY: "dict[str, type[ConstitutiveLaw]]" = {}
_TOGETHER = 48  # members sampled at once: their temporary arrays fit in the cache
_EXAMPLE_BY_NAME = {"G": 5e3, "alpha": 0.03, "mu": 0.1}
_EXAMPLE_BY_UNIT = {"Pa": 5e3, "Pa s": 0.1, "s": 1e-6, "1": 0.5, "N/m": 0.02}
_METHODS = ("stress", "strain_energy_rate", "viscosity", "strained_viscosity", "memory")


def _on_copies(method: Any) -> Any:
    """A method of a law that may write into its arguments: it gets copies of them."""

    @wraps(method)
    def call(law: Any, *arguments: Any, **named: Any) -> Any:
        return method.__get__(law, type(law))(*deepcopy(arguments), **deepcopy(named))

    return call


Limits = tuple[tuple[type["ConstitutiveLaw"], Mapping[str, float]], ...]


class ConstitutiveLaw:
    """Base class of constitutive laws; a subclass with a ``name`` of its own registers itself.

    The stress integral is J = 2 ∫_R^∞ (τ_rr − τ_θθ)/r dr = J_e(λ) − 4 μ̄(|V|) V + Σ s, with V = Ṙ/R, λ = R/R0.

    - Elastic: for any incompressible isotropic solid dJ_e/dλ = −W′(λ)/(λ³ − 1), J_e(1) = 0, with W(λ) the strain
      energy of the equibiaxial stretch λ.
    - Viscous: μ̄ is the parameter ``mu``; or, where ``viscosity`` is defined, ∫₀¹ μ(2√3 |V| s) ds, since the flow
      u = R²Ṙ/r² has the shear rate γ̇ = 2√3 |Ṙ| R²/r³ and s = (R/r)³; or, where ``strained_viscosity`` is, μ̄(λ).
    - Memory: each variable adds s (Pa) with ds/dt = −s/θ + k V s + V a(λ) + b(λ)/θ, see :class:`MemoryVariable`.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    parameters: ClassVar[tuple[Parameter, ...]] = (MU,)
    example: ClassVar[Mapping[str, float]] = {}
    """Typical SI values where the battery tests the law; missing ones are chosen by name or unit."""
    limits: ClassVar[Limits] = ()
    """(parent law, values): with these values of its parameters the law is the parent."""
    monotone: ClassVar[bool] = True
    """Whether J_e falls with the stretch everywhere, so that it always opposes the strain."""
    stretch_range: ClassVar[tuple[float, float]] = (0.2, 400.0)
    """Stretches over which the battery tests the law at the example values."""
    sized: ClassVar[bool] = False
    """Whether the law depends on the size of the bubble: then ``p.R0`` is the stress-free radius in m."""
    released: ClassVar[bool] = False
    """Of a ``sized`` law: whether it is for released bubbles alone; ``p.R_max`` is their largest radius in m."""
    rest_tension: ClassVar[str] = ""
    """Name of the parameter that is the tension of the bubble's surface at rest, instead of the surface tension."""
    kinked: ClassVar[bool] = False
    """Of a law of the package: whether its table needs halved cells. That of a user's is looked at."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for method in _METHODS:
            owner = next(kind for kind in cls.__mro__ if method in vars(kind))
            written = vars(owner)[method] is not vars(ConstitutiveLaw)[method]
            if written and (owner is cls or not issubclass(owner, ConstitutiveLaw)):  # another law has done it already
                setattr(cls, method, _on_copies(vars(owner)[method]))
        own = cls.__dict__.get("name")
        cls.name = own or cls.__name__
        if own and not is_from_file(cls):  # a law from a file is not registered: two files may name theirs alike
            present = REGISTRY.get(cls.name, cls)
            if (present.__module__, present.__qualname__) != (cls.__module__, cls.__qualname__):
                raise ConfigError(f"two laws are called {cls.name!r}: {present.__module__} and {cls.__module__}")
            REGISTRY[cls.name] = cls

    def stress(self, stretch: Array, p: Values) -> Array:
        """J_e(λ) (N, K) in Pa at stretches (K,): the elastic part of the stress integral; ``p.G`` is (N, 1)."""
        raise NotImplementedError

    def strain_energy_rate(self, stretch: Array, p: Values) -> Array:
        """W′(λ) (N, K) in Pa at stretches (K,): derivative of the strain energy density in equibiaxial stretch."""
        raise NotImplementedError

    def viscosity(self, shear_rate: Array, p: Values) -> Array:
        """μ(γ̇) (N, K) in Pa s at shear rates (K,) in 1/s: a generalised Newtonian liquid, instead of the dashpot."""
        raise NotImplementedError

    def strained_viscosity(self, stretch: Array, p: Values) -> Array:
        """μ̄(λ) (N, K) in Pa s at stretches (K,) of the wall, instead of the dashpot: J has −4 μ̄ Ṙ/R."""
        raise NotImplementedError

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        """Memory variables; none unless overridden."""
        return ()

    def example_values(self, n: int = 1) -> dict[str, Array]:
        """Typical values of the parameters, name → (n,), inside their bounds."""

        def value(p: Parameter) -> float:
            by_unit = _EXAMPLE_BY_UNIT.get(p.unit, 1.0)
            return float(np.clip(self.example.get(p.name, _EXAMPLE_BY_NAME.get(p.name, by_unit)), *p.bounds))

        values = {p.name: np.full(n, value(p)) for p in self.parameters}
        radii = {"R0": 1e-6} if self.sized else {}
        radii |= {"R_max": 5e-6} if self.released else {}
        return values | {name: np.full(n, self.example.get(name, radius)) for name, radius in radii.items()}

    @property
    def closed_form(self) -> bool:
        """True if the elastic part is the stress, not W′(λ)."""
        return type(self).stress is not ConstitutiveLaw.stress

    @property
    def shear_dependent(self) -> bool:
        """True if the viscosity is the method, not the parameter ``mu``."""
        return type(self).viscosity is not ConstitutiveLaw.viscosity

    @property
    def strain_dependent(self) -> bool:
        """True if the viscosity depends on the stretch."""
        return type(self).strained_viscosity is not ConstitutiveLaw.strained_viscosity

    @property
    def memory_count(self) -> int:
        """Number of memory variables."""
        return len(self.memory(columns(self.example_values())))

    @property
    def sharp(self) -> bool:
        """True for a law that a uniform table does not hold: its table has halved cells."""
        return bool(is_sharp(type(self)))

    def samples(self, values: Mapping[str, Array]) -> Array | None:
        """J_e in Pa of N members at the nodes of the grid and its halo, (N, K); None of a law by W′(λ), and of a sharp
        one.
        """
        if not self.closed_form or self.sharp:
            return None
        n = members(values)
        samples = np.empty((n, len(GRID.nodes)))
        with np.errstate(all="ignore"):  # a law may overflow at stretches that no member reaches
            for first in range(0, n, _TOGETHER):
                some = slice(first, first + _TOGETHER)
                samples[some] = self.stress(STRETCH, columns({name: v[some] for name, v in values.items()}))
        return samples

    def table(self, values: Mapping[str, Array], halved: bool = False) -> Array:
        """J_e against ln λ for N members: (N, cells, 8) coefficients on :data:`GRID`, Pa. ``values``: name → (N,).

        Of a :attr:`sharp` law, or where asked for, halved cells follow those of the grid, as many as the member takes
        that takes most. A table without them ends up to a tenth of λ before the law does.
        """
        samples = None if halved else self.samples(values)
        if samples is not None:
            return from_values(samples)
        if halved or self.sharp:
            return _kept(self, tuple(values), np.stack([*values.values()], dtype=float).tobytes()).copy()
        p = columns(values)
        with np.errstate(all="ignore"):
            return from_strain_energy(partial(self.strain_energy_rate, p=p), members(values))

    def refined(self, values: Mapping[str, Array]) -> Refined:
        """J_e of one member (``values``: name → (1,)), with cells halved where it takes."""
        p = columns(values)

        def function(x: Array) -> Array:
            values = self.stress(np.exp(x), p) if self.closed_form else slope(partial(self.strain_energy_rate, p=p), x)
            return np.ravel(np.broadcast_to(values, (1, len(x)))).astype(float)

        with np.errstate(all="ignore"):
            return refine(function, slope=not self.closed_form)

    def viscous_table(self, values: Mapping[str, Array]) -> Array:
        """μ̄ (Pa s), (N, cells, 8): of laws that are :attr:`strain_dependent` against ln λ, on :data:`GRID`; of
        those that are :attr:`shear_dependent` against z = ln(|V| s), constant below the first node, on
        :data:`VISCOUS_GRID`.
        """
        p = columns(values)
        with np.errstate(all="ignore" if self.strain_dependent else None, over="ignore"):
            if self.strain_dependent:
                return from_function(partial(self.strained_viscosity, p=p), members(values))
            return from_viscosity(partial(self.viscosity, p=p), members(values))

    def memory_tables(self, values: Mapping[str, Array]) -> MemoryTables:
        """θ, k and the tables of a and b for values name → (N,) and M memory variables (M = 0 for most laws)."""
        variables, n = self.memory(columns(values)), members(values)
        shape = (n, len(variables), GRID.cells, 8)
        stiffness, equilibrium, times = np.empty(shape), np.empty(shape), np.empty(shape[:2])
        with np.errstate(all="ignore"):
            for i, variable in enumerate(variables):
                stiffness[:, i] = from_function(variable.stiffness_at, n)
                equilibrium[:, i] = from_function(variable.equilibrium_at, n)
                times[:, i] = np.broadcast_to(variable.relaxation_time, (n, 1))[:, 0]
        return MemoryTables(times, np.array([float(v.convection) for v in variables]), stiffness, equilibrium)

    def elastic_stress(self, stretch: Array, values: Mapping[str, Array]) -> Array:
        """J_e at ``stretch`` (N, K) for N members, Pa, from the same table the solver uses."""
        x, table = np.log(stretch), self.table(values)
        stress = np.asarray(evaluate(table, GRID.span, x))
        ended = np.flatnonzero((np.isnan(stress) & np.isfinite(x)).any(axis=1))
        if len(ended) and not self.sharp:
            finer = self.table({name: v[ended] for name, v in values.items()}, halved=True)
            stress[ended] = np.where(np.isnan(stress[ended]), evaluate(finer, GRID.span, x[ended]), stress[ended])
        return stress

    def mean_viscosity(self, rate: Array, values: Mapping[str, Array], stretch: float | Array = 1.0) -> Array:
        """μ̄ at |V| = ``rate`` (N, K) in 1/s and ``stretch`` for N members, Pa s, from the table the solver uses."""
        if self.strain_dependent:
            x = np.log(np.broadcast_to(stretch, rate.shape))
            return np.asarray(evaluate(self.viscous_table(values), GRID.span, x))
        if not self.shear_dependent:
            mu = np.asarray(values["mu"], dtype=float)[:, None] if "mu" in values else np.zeros((members(values), 1))
            return np.broadcast_to(mu, rate.shape).copy()
        span = VISCOUS_GRID.span
        z = np.clip(np.log(np.maximum(rate, np.exp(span[0]))), span[0], span[1])
        return np.asarray(evaluate(self.viscous_table(values), span, z))

    def relaxed(self, stretch: Array, values: Mapping[str, Array]) -> Array:
        """Memory variables (N, M) in Pa of members at rest at ``stretch`` (N,): s = b(λ)."""
        b = self.memory_tables(values).equilibrium
        x = np.log(stretch)[:, None]
        return np.concatenate([evaluate(b[:, i].copy(), GRID.span, x) for i in range(b.shape[1])] or [x[:, :0]], axis=1)


class Liquid(ConstitutiveLaw):
    """A law without a spring: J_e = 0."""

    def stress(self, stretch: Array, p: Values) -> Array:
        return np.zeros_like(stretch)


@lru_cache(maxsize=2)  # who reads the stress of a path, or runs it again, asks for the same
def _kept(law: ConstitutiveLaw, names: tuple[str, ...], numbers: bytes) -> Array:
    """The table of a sharp law for parameters ``names`` (n,) and the ``numbers`` (n, N) of members."""
    tables = [
        law.refined(dict(zip(names, member[:, None], strict=True))).table
        for member in np.frombuffer(numbers).reshape(len(names), -1).T
    ]
    most = max(map(len, tables))
    return np.stack([np.pad(table, ((0, most - len(table)), (0, 0))) for table in tables])


def members(values: Mapping[str, Array]) -> int:
    """N of values name → (N,)."""
    return len(next(iter(values.values())))
