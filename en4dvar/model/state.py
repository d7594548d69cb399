"""Names and arrays: parameters, the layout of a state vector."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
import numpy.typing as npt

from en4dvar.plumbing.errors import retold
from en4dvar.plumbing.units import UnitError, parse_unit

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
TransformName = Literal[
    "normal", "lognormal", "logit", "uniform", "half-normal", "beta", "bounded-normal", "bounded-lognormal"
]


def floats(values: npt.ArrayLike, whose: str = "") -> Array:
    """As an array of float64: NaN where an array of :mod:`numpy.ma` is masked. Raises TypeError or ValueError for what
    is no real numbers; a TypeError that begins with ``whose`` they are, where that is said.
    """
    try:
        if np.iscomplexobj(values):
            raise TypeError("complex numbers; give real ones")
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(float), np.nan)
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        if not whose:
            raise
        raise TypeError(f"{whose}: {error}") from None


def hold_floats(whole: object, *keys: str) -> None:
    """Make the attributes ``keys`` of ``whole``, even one that is frozen, :func:`floats`. Raises TypeError, ValueError
    for what is no real numbers.
    """
    for key in keys:
        object.__setattr__(whole, key, floats(getattr(whole, key), key))


class Shown:
    """What has a unit, and a label, a symbol and a display unit to be shown with: by default its name and its unit."""

    name: str
    unit: str
    label: str
    symbol: str
    display_unit: str

    def __post_init__(self) -> None:
        for key, value in (("label", self.name), ("symbol", self.name), ("display_unit", self.unit)):
            object.__setattr__(self, key, getattr(self, key) or value)


@dataclass(frozen=True)
class Parameter(Shown):
    """A quantity that can be fixed or estimated; everything downstream derives from this declaration.

    Attributes
    ----------
    name: key in the YAML, variable in the netCDF.
    unit: unit of every stored value (SI), e.g. ``"Pa"``.
    display_unit: unit of reports and tables, e.g. ``"kPa"``.
    transform: default map to the unbounded space where the prior is Gaussian.
    bounds: physical range (inclusive limits, ±inf allowed); outside it a value is an error.
    label: what it is called in prose (``long_name`` in the netCDF).
    symbol: how it is written in a figure (matplotlib mathtext allowed).
    source: where the definition comes from.
    common: whether it has one value in all data sets of a campaign, as a constant of the medium or of the camera: its
        uncertainty then does not average out over them.
    """

    name: str
    unit: str
    transform: TransformName = "normal"
    bounds: tuple[float, float] = (-np.inf, np.inf)
    label: str = ""
    symbol: str = ""
    display_unit: str = ""
    source: str = ""
    common: bool = False

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"parameter name {self.name!r} is not an identifier")
        if not self.bounds[0] < self.bounds[1]:
            raise ValueError(f"parameter {self.name}: bounds {self.bounds}: the first must be below the second")
        with retold(UnitError, ValueError, f"parameter {self.name}: "):
            parse_unit(self.unit)
        super().__post_init__()


_positive = partial(Parameter, transform="lognormal", bounds=(0.0, np.inf))
TIME_SHIFT = Parameter(
    name="t_s",
    unit="s",
    label="time shift",
    symbol="$t_s$",
    display_unit="us",
    source="Spratt et al. (2021); the model is observed at t_k + t_s",
)
TIME_SCALE = _positive(
    name="time_scale",
    unit="1",
    label="scale of the times",
    symbol="$a$",
    source="the model is observed at this factor times t_k, plus t_s; a model's own parameter goes before it",
    common=True,
)
NOISE_SCALE = _positive(
    name="sigma",
    unit="1",
    label="noise scale",
    symbol=r"$\sigma$",
    source="multiplies the std of every observation error; a model's own parameter of this name goes before it",
)
READING_SCALE = _positive(
    name="reading_scale",
    unit="1",
    label="scale of the readings",
    symbol="$b$",
    source="the model is observed times this factor; a model's own parameter of this name goes before it",
    common=True,
)
READING_OFFSET = Parameter(
    name="reading_offset",
    unit="1",
    label="offset of the readings",
    symbol="$d$",
    source="what all readings are too large by, in the unit of the observable; a model's own parameter goes before it",
    common=True,
)
# what any model may be given beside its own parameters
OF_READINGS = TIME_SHIFT, TIME_SCALE, NOISE_SCALE, READING_SCALE, READING_OFFSET
DISCREPANCY = (
    _positive(
        name="discrepancy_amplitude",
        unit="1",
        label="amplitude of the discrepancy",
        symbol=r"$a_\delta$",
        source="standard deviation of the Gaussian process that y − m is beside its errors; in the observable's unit",
    ),
    _positive(
        name="discrepancy_length",
        unit="s",
        label="correlation time of the discrepancy",
        symbol=r"$\ell_\delta$",
        source="time over which the discrepancy forgets itself; in the model's time unit",
    ),
)


@dataclass(frozen=True)
class Field(Shown):
    """A named block of a state vector; a perturbed initial state must lie strictly inside its ``bounds``.

    ``coordinates`` (size,), or (size, D) in D dimensions, in ``coordinate_unit`` say where its components are, so that
    data may say it as well. ``label``, ``symbol`` and ``display_unit`` are as of a parameter.
    """

    name: str
    size: int = 1
    unit: str = "1"
    bounds: tuple[float, float] = (-np.inf, np.inf)
    coordinates: Array | None = field(default=None, compare=False)
    coordinate_unit: str = "1"
    label: str = ""
    symbol: str = ""
    display_unit: str = ""

    def __post_init__(self) -> None:
        if self.size < 0:
            raise ValueError(f"field {self.name}: a size of {self.size}")
        super().__post_init__()


@dataclass(frozen=True)
class StateLayout:
    """Names ↔ slices of a flat state vector.

    >>> layout = StateLayout((Field("R", unit="m"), Field("T", 3, "K")))
    >>> layout.size, layout["T"]
    (4, slice(1, 4, None))
    """

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        if not (isinstance(self.fields, tuple | list) and all(isinstance(f, Field) for f in self.fields)):
            raise ValueError(f"a state layout is of fields, StateLayout((Field('x'), …)), not of {self.fields!r}")
        names = [f.name for f in self.fields]
        if len(set(names)) != len(names):
            raise ValueError(f"duplicate names in the state layout: {names}")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Name → where the field is in a state vector."""
        edges = np.cumsum([0, *(f.size for f in self.fields)])
        return {f.name: slice(int(a), int(b)) for f, a, b in zip(self.fields, edges[:-1], edges[1:], strict=True)}

    @cached_property
    def size(self) -> int:
        """Length of a state vector, n_state."""
        return sum(f.size for f in self.fields)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the fields, in order."""
        return tuple(f.name for f in self.fields)

    def __getitem__(self, name: str) -> slice:
        return self.slices[name]

    def __iter__(self) -> Iterator[Field]:
        return iter(self.fields)

    def pack(self, values: Mapping[str, npt.ArrayLike]) -> Array:
        """Assemble a state vector (n_state,) from a mapping that names every field."""
        x = np.empty(self.size)
        for name, where in self.slices.items():
            x[where] = values[name]
        return x

    def unpack(self, x: Array) -> dict[str, Array]:
        """Views of the fields of ``x`` (…, n_state); blocks of size one lose their last axis."""
        return {name: self.part(x, name) for name in self.slices}

    def part(self, x: Array, name: str) -> Array:
        """View of one field of ``x`` (…, n_state), as in :meth:`unpack`."""
        where = self.slices[name]
        return x[..., where.start] if where.stop - where.start == 1 else x[..., where]
