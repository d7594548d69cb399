"""The NumPy side of the solver: accuracy, the arrays a system of equations needs, failure reasons."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import stamp_with_sources
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown, suggest
from en4dvar_bubble import tables as tables_module
from en4dvar_bubble.driving import Driving, Reading
from en4dvar_bubble.laws.exactness import HALVINGS
from en4dvar_bubble.laws.tabulate import GRID, VISCOUS_GRID
from en4dvar_bubble.solver import integrate, rodas5p, rows
from en4dvar_bubble.solver.apart import address
from en4dvar_bubble.solver.arrays import Control, Dims, Equations, Members, Output, Scratch, Shared
from en4dvar_bubble.solver.collocation import Grid, ball, exterior
from en4dvar_bubble.solver.fields import scratch_rows
from en4dvar_bubble.solver.general import sums, tiles
from en4dvar_bubble.solver.lanes import WIDTH
from en4dvar_bubble.solver.tiles import AREA, EDGE, kept_tiles

for _kernel in (integrate.integrate, integrate.between_steps):
    stamp_with_sources(_kernel, Path(__file__).parent, Path(tables_module.__file__))

AccuracyName = Literal["fast", "standard", "reference"]
Radial = Literal["rayleigh-plesset", "keller-miksis", "keller-miksis-enthalpy", "gilmore"]

RADIALS: dict[Radial, int] = {
    "rayleigh-plesset": rows.PRESSURE,
    "keller-miksis": rows.PRESSURE,
    "keller-miksis-enthalpy": rows.ENTHALPY,
    "gilmore": rows.GILMORE,
}

UNROLLED = (0, 4, 8)
"""Numbers of temperature nodes for which the paper's equations are compiled with all loops unrolled."""
_FIRST_STEP = 1e-3  # µs
_STEPS_IN_DRIVING = 32
_SLOWEST_RATE = 0.01  # 1/µs: errors of V = Ṙ/R below rtol times this are not seen (they accumulate over about 100 µs)
_LEAST_GAS = 1e-6  # mole fraction of gas below which its error is judged on this scale
_STRESS_SCALE = 10.0  # µm²/µs², about 0.1 bar: errors of a memory variable below rtol times this are not seen


@dataclass(frozen=True)
class Accuracy:
    """Nodes in the gas (temperature, vapour) and in the medium, relative tolerance of the time steps, and limits.

    ``step_limit`` (three tenths of it for a hundredth of the span) and ``time_limit`` (seconds of wall clock, and up to
    2 more; not those in which the process is suspended) bound the work per member; ``mach_limit`` ends a member whose
    wall Mach number exceeds it.
    """

    nodes: int = 4
    rtol: float = 1e-5
    medium_nodes: int = 24
    step_limit: int = 20_000
    time_limit: float = 60.0
    mach_limit: float = np.inf


ACCURACIES: dict[AccuracyName, Accuracy] = {
    "fast": Accuracy(nodes=4, rtol=1e-4, medium_nodes=16),
    "standard": Accuracy(nodes=4, rtol=1e-5, medium_nodes=24),
    "reference": Accuracy(nodes=24, rtol=1e-8, medium_nodes=48, step_limit=80_000),
}
# A released bubble is full of gas that is hot in its core when it bounces, under a thin layer at the wall; the acoustic
# one has hardly any.
GAS_CLUSTERING = {"acoustic": 0.0, "laser": 3.0}
# It is so large that heat comes a few percent of its radius into the medium, where its grid is dense.
MEDIUM_LENGTHS = {"acoustic": 0.5, "laser": 0.05}
_NODES_RELEASED: dict[AccuracyName, int] = {"fast": 8, "standard": 12, "reference": 32}  # in both


def preset(name: AccuracyName, start: str) -> Accuracy:
    """The accuracy called ``name`` for a start, ``acoustic`` or ``laser``. Raises :class:`ConfigError`."""
    if name not in ACCURACIES:
        raise ConfigError(f"accuracy: unknown name {shown(name)}{suggest(name, ACCURACIES)}")
    base = ACCURACIES[name]
    if start == "acoustic":
        return base
    return replace(base, nodes=_NODES_RELEASED[name], medium_nodes=_NODES_RELEASED[name])


