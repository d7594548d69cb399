"""The driving of a bubble: a pressure in the far field that is zero outside a span of time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import numpy as np

from en4dvar.model.state import Array, Parameter
from en4dvar_bubble.tables import LOBATTO, Grid, evaluate, to_coefficients

Reading = Literal["instantaneous", "retarded", "as-printed"]
Role = Literal["delay", "rate", "stretch", "shape"]

_LARGEST_JUMP = 1e-6


@dataclass(frozen=True)
class PulseNumber:
    """A number of a pulse that can be a parameter, the ``key`` that it has there, and the ``value`` in this pulse.

    What it does: the pulse is read at t_ref = δ + (t − δ_i) r_i; it is the delay δ_i, in proportion to the rate r_i, a
    stretch in proportion to 1/r_i, or changes the shape itself.
    """

    parameter: Parameter
    key: str
    value: float
    role: Role


@dataclass(frozen=True)
class Shape:
    """A ``function`` of time and of ``numbers``, as a shape that equals another one where both are the same."""

    function: Callable[..., Array]
    numbers: tuple[Any, ...]

    def __call__(self, t: Array) -> Array:
        return self.function(t, *self.numbers)


class Clocks(NamedTuple):
    """How N members read the driving: at t_ref = (t − shift) · rate, in µs, from so many numbers on in the table."""

    shift: float | Array
    rate: float | Array
    offset: float | Array
    table: Array


@dataclass(frozen=True)
class Driving:
    """p_f = amplitude · shape(t) on [begin, end] (seconds), zero outside.

    ``shape`` takes times in seconds (array) and is tabulated once on ``cells`` equal cells. It must be continuous,
    zero at both ends, and smooth inside every cell; where it is only continuous, at the edge of a cell, or would be
    stepped over, name the instant in ``stops`` (seconds): no time step straddles one. ``numbers`` can be parameters;
    those that change the shape are keys of ``remade``, which gives the driving with them.

    Raises
    ------
    ValueError: an empty span, or a shape that jumps at an end: dp_f/dt, which the Keller–Miksis equation contains,
        would be infinite there.
    """

    amplitude: float
    begin: float
    end: float
    shape: Callable[[Array], Array]
    cells: int = 512
    stops: tuple[float, ...] = ()
    numbers: tuple[PulseNumber, ...] = ()
    remade: "Callable[..., Driving] | None" = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if not self.end > self.begin:
            raise ValueError(f"the driving ends at {self.end:g} s, not after its beginning at {self.begin:g} s")
        first, last = np.abs(self.shape(np.array([self.begin, self.end])))
        if max(first, last) > _LARGEST_JUMP:
            where, jump = ("beginning", first) if first >= last else ("end", last)
            raise ValueError(f"the driving pressure jumps at its {where} by {jump:.3g} of its amplitude")

    @property
    def silent(self) -> bool:
        """True if nothing is driven."""
        return self.amplitude == 0.0

    @cached_property
    def grid(self) -> Grid:
        """In µs, the solver's unit."""
        return Grid(self.begin * 1e6, (self.end - self.begin) * 1e6 / self.cells, self.cells)

    @cached_property
    def table(self) -> Array:
        """(cells, 8) coefficients of ``shape``: six of the quintic in the cell's own coordinate, two zeros."""
        times = self.grid.within(LOBATTO)
        samples = self.shape(times.ravel() * 1e-6).reshape(times.shape)
        table = np.zeros((self.cells, 8))
        table[:, :6] = samples @ to_coefficients(LOBATTO)
        return table

    def of_members(self, values: Mapping[str, Array]) -> Clocks:
        """How members read the driving; ``values``: name → (N,) of parameters, any of which may be :attr:`numbers`."""
        rate: float | Array = 1.0
        zero = next((number.value for number in self.numbers if number.role == "delay"), 0.0)
        delay: float | Array = zero
        shapes: dict[str, Array] = {}
        for number in self.numbers:
            if (value := values.get(number.parameter.name)) is None:
                continue
            if number.role == "shape":
                shapes[number.key] = value
            elif number.role == "delay":
                delay = value
            else:
                rate = rate * (value / number.value if number.role == "rate" else number.value / value)
        clocks = Clocks(1e6 * (delay - zero / rate), rate, 0.0, self.table)
        return self._of_shapes(clocks, shapes) if shapes else clocks

    def _of_shapes(self, clocks: Clocks, shapes: Mapping[str, Array]) -> Clocks:
        """The same where members have shapes of their own: each table is stretched to the span of this one."""
        assert self.remade is not None
        different, which = np.unique(np.column_stack(list(shapes.values())), axis=0, return_inverse=True)
        each = [self.remade(**dict(zip(shapes, of, strict=True))) for of in different.tolist()]
        table = np.concatenate([replace(shape, cells=self.cells).table for shape in each])
        begin = np.array([1e6 * shape.begin for shape in each])[which]
        stretch = ((self.end - self.begin) / np.array([shape.end - shape.begin for shape in each]))[which]
        shift = clocks.shift + (begin - 1e6 * self.begin / stretch) / clocks.rate
        return Clocks(shift, clocks.rate * stretch, np.asarray(8.0 * self.cells * which), table)

    @cached_property
    def breaks(self) -> Array:
        """Instants (µs, increasing) at which a time step must end: the stops and both ends; none when silent."""
        if self.silent:
            return np.empty(0)
        inside = [1e6 * t for t in sorted(set(self.stops)) if self.begin < t < self.end]
        first, last = self.grid.span[:2]
        return np.array([first, *(t for t in inside if first < t < last), last])

    def of_each(self, t: Array, values: Mapping[str, Array]) -> Array:
        """p_f (N, K) in Pa of members at their times (N, K) in s; ``values``: name → (N,) of parameters, as above."""
        clocks = self.of_members(values)
        shift, rate, offset = (np.reshape(of, (-1, 1)) for of in clocks[:3])
        read = (t * 1e6 - shift) * rate
        span = self.grid.span
        inside = (read >= span[0]) & (read <= span[1])
        table = np.broadcast_to(offset[:, 0].astype(int) // (8 * self.cells), len(t))
        shape = evaluate(clocks.table.reshape(-1, self.cells, 8)[table], span, read)
        amplitude = np.reshape(values.get("p_A", self.amplitude), (-1, 1))
        return np.where(inside, amplitude * shape, 0.0)

    def pressure(self, t: Array) -> Array:
        """p_f in Pa at times (K,) in s, of any shape."""
        t = np.asarray(t, dtype=float)
        return np.where((t >= self.begin) & (t <= self.end), self.amplitude * self.shape(t), 0.0)


MOST_KNOTS = 24
_CELLS_PER_KNOT = 24  # a sine of the shortest wavelength to 1e-10
KNOTS = tuple(
    Parameter(
        f"pulse_knot_{k}", "1", "normal", label=f"what the pulse has more at its knot {k}, of its amplitude",
        symbol=rf"$\Delta_{{{k}}}$",
    )
    for k in range(1, MOST_KNOTS + 1)
)  # fmt: skip


def _with_sines(t: Array, driving: Driving, values: tuple[float, ...]) -> Array:
    """The shape plus the sines that have ``values`` at equally spaced knots between the ends, where they are zero."""
    order = np.arange(1, len(values) + 1)
    sines = np.sin(np.pi / (len(order) + 1) * np.outer(order, order))  # its own inverse, but for a factor
    heights = 2 / (len(order) + 1) * (sines @ np.array(values))
    phase = np.pi * (t - driving.begin) / (driving.end - driving.begin)
    return np.asarray(driving.shape(t) + np.sin(np.multiply.outer(phase, order)) @ heights)


def with_knots(driving: Driving, knots: int) -> Driving:
    """The driving as a function that is known roughly: ``pulse_knot_1``, … are further :attr:`Driving.numbers`, what
    the shape has more at so many equally spaced instants between its ends; sines go through them. A delay, rate or
    stretch moves them with the pulse. Raises ValueError: there is no driving.
    """
    if driving.silent:
        raise ValueError("knots: there is no driving that they could change; give one, or leave them out")
    cells = driving.cells * -(-_CELLS_PER_KNOT * (knots + 1) // driving.cells)
    finer = replace(driving, cells=max(cells, driving.cells))
    own = tuple(PulseNumber(of, f"knot_{k}", 0.0, "shape") for k, of in enumerate(KNOTS[:knots], 1))
    return replace(finer, numbers=(*driving.numbers, *own), remade=partial(_deviating, driving, knots))


def _deviating(driving: Driving, knots: int, **keys: Any) -> Driving:
    values = tuple(float(keys.pop(f"knot_{k}", 0.0)) for k in range(1, knots + 1))
    base = driving.remade(**keys) if keys and driving.remade else driving
    return replace(base, shape=Shape(_with_sines, (base, values)), numbers=(), remade=None)
