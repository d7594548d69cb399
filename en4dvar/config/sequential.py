"""How a series is assimilated, of a twin experiment and of data: scheme, inflation, localisation, model error."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from en4dvar.config.context import TEXT, Context, Faults, Made, read_each
from en4dvar.config.quantities import SPREAD, quantity, subject_unit
from en4dvar.config.schema import OfScheme, Section, keys_of_schemes, listed, or_in_a_file
from en4dvar.config.varies import ErrorOf, Knots, dynamic_fields
from en4dvar.model.forward import ForwardModel, field_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes import ON_A_SERIES
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.settings import EnKS, EnRTS, Inflation, SequentialSettings
from en4dvar.series.start import EnsembleCoordinates

PLAIN = EnsembleCoordinates()
STD = quantity(subject_unit, "positive", error=True)


def stds(known: Callable[[ForwardModel], Mapping[str, Any]], relative: bool = False) -> Made:
    """Standard deviations by the names of what is ``known``, at least one; ``relative``: any number, some in %."""
    read_one: Callable[[Any, Context], Any] = (SPREAD if relative else STD).make
    fewest = 0 if relative else 1

    def read(section: Mapping[str, Any], context: Context) -> dict[str, Any]:
        things = known(context.model)
        with Faults() as faults:
            if len(section) < fewest:
                faults.add((), f"give at least one of: {', '.join(things)}")
            return read_each(section, things, context, faults, read_one)

    json = {"type": "object", **({"minProperties": fewest} if fewest else {}), "additionalProperties": TEXT}
    return Made(read, dict[str, Any], json)


class SeriesLocalisation(Section):
    """Gaspari–Cohn taper over the indices of the observed field; it vanishes from ``2 radius`` on. For parameters an
    observation has its mean weight over the field."""

    radius: Annotated[float, Field(gt=0)]
    """Radius of the taper, in indices: an observation has no influence from twice this distance on."""
    periodic: bool = False
    """The field is a circle: the last index is next to the first."""
    block_size: Annotated[int, Field(ge=1)] = 1
    """Neighbouring indices that share one analysis."""
    shape: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] | None = None
    """Cells along each axis of a field in two or three dimensions, the last running fastest; distances are then in
    cells of this grid. Default: the indices lie on a line."""

    def check_values(self, faults: Faults) -> None:
        if self.shape and self.block_size > 1:
            raise ValueError("block_size: only without shape")


class Smoothing(Section):
    """A smoother behind a filter: the states of earlier cycles given later observations; the filter is as without. Not
    with localisation."""

    method: Literal["enks", "enrts"]
    """enks: the weights of each analysis act on the cycles before it. enrts: one pass back from the end of the series,
    which keeps every ensemble until then."""
    lag: Annotated[int, Field(ge=1)] = 10
    """enks: cycles that an observation acts back on."""

    def check_values(self, faults: Faults) -> None:
        if self.method == "enrts" and "lag" in self.model_fields_set:
            raise ValueError("lag: only with method enks; enrts smooths by all later observations")

    @property
    def made(self) -> EnKS | EnRTS:
        """The smoother."""
        return EnKS(self.lag) if self.method == "enks" else EnRTS()

    def as_written(self, section: Mapping[str, Any]) -> dict[str, Any]:
        """As given, without what the method does not take."""
        written = super().as_written(section)
        return {key: value for key, value in written.items() if self.method == "enks" or key != "lag"}


if TYPE_CHECKING:
    OnASeries = str
else:
    OnASeries = Literal[tuple(ON_A_SERIES)]


class _Scheme(OfScheme):
    scheme: Annotated[OnASeries, Field(description=listed(ON_A_SERIES), json_schema_extra=or_in_a_file)]
    members: Annotated[int, Field(ge=3, le=100_000)]
    """Ensemble size N."""


if TYPE_CHECKING:
    _OnASeries = _Scheme
else:
    _OnASeries = keys_of_schemes(ON_A_SERIES, base=_Scheme)


class Sequential(_OnASeries):
    """The scheme and what it does to the ensemble."""

    inflation: Annotated[float, Field(gt=0)] = 1.0
    """Factor on the anomalies after each analysis, beside a localisation of the field alone; 1 is none."""
    rtps: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Relaxation to the prior spread, of what is inflated, 0 (none) to 1."""
    rotation: bool = False
    """Rotate the ensemble at random after each analysis, mean and covariance kept."""
    additive: Literal["drawn", "square-root"] = "drawn"
    """How a model error enters the ensemble of a filter: drawn, or by a square root in the space of the ensemble (not
    with smoother enks), which takes more members than variables of the state."""
    localisation: SeriesLocalisation | None = None
    smoother: Smoothing | None = None
    stochastic_model: bool = False
    """true: accept a model that gives other numbers when a member is run again; by default that is an error."""

    def check_values(self, faults: Faults) -> None:
        if type(self).unread({key: getattr(self, key) for key in self.model_fields_set}):
            return  # told already
        # settings that do not go together are told here, in their place
        anywhere = BlockLocalisation((), np.empty((0, 0))) if self.localisation else None
        self.built(anywhere, np.zeros(1))
        with faults.at("additive"):
            self.built(anywhere, np.ones(1))

    def built(
        self, localisation: BlockLocalisation | None, rate: Array, coordinates: EnsembleCoordinates = PLAIN
    ) -> SequentialSettings:
        """What the loop needs; ``rate`` (n,) is the model error's variance per unit of time. Raises ValueError where
        keys do not suit each other.
        """
        return SequentialSettings(
            ON_A_SERIES[self.scheme](**self.own),
            Inflation(self.inflation, self.rtps),
            self.rotation,
            localisation,
            stochastic_model=self.stochastic_model,
            innovations=True,
            model_error=ModelError(rate, self.additive) if np.any(rate) else None,
            coordinates=coordinates,
            smoother=self.smoother.made if self.smoother else None,
        )