@dataclass(frozen=True)
class System:
    """Which unknowns there are, in the order of the kernel's rows, and which equations.

    ``gas`` temperature nodes, ``vapour`` mole-fraction nodes (0 or ``gas``), ``medium`` temperature nodes, ``memory``
    variables; ``kinetic``: whether vapour crosses the wall at a finite rate; ``shear``, ``strain``: a viscosity that
    depends on the shear rate, or on the stretch. ``clustering`` of the gas nodes at the wall, see
    :func:`collocation.ball`. ``medium_length``: of the medium's grid map in radii; half of its nodes lie within it of
    the wall. ``image``: whether a plane mirrors the bubble.
    """

    gas: int
    vapour: int = 0
    medium: int = 0
    kinetic: bool = False
    memory: int = 0
    radial: Radial = "keller-miksis"
    shear: bool = False
    strain: bool = False
    clustering: float = 0.0
    medium_length: float = 0.5
    image: bool = False

    @property
    def wall(self) -> int:
        """1 where the wall temperature is an unknown."""
        return int(self.medium > 0)

    @cached_property
    def general(self) -> bool:
        options = self.vapour, self.medium, self.memory, self.shear, self.strain, self.image
        return any(options) or RADIALS[self.radial] != rows.PRESSURE

    @cached_property
    def size(self) -> int:
        return self.first_memory + self.memory + 2

    @property
    def ball(self) -> Grid:
        """The grid of the gas, which has one."""
        return ball(self.gas, self.clustering)

    @property
    def dims(self) -> Dims:
        counts = self.gas, self.vapour, self.medium, self.wall, int(self.kinetic), self.memory
        return Dims(*counts, RADIALS[self.radial], int(self.shear), int(self.strain))

    @property
    def first_medium(self) -> int:
        return self.gas + self.vapour

    @property
    def wall_row(self) -> int:
        return self.first_medium + self.medium

    @property
    def first_memory(self) -> int:
        return self.wall_row + self.wall + self.kinetic

    def tolerances(self, rtol: float) -> Array:
        """(2, n) absolute and relative tolerances; ln R has an absolute one, which is a relative one of R."""
        tol = np.full((2, self.size), rtol)
        tol[0, self.gas : self.first_medium] = rtol * _LEAST_GAS
        tol[0, self.wall_row + self.wall : self.first_memory] = rtol * _LEAST_GAS
        tol[0, self.first_memory : -2] = rtol * _STRESS_SCALE
        tol[0, -2] = rtol * _SLOWEST_RATE
        tol[1, -1] = 0.0
        return tol


_ELASTIC_SPAN, _VISCOUS_SPAN = GRID.span, VISCOUS_GRID.span
_NO_ROWS = np.zeros((3, 1))
_REFINED_SPAN = np.append(_ELASTIC_SPAN[:4], HALVINGS)


@dataclass(frozen=True)
class Solution:
    """Raw solver output. ``states`` (N, K, n) in the rows of :class:`System`, NaN where a member did not get.

    ``status`` (N,) and the columns of ``record`` (N, RECORD): see :mod:`integrate`. ``ends``: of members that are not
    finite, between which stretches their law is.
    """

    states: Array
    status: np.ndarray
    record: Array
    ends: dict[int, str] = field(default_factory=dict)

    def reason(self, member: int) -> str:
        """Why a member failed, in words; "" where it did not."""
        status, record = int(self.status[member]), self.record[member]
        if status == integrate.OK:
            return ""
        words = {
            integrate.STEP_LIMIT: "step limit reached",
            integrate.NON_FINITE: "non-finite state",
            integrate.STEP_UNDERFLOW: "step size underflow",
            integrate.MACH_LIMIT: f"model validity: wall Mach {record[integrate.MAX_MACH]:.3g}",
            integrate.WALL_LIMIT: "model validity: wall above the critical temperature of water",
            integrate.TIME_LIMIT: "time limit reached",
        }
        return f"{words[status]} at t = {record[integrate.END_TIME]:.4g} µs{self.ends.get(member, '')}"


