"""Driving pressures in closed form, a function each, and a measured one, from a file.

:func:`pulse` makes a function a kind of ``driving:`` in YAML: its arguments are the keys, declared here with unit,
bounds and description, and the first line of its docstring says what it is. A key that is declared as :class:`Number`
can be a parameter of the model.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial, wraps
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Le

from en4dvar.inputs.formats import Format
from en4dvar.inputs.parts import Column, Layout
from en4dvar.inputs.readers import read_series
from en4dvar.model.state import Array, Parameter, TransformName
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.units import Quantity
from en4dvar_bubble.driving.base import Driving, PulseNumber, Role, Shape

if TYPE_CHECKING:
    from scipy.interpolate import BPoly, CubicSpline


@dataclass(frozen=True)
class Number:
    """Of a key: it can be a parameter, ``pulse_`` and its name, and what that does to the pulse."""

    role: Role
    symbol: str
    display_unit: str = ""


Envelope = Literal["none", "hann", "tukey"]
Pressure = Annotated[float, Quantity("Pa")]
Frequency = Annotated[float, Quantity("Hz"), Gt(0), Number("rate", "$f$", "MHz")]
Time = Annotated[float, Quantity("s")]
Instant = Annotated[Time, Number("delay", r"$\delta$", "us")]
Delay = Annotated[Instant, Ge(0)]
Width = Annotated[Time, Gt(0)]
Pulse = Callable[..., Driving]

PULSES: dict[str, Pulse] = {}

_CELLS_PER_CYCLE = 128
_WIDTHS = 7.0  # a Gaussian is cut where it has fallen to 2e-11


def pulse(kind: str) -> Callable[[Pulse], Pulse]:
    """Register a function under the name that ``driving.kind`` has in YAML."""

    def register(function: Pulse) -> Pulse:
        @wraps(function)
        def made(*positional: Any, **keys: Any) -> Driving:
            bound = signature(function).bind(*positional, **keys)
            bound.apply_defaults()
            numbers = tuple(_changeable(function, bound.arguments))
            return replace(
                function(**bound.arguments), numbers=numbers, remade=partial(_remade, kind, **bound.arguments)
            )

        PULSES[kind] = made
        return made

    return register


def _remade(kind: str, **keys: Any) -> Driving:
    """A pulse with other keys, without its numbers, which take longer to find."""
    function: Pulse = vars(PULSES[kind])["__wrapped__"]
    return function(**keys)


def numbers_of(function: Pulse) -> Iterator[tuple[str, Role, Parameter]]:
    """Key, role and parameter of the numbers that the arguments of a pulse declare."""
    for key, hint in get_type_hints(function, include_extras=True).items():
        about = getattr(hint, "__metadata__", ())
        for number in (note for note in about if isinstance(note, Number)):
            unit = next((note.unit for note in about if isinstance(note, Quantity)), "1")
            limits: dict[type, Any] = {type(note): note for note in about}
            least = limits[Gt].gt if Gt in limits else limits[Ge].ge if Ge in limits else -np.inf
            most = limits[Le].le if Le in limits else np.inf
            words, shown = f"{key} of the pulse", number.display_unit
            usual: TransformName = "normal" if least == -np.inf or number.role == "delay" else "lognormal"
            parameter = Parameter(f"pulse_{key}", unit, usual, (least, most), words, number.symbol, shown)
            yield key, number.role, parameter


def _changeable(function: Pulse, arguments: Mapping[str, Any]) -> Iterator[PulseNumber]:
    """Those of a pulse whose shape they can change. Raises :class:`ConfigError` for a value that is out of bounds."""
    for key, role, parameter in numbers_of(function):
        value, (least, most) = arguments[key], parameter.bounds
        if not least <= value <= most:
            raise ConfigError(f"{key} of the pulse must lie in [{least:g}, {most:g}] {parameter.unit}, not {value:g}")
        with suppress(ValueError):
            if role == "shape":
                function(**{**arguments, key: value + 0.01})
            yield PulseNumber(parameter, key, value, role)


@pulse("none")
def silence() -> Driving:
    """No driving: the laser-induced bubble."""
    return Driving(0.0, 0.0, 1e-6, np.zeros_like, cells=1)


def _half_cycle(t: Array, frequency: float, exponent: float, delay: float) -> Array:
    phase = 2 * np.pi * frequency * (t - delay)
    inside = np.abs(phase) < np.pi
    base = np.where(inside, 0.5 * (1 + np.cos(np.where(inside, phase, np.pi))), 0.0)
    return np.asarray(base**exponent)


@pulse("histotripsy")
def histotripsy(
    amplitude: Annotated[Pressure, "p_A; negative for rarefaction."] = -24e6,
    frequency: Annotated[Frequency, "ω/2π."] = 1e6,
    exponent: Annotated[float, Ge(1), Number("shape", "$n$"), "n."] = 3.7,
    delay: Annotated[Instant, "δ: the instant of the peak."] = 5e-6,
) -> Driving:
    """The rarefactional half cycle of a histotripsy pulse, p_A [(1 + cos ω(t−δ))/2]^n for |t−δ| ≤ π/ω.

    Amplitude and frequency are the paper's; n and δ are from the literature on this array (Vlaisavljevich et al. 2015).
    """
    half = 0.5 / frequency
    return Driving(amplitude, delay - half, delay + half, Shape(_half_cycle, (frequency, exponent, delay)))


def _burst(t: Array, frequency: float, duration: float, phase: float, delay: float, taper: float) -> Array:
    """``taper``: fraction of the duration that rises and falls; 0 no envelope, 1 Hann."""
    wave = np.sin(2 * np.pi * frequency * (t - delay) + phase)
    if taper == 0.0:
        return np.asarray(wave)
    from_edge = 0.5 - np.abs((t - delay) / duration - 0.5)
    return np.asarray(wave * 0.5 * (1 - np.cos(np.pi * np.clip(2 * from_edge / taper, 0.0, 1.0))))


@pulse("sine")
def sine_burst(
    amplitude: Annotated[Pressure, "Pressure amplitude."],
    frequency: Annotated[Frequency, "Frequency."],
    cycles: Annotated[float, Gt(0), Le(1000), Number("shape", "$N$"), "Length of the burst in periods."],
    delay: Annotated[Delay, "When the burst begins."] = 0.0,
    phase: Annotated[float, Number("shape", r"$\varphi$"), "Phase at its beginning, in radians."] = 0.0,
    envelope: Annotated[
        Envelope, "Window that the burst is multiplied by; without one the burst must begin and end at zero."
    ] = "none",
    taper: Annotated[float, Ge(0.01), Le(1), "Share of the burst that the two tapers of the Tukey window take."] = 0.5,
) -> Driving:
    """A sine burst, with or without an envelope: p_A sin(2πf(t−δ) + φ) w(t) for 0 ≤ t − δ ≤ cycles/f.

    ``envelope``: w = 1, the Hann window, or the Tukey window whose two cosine tapers together take the fraction
    ``taper`` of the burst (in steps of 0.001). Raises ValueError where the pressure would jump: without envelope the
    burst must begin and end at a zero of the sine.
    """
    duration = cycles / frequency
    fraction = {"none": 0.0, "hann": 1.0, "tukey": taper}[envelope]
    cells = max(256, int(np.ceil(_CELLS_PER_CYCLE * cycles)))
    stops = [delay + k * duration / (2 * cycles) for k in range(1, int(2 * cycles) + 1)]
    if 0.0 < fraction < 1.0:
        # The second derivative jumps where the tapers end: these instants must be edges of cells.
        edge = Fraction(round(fraction * 1000), 2000)
        cells = edge.denominator * -(-cells // edge.denominator)
        fraction = float(2 * edge)
        stops += [delay + float(edge) * duration, delay + float(1 - edge) * duration]
    shape = Shape(_burst, (frequency, duration, phase, delay, fraction))
    return Driving(amplitude, delay, delay + duration, shape, cells, tuple(stops))


def _bell(t: Array, delay: float, width: float) -> Array:
    return np.asarray(np.exp(-0.5 * ((t - delay) / width) ** 2))


@pulse("gaussian")
def gaussian(
    amplitude: Annotated[Pressure, "Peak pressure."],
    delay: Annotated[Delay, "The instant of the peak."],
    width: Annotated[Width, Number("stretch", r"$\sigma$", "us"), "Standard deviation of the pulse in time."],
) -> Driving:
    """A Gaussian pulse p_A exp(−(t−δ)²/(2σ²)) with σ = ``width``.

    It is cut at |t−δ| = 7σ, where it is 2e-11 of the amplitude.
    """
    half = _WIDTHS * width
    return Driving(amplitude, delay - half, delay + half, Shape(_bell, (delay, width)), stops=(delay,))


def _plateau(t: Array, begin: float, rise: float, duration: float) -> Array:
    s = np.clip(np.minimum(t - begin, begin + duration - t) / rise, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s * s))


@pulse("step")
def step(
    amplitude: Annotated[Pressure, "Pressure after the step."],
    duration: Annotated[Width, Number("stretch", "$T$", "us"), "How long the pressure lasts."],
    delay: Annotated[Delay, "When it begins."] = 0.0,
    rise: Annotated[Width, "Rise time."] = 20e-9,
) -> Driving:
    """A pressure p_A from ``delay`` for ``duration``: a step if that outlives the simulation, else an impulse.

    It rises within ``rise`` and falls within the same time at the end, both inside the duration, as the polynomial
    10 s³ − 15 s⁴ + 6 s⁵ (continuous curvature). A rise in no time would have an infinite dp_f/dt, which the
    Keller–Miksis equation answers with a jump of the wall velocity by −p_A/(ρc): that is the limit rise → 0. ``rise``
    is shortened a little where it does not divide the duration. Raises ValueError when duration < 3 rise or is more
    than 200 000 times longer.
    """
    cells = int(np.ceil(duration / rise * (1 - 1e-12)))
    if not 3 <= cells <= 200_000:
        raise ValueError(f"the duration {duration:g} s must be between 3 and 200 000 times the rise {rise:g} s")
    exact = duration / cells
    stops = (delay + exact, delay + duration - exact)
    return Driving(amplitude, delay, delay + duration, Shape(_plateau, (delay, exact, duration)), cells, stops)


_MOST_CELLS = 200_000
_DELAY = Parameter("pulse_delay", "s", label="delay of the pulse", symbol=r"$\delta$", display_unit="us")
_STRETCH = Parameter(
    "pulse_stretch", "1", "lognormal", (0.0, np.inf), "time scale of the pulse over that of its record", "$s$"
)
OF_RECORD = (PulseNumber(_DELAY, "delay", 0.0, "delay"), PulseNumber(_STRETCH, "", 1.0, "stretch"))
"""What can be a parameter of a record: its times are stretched about their zero, and then delayed."""
_PROMINENCE = 0.02  # of the largest |p|: turning points that no time step may straddle


def _record(t: Array, spline: "CubicSpline", before: "BPoly", after: "BPoly") -> Array:
    """Cubic spline through the samples, led from and to zero by one quintic at either end."""
    parts = [part(np.clip(t, part.x[0], part.x[-1])) for part in (before, spline, after)]
    return np.asarray(np.where(t < spline.x[0], parts[0], np.where(t > spline.x[-1], parts[2], parts[1])))


def tabulated(times: Array, pressure: Array, delay: float = 0.0, scale: float = 1.0) -> Driving:
    """p_f through samples (K,) at increasing ``times`` (s), shifted by ``delay`` and multiplied by ``scale``.

    Interpolation is the cubic spline with continuous curvature (not-a-knot). Outside the record p_f is zero: over one
    sampling interval before the first and after the last sample a quintic leads there smoothly. Raises ValueError for
    fewer than four samples, times that do not increase, values that are not finite, a record of zeros, or sampling so
    uneven that it would take more than 200 000 cells.
    """
    t = np.asarray(times, dtype=float) + delay
    p = np.asarray(pressure, dtype=float) * scale
    if t.ndim != 1 or t.shape != p.shape or len(t) < 4:
        raise ValueError("a tabulated driving needs at least four samples, one pressure for each time")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(p)) and np.all(np.diff(t) > 0)):
        raise ValueError("a tabulated driving needs finite pressures at finite, increasing times")
    largest = float(np.abs(p).max())
    if largest == 0.0:
        raise ValueError("the tabulated pressure is zero throughout; write kind: none")
    span, gaps = t[-1] - t[0], np.diff(t)
    even = span / (len(t) - 1)
    # On a uniform grid the knots are edges of cells and the table is exact; otherwise four cells for the shortest gap.
    uniform = bool(np.all(np.abs(t - (t[0] + even * np.arange(len(t)))) < 1e-3 * even))
    if uniform:
        t, lead, inner = t[0] + even * np.arange(len(t)), even, len(t) - 1
    else:
        inner = int(np.ceil(4 * span / gaps.min()))
        lead = span / inner
    if inner + 2 > _MOST_CELLS:
        raise ValueError(f"{inner + 2} cells for {len(t)} samples, more than {_MOST_CELLS}: resample the record evenly")
    from scipy.interpolate import BPoly, CubicSpline  # half a second at the start of every worker that needs neither
    from scipy.signal import find_peaks

    peaks = np.concatenate([find_peaks(sign * p, prominence=_PROMINENCE * largest)[0] for sign in (1, -1)])
    spline, zero = CubicSpline(t, p / largest), np.zeros(3)  # with its derivatives
    first, last = (np.array([spline(at, order) for order in range(3)]) for at in t[[0, -1]])
    before = BPoly.from_derivatives([t[0] - lead, t[0]], [zero, first])
    shape = Shape(_record, (spline, before, BPoly.from_derivatives([t[-1], t[-1] + lead], [last, zero])))
    stops = (float(t[0]), *(float(t[i]) for i in peaks), float(t[-1]))
    numbers = tuple(replace(number, value=delay) if number.role == "delay" else number for number in OF_RECORD)
    return Driving(largest, float(t[0] - lead), float(t[-1] + lead), shape, inner + 2, stops, numbers)


def from_file(
    path: Path,
    time: tuple[str, str],
    pressure: tuple[str, str],
    delay: float = 0.0,
    scale: float = 1.0,
    format: Format | None = None,
) -> Driving:
    """:func:`tabulated` from a CSV or ``.mat`` file; ``time`` and ``pressure`` are (column, unit).

    Raises :class:`~en4dvar.plumbing.errors.DataError` for a file that cannot be read, ValueError as :func:`tabulated`.
    """
    series = read_series(path, Column(*time, "s"), Column(*pressure, "Pa"), Layout(format))
    with retold(ValueError, ValueError, f"{path}: "):
        return tabulated(series.times, series.values, delay, scale)
