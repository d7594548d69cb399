"""The bubble as a forward model: state vector {R, Ṙ, p_b, S, T, C, …, parameters}, observed through its radius; and
what about an experiment could be otherwise than assumed, each by as much as laboratories differ.

Sizes: a hydrophone states the amplitude within 5 to 10 %; weather moves the ambient pressure by 2 % about its mean,
1000 m of height by 11 %; the rheometry codes take 0.056 to 0.072 N/m for the surface tension of water in a gel; a
calibration target gives the scale of the picture within about 1 %; the density of a gel is water's or up to 6 % more,
its speed of sound that of water or 3 % more; gels stiffen by an alpha of 0.03 (agarose: Mancia 2021) to 0.48
(polyacrylamide: Yang 2020), or not at all; the walls of a dish or of the holder of a gel are millimetres away, and
one three times the largest radius away makes a collapse 7 % longer (Rattray: 0.205 R_max/h).
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, ClassVar, cast

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
from en4dvar_bubble.collapse import SINGLE, doubts, single
from en4dvar_bubble.dynamics import MACH_LIMITS, Dynamics, Wall
from en4dvar_bubble.events import OBSERVABLES
from en4dvar_bubble.laws import REGISTRY, get_law
from en4dvar_bubble.laws.parameters import ALPHA
from en4dvar_bubble.laws.tabulate import GRID, ends
from en4dvar_bubble.numbers import NAMES, OF_MEDIUM, P_A, WALL_DISTANCE
from en4dvar_bubble.paths import Paths, pack, with_gas
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
        Observable("radius", "m", StateField("R", rate_of="Rdot"), "$R$", "um", "bubble radius", positive=True),
        *OBSERVABLES,
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
        """The largest Mach number of the wall that the radial equation can bear, and where that is said; and that the
        grid holds the layer of gas which condensing vapour leaves at the wall.
        """
        value, source = MACH_LIMITS[self.radial]
        mach = ValidityLimit("wall_mach", value, label="Mach number of the bubble wall", source=source)
        return (mach, SMEARING) if self.vapour == "transport" else (mach,)

    @property
    def path_parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(p.name for p in self.law.parameters)

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """See :mod:`en4dvar_bubble.model`."""
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
        """Whether the collapse time can be right, and what one collapse tells of the law, see
        :mod:`en4dvar_bubble.collapse`.
        """
        if observable != "radius":
            return ()
        told = doubts(times, values, predicted, members, self.medium)
        asked = tuple(p.name for p in self.law.parameters if np.ptp(members.get(p.name, 0.0)))
        if self.start == "laser" and asked and single(times, values):
            told = (*told, Caution("model-validity", "caution", *SINGLE, asked))
        return told

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({p.name: np.array([theta[p.name]]) for p in self.parameters})[0])

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Restart from any state: F_{t1←t0}. Raises RuntimeError with the solver's reason where it fails."""
        path = self.integrate(x[None, :], np.array([[t1]]), t0)
        if path.solution.status[0]:
            raise RuntimeError(path.solution.reason(0))
        return np.asarray(path.states[0, 0])

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        return self.integrate(x, times)

    def share(self, x: Array, times: Array) -> Shared:
        return Shared(*self.prepared(x, times))

    def integrate(self, x: Array, times: Array, t0: Array | float = 0.0) -> Paths:
        """All members from states ``x`` (N, n_state) at ``t0`` (s, one or (N,)) to increasing ``times`` (N, K) or (K,),
        in s.
        """
        work, finish = self.prepared(x, times, t0)
        work()
        return finish()

    def resumed(self, x: Array, start: Array, times: Array) -> Sequence[Trajectory | Failure]:
        return self.integrate(x, times, start)

    def prepared(
        self, x: Array, times: Array, t0: Array | float = 0.0, halved: bool = False
    ) -> tuple[Callable[[], object], Callable[[], Paths]]:
        """:meth:`integrate` of states (N, n_state) in two: the work, without the interpreter, which threads can share,
        and its result. Members that come to where a table ends are run again with ``halved`` cells, which end where
        the law does.
        """
        x, times = np.asarray(x, dtype=float), np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        micro = times * 1e6
        mirror = self.start == "laser" and not np.any(t0) and bool(np.any(times < 0))
        order = np.argsort(np.abs(micro), axis=1, kind="stable") if mirror else None
        if order is not None:
            micro = np.take_along_axis(np.abs(micro), order, axis=1)
        members, *tables = pack(self, x, t0 * 1e6, micro, halved)
        work, solved = self.solver.prepared(members, *tables)

        def finish() -> Paths:
            solution = solved
            if order is not None:
                back = np.argsort(order, axis=1)
                states = solution.states[np.arange(len(x))[:, None], back]
                states[:, :, -2] *= np.where(times < 0, -1.0, 1.0)
                solution = Solution(states, solution.status, solution.record)
            return self._followed(Paths(self, x, times, solution, members.parameters, t0), members)

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