@dataclass(frozen=True, eq=False)
class Solver:
    """A system of equations, what drives it, and how accurately it is integrated."""

    system: System
    driving: Driving
    reading: Reading
    accuracy: Accuracy
    hottest_wall: float = np.inf
    """τ of the wall above which there is no equilibrium with its vapour."""
    valid_mach: float = np.inf
    """Wall Mach number that the radial equation bears."""

    @cached_property
    def _arrangement(self) -> tuple[Any, Any, Any, Any]:
        """Nodes, size, where, places of the equations; of few nodes tuples, to unroll loops: half the time a step."""
        system = self.system
        if system.general:
            return None, None, *tiles(system.dims)
        if system.gas in UNROLLED:
            return (0,) * system.gas, (0,) * system.size, None, None
        every = np.arange(system.size)
        return np.zeros(system.gas), None, kept_tiles(np.ones((len(every), len(every)), dtype=bool), every), every

    def equations(self, memory: Array, viscous: Array, pulse: Array, halved: bool = False) -> Equations:
        """What the compiled equations read beside the members' parameters; tables of laws and pulses (…, cells, 8).
        ``halved``: the elastic tables have halved cells.
        """
        system, driving = self.system, self.driving
        medium = exterior(system.medium, system.medium_length).rows if system.medium else _NO_ROWS
        general: tuple[Any, Any, Any, Any] = (None,) * 4  # what nobody reads need not be compiled either
        if system.general:
            general = medium, memory, viscous, _ELASTIC_SPAN if system.strain else _VISCOUS_SPAN
        gas, reading = system.ball.rows if system.gas else _NO_ROWS, get_args(Reading).index(self.reading)
        shared = gas, _REFINED_SPAN if halved else _ELASTIC_SPAN, pulse, driving.grid.span
        nodes, size, where, places = self._arrangement
        return Equations(nodes, size, system.dims, *shared, reading, *general, where, places)

    @cached_property
    def control(self) -> Control:
        """How the compiled integration chooses its steps, and when it gives a member up."""
        accuracy, (begin, end) = self.accuracy, self.driving.grid.span[:2]
        return Control(
            breaks=self.driving.breaks,
            tolerances=self.system.tolerances(accuracy.rtol),
            first_step=_FIRST_STEP,
            longest_driven=float(end - begin) / _STEPS_IN_DRIVING,
            step_limit=float(accuracy.step_limit),
            mach_limit=float(accuracy.mach_limit),
            seconds=float(accuracy.time_limit),
            hottest_wall=float(self.hottest_wall),
            valid_mach=float(self.valid_mach),
        )

    def prepared(
        self, members: Members, memory: Array, viscous: Array, pulse: Array
    ) -> tuple[Callable[[], object], Solution]:
        """A call that integrates the members without the interpreter, and the solution that it fills.

        Threads that make the call at once share the members; each returns when no member is left to begin, and all are
        done when all have returned. Members never influence each other: the bits do not depend on how they are batched.
        """
        n_members, n_times = members.times.shape
        output = Output(
            np.empty((n_members, n_times, self.system.size)),
            np.zeros(n_members, dtype=np.int64),
            np.zeros((n_members, integrate.RECORD)),
        )
        cells = max(members.tables.shape[1], GRID.cells)
        equations, control = self.equations(memory, viscous, pulse, cells > GRID.cells), self.control

        def call() -> None:
            working = self._scratch(members.parameters.shape[1], cells)
            shared = Shared(members, control, output, working, equations.dims, equations.driving_span)
            integrate.integrate(address(integrate.between_steps, shared), shared, equations)

        return call, Solution(*output)

    def _scratch(self, parameters: int, cells: int) -> Scratch:
        """That for members of so many ``parameters`` and elastic tables of so many ``cells``."""
        system, where, n = self.system, self._arrangement[2], self.system.size
        matrix = 0 if system.general else n**2
        tiled = (0, 0) if where is None else ((where.max() + 1) * AREA, len(where) * EDGE)
        border = n - system.wall_row + sums.py_func(system.dims) if system.general else 0
        step = scratch_rows(system.dims), n, matrix, 1, rodas5p.STAGES * n, n, n, 1, 3, 3 * n, *tiled
        general = border, border, rows.SHARED, border, rows.SHARED
        lanes = n, 1, 1, parameters, 1, 1, 1, 1
        edges = np.cumsum([0, *step, *general, *lanes])
        raw = np.zeros((edges[-1] + 1) * WIDTH)
        first = -(raw.ctypes.data // 8) % WIDTH  # on a 64-byte boundary: a row that straddles two lines costs twice
        block = raw[first : first + edges[-1] * WIDTH].reshape(-1, WIDTH)
        marks, turn = np.zeros((4, WIDTH), dtype=np.int64), np.zeros(6, dtype=np.int64)
        marks[0] = -1  # no lane has a member
        block[edges[-7] : edges[-6]] = _FIRST_STEP  # so that one without gets no further than finite numbers
        return Scratch(block, edges, marks, turn, np.zeros((WIDTH, cells, 8)))