class Workers(Section):
    """Where members are integrated; never changes the numbers. A cycle is short: one worker is the default."""

    workers: Annotated[int, Field(ge=1)] = 1
    """Parallel workers."""
    checkpoint_every: Annotated[float, Field(ge=0)] = 2.0
    """Seconds between two checkpoints, 0: one after every cycle. Each holds the moments of all cycles done."""


def error_rates(model: ForwardModel, errors: Sequence[ErrorOf], positive: Collection[str] = ()) -> Array:
    """Variance (n_state,) per unit of time of the model error, in the ensemble's coordinates. ``positive``: fields
    whose coordinate is their logarithm. Raises :class:`ConfigError`, its path the faulty key.
    """
    rate = np.zeros(model.layout.size)
    for error in errors:
        name, std = error.field.name, error.spec.std
        if std.relative != (name in positive):
            other = "in %, for it is positive" if name in positive else "in its unit, or its initial_std in % as well"
            raise ConfigError(f"give the std of {name} {other}", f"model_error.{name}.std")
        rate[model.layout[name]] = per_time(error.spec, std.value, f"model_error.{name}")
    return rate


def per_time(spec: Knots, std: float, path: str) -> float:
    """Variance per unit of time. Raises :class:`ConfigError`."""
    if spec.every is None:
        words = "give every, the time in which the model error reaches std: in a series it grows with time"
        raise ConfigError(words, path)
    try:
        return std**2 / spec.every
    except OverflowError:
        raise ConfigError("too large: its square is not a number", f"{path}.std") from None


def localisation_of(
    settings: SeriesLocalisation, model: ForwardModel, observed: Set[str], cells: Array | None = None
) -> BlockLocalisation:
    """Positions are indices of the one observed field, which fills the state but for the parameters. ``cells`` (p,) are
    the indices of the observations, by default all. Raises :class:`ConfigError`.
    """
    fields = list(dynamic_fields(model).values())
    words = "needs a model whose state is one field, and this field observed"
    if len(fields) != 1:
        raise ConfigError(words)
    read = [field_of(model, observable) for observable in model.observables if observable.name in observed]
    if [field and field.name for field in read] != [fields[0].name]:
        raise ConfigError(f"{words} as it is, by StateField({fields[0].name!r}), and nothing else")
    (field,) = fields
    where = np.arange(model.layout.size)[model.layout[field.name]]
    if settings.shape:
        if math.prod(settings.shape) != field.size:
            grid_cells = " x ".join(map(str, settings.shape))
            raise ConfigError(f"{grid_cells} cells, but {field.name} has {field.size}", "shape")
        local = BlockLocalisation.on_grid(where, settings.shape, settings.radius, settings.periodic)
        if cells is not None:
            local = replace(local, taper=local.taper[:, np.rint(cells).astype(int)])
    else:
        positions = np.arange(field.size, dtype=float)
        state = np.full(model.layout.size, np.nan)
        state[where] = positions
        period = float(field.size) if settings.periodic else None
        at = positions if cells is None else cells
        local = BlockLocalisation.on_line(state, at, settings.radius, period, settings.block_size)
    rest = np.setdiff1d(np.arange(model.layout.size), where)
    return local.with_placeless(rest) if rest.size else local