SMEARING = ValidityLimit(
    "smeared",
    0.0,
    label="what the layer of gas at the wall is smeared over, in radii, as the grid cannot hold it (model.nodes; docs/"
    "solver.md)",
    source="docs/solver.md",
)
PULSE, REST, SCALE, CLOCK = 1.05, 1.1, 1.01, 1.01
NO_STIFFENING, STIFFENED = {ALPHA.name: 0.0}, 0.1
NOTHING: Mapping[str, str] = MappingProxyType({})
SATURATED, NO_VAPOUR = {"vapour_pressure": "saturated"}, {"vapour_pressure": "'0 Pa'"}
NEARBY = Wall(3.0, relative=True), "three times R_max"
NEARBY_DRIVEN = Wall(3e-3), "3 mm"
MEDIUM = (  # constant, alternative, factor, words
    ("p_inf", "ambient_pressure", 1.02, "the ambient pressure were 2 % higher"),
    ("rho", "density", 1.03, "the medium were 3 % denser"),
    ("c", "sound_speed", 1.03, "sound were 3 % faster in the medium"),
    ("S", "surface_tension", 0.8, "the surface tension were 20 % lower"),
)


@lru_cache(maxsize=4)  # the data sets of a campaign share their model; not in the model, which is sent to workers
def alternatives(model: Dynamics) -> tuple[Alternative, ...]:
    """Those of a bubble: pulse, law, medium, wall, gas, vapour, radius at rest, scale, time step.

    None in whose equations a parameter of the model has no place.
    """
    return tuple(a for a in _alternatives(model) if a.model is None or _names(a.model, a.constants) == _names(model))


def _names(model: ForwardModel | Dynamics, constants: Collection[str] = ()) -> list[str]:
    said = {WALL_DISTANCE.name, *constants}  # a wall's distance is stated with the wall itself
    return [p.name for p in model.parameters if p.name not in said]


def _as_options(model: Mapping[str, str], **others: Mapping[str, str]) -> str:
    """Keys of sections, and their values, as options of ``en4dvar run``."""
    sections = {"model": model, **others}
    return " ".join(f"--set {of}.{key}={value}" for of, keys in sections.items() for key, value in keys.items())


def _alternatives(model: Dynamics) -> Iterator[Alternative]:
    def changed(name: str, words: str, said: Mapping[str, str] = NOTHING, **options: Any) -> Alternative:
        """``said``: keys of the model, and their values, beside those of the ``options`` that are called so."""
        keys = {key: it for key, it in options.items() if isinstance(it, str)} | dict(said)
        return Alternative(name, words, replace(cast(Any, model), **options), options=_as_options(keys))

    medium, driving, rest = model.medium, model.driving, model.stress_free_radius
    others = {*model.named, *model.absent_parameters}  # what is a parameter has its own uncertainty
    if P_A.name not in others:
        stronger = replace(driving, amplitude=PULSE * driving.amplitude)
        yield changed("pulse_amplitude", "the pulse were 5 % stronger", driving=stronger)
    if stiffens := next((it for it in REGISTRY.values() if (type(model.law), NO_STIFFENING) in it.limits), None):
        words = f"the gel stiffened (law: {stiffens.name}, alpha: {STIFFENED:g})"
        asked = _as_options({"law": stiffens.name}, parameters={ALPHA.name: f"{STIFFENED:g}"})
        yield replace(changed("stiffening", words, law=stiffens()), constants={ALPHA.name: STIFFENED}, options=asked)
    for constant, key, factor, words in MEDIUM:
        if OF_MEDIUM[constant].name not in others:
            yield changed(key, words, medium=replace(medium, **{constant: factor * getattr(medium, constant)}))
    if model.wall is None:
        wall, far = NEARBY if model.start == "laser" else NEARBY_DRIVEN
        yield changed("wall", f"a rigid wall were {far} away (model.wall.distance)", wall=wall)
    if model.gas != "heat":
        yield changed("gas_model", "the gas conducted heat to the wall (gas: heat)", gas="heat")
    else:
        words = "the gas were polytropic (gas: polytropic)"
        of_vapour = model.vapour, NOTHING, medium
        vapour, said, its = ("none", SATURATED, medium.saturated) if model.vapour == "transport" else of_vapour
        yield changed("gas_model", words, said, gas="polytropic", medium_heat="cold", vapour=vapour, medium=its)
    if model.medium_heat == "conducting":
        yield changed("medium_heat", "the gel stayed cold at the wall (medium_heat: cold)", medium_heat="cold")
    yield from _of_vapour(model, changed)
    yield Alternative("radius_at_rest", f"{rest} were 10 % larger", parameters={rest: REST})
    yield Alternative("length_scale", "all radii were 1 % larger (µm per pixel)", values=SCALE, observable="radius")
    yield Alternative("time_scale", "the time between frames were 1 % longer", times=CLOCK, observable="radius")


def _of_vapour(model: Dynamics, changed: Callable[..., Alternative]) -> Iterator[Alternative]:
    """What is ``changed`` of the vapour: how fast it diffuses, and whether there is any."""
    medium = model.medium
    if model.vapour == "transport" and medium.D_p == 0 and not {"D_p", "D_T"} & set(model.named):
        words = "vapour diffused as in kinetic theory, by T^1.75/p (parameters: D_p and D_T)"
        kinetic = changed("diffusivity", words, medium=replace(medium, D_p=1.0, D_T=1.75))
        yield replace(kinetic, options=_as_options({}, parameters={"D_p": "1", "D_T": "1.75"}))
    if medium.p_v and "p_v" not in model.named:
        yield changed("vapour", "there were no vapour in the bubble", NO_VAPOUR, medium=replace(medium, p_v=0.0))
    elif model.vapour != "none":  # and p_v is no parameter
        yield changed("vapour", "there were no vapour in the bubble (vapour: none)", vapour="none")
    elif "p_v" not in model.named:
        words = "vapour filled the bubble (vapour_pressure: saturated)"
        yield changed("vapour", words, SATURATED, medium=medium.saturated)
