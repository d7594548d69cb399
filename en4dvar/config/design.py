"""Instants of planned readings; the ``design:`` section: which experiments are compared, about what, how accurately."""

from collections.abc import Mapping
from math import prod
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from en4dvar.config.context import Context, Faults, Made
from en4dvar.config.quantities import quantity, time_unit
from en4dvar.config.schema import QuantityText, Section
from en4dvar.estimation.design.evaluate import SampleSizes
from en4dvar.model.state import Array
from en4dvar.plumbing.units import UnitError, parse_quantity

MOST = 2000  # designs
Value = QuantityText | bool
OF_A_LAW = ("model", "parameters", "prior", "prior_correlation")


def time_grid(start: str | float, end: str | float, step: str | float, unit: str) -> Array:
    """Instants (K,) from ``start`` to ``end``, both included. Raises :class:`UnitError`."""
    first = 0.0 if start == "start" else parse_quantity(start, unit)
    last, width = parse_quantity(end, unit), parse_quantity(step, unit)
    if not width > 0 or not last > first:
        raise UnitError(f"no instants from {first:g} to {last:g} {unit} in steps of {width:g} {unit}")
    steps = (last - first) / width * (1 + 1e-9)
    if not 2 <= steps < 1_000_000:
        raise UnitError(f"{steps:.6g} steps; give between 2 and a million")
    return np.asarray(first + width * np.arange(int(np.floor(steps)) + 1), dtype=float)


class Later(Section):
    """Instants at another rate."""

    end: Annotated[QuantityText, Field(alias="to")]
    """Last instant with its unit."""
    step: QuantityText
    """Time step with its unit."""


class Times(Section):
    """Instants at one rate or at two, one after the other; both ends are included."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    """First instant with its unit; start is time zero."""
    end: Annotated[QuantityText, Field(alias="to")]
    """Last instant with its unit."""
    step: QuantityText
    """Time step with its unit."""
    then: Later | None = None
    """Another rate, of a camera that changes it: after ``to``."""


def read_times(times: Times, context: Context) -> Array:
    """The instants (K,)."""
    first = time_grid(times.start, times.end, times.step, time_unit(context))
    if times.then is None:
        return first
    later = time_grid(times.end, times.then.end, times.then.step, time_unit(context))
    return np.concatenate([first, later[later > first[-1] + 0.5 * (later[1] - later[0])]])


class Knob(Section):
    """A knob that the experimenter can turn: a key of this file, and the values that are tried."""

    key: Annotated[str, Field(pattern=r"^[\w-]+(\.[\w-]+)*$")]
    """The key, its sections before it: ``model.pulse.amplitude``, ``design.times.step``, ``data.error.radius_std``."""
    values: Annotated[tuple[Value, ...], Field(min_length=1)]
    """The values, as they would stand in the file."""


class Choice(Section):
    """The most informative few of the readings at ``times``."""

    readings: Annotated[int, Field(ge=1)]
    """How many readings are taken."""
    apart: Annotated[float, quantity(time_unit, "not negative")] = 0.0
    """Least time between two chosen readings, e.g. 2 us."""


class Price(Section):
    """What an experiment costs, in any unit: information is compared with it."""

    reading: Annotated[float, Field(ge=0)] = 1.0
    """Of a reading."""
    experiment: Annotated[float, Field(ge=0)] = 0.0
    """Of an experiment, beside its readings."""

    def of(self, experiments: int, readings: int) -> float:
        """The price of so many experiments of so many readings each."""
        return experiments * (self.experiment + self.reading * readings)


class Within(Section):
    """Limits that a design must keep to; one that does not is left out, and named."""

    readings: Annotated[int, Field(ge=1)] | None = None
    """Largest number of readings of an experiment: the frames that the camera can hold."""
    price: Annotated[float, Field(ge=0)] | None = None
    """Largest price of a design."""
    beyond: Annotated[float, Field(ge=0, le=1)] | None = None
    """Largest share of the prior for which the model may leave a limit of its validity."""

    def broken(self, readings: int, price: float, beyond: float) -> str:
        """The limits that a design exceeds, in words; empty where it keeps to all."""
        told = (
            ("readings", readings, f"{readings} readings"),
            ("price", price, f"a price of {price:g}"),
            ("beyond", beyond, f"{100 * beyond:.0f} % of the prior leaves what the model is valid for"),
        )
        limits = ((key, getattr(self, key), value, text) for key, value, text in told)
        over = ((key, most, text) for key, most, value, text in limits if most is not None and value > most)
        return "; ".join(f"{text}: more than design.within.{key} = {most:g}" for key, most, text in over)


class Design(Section, SampleSizes):
    """Which experiments ``en4dvar design`` compares, and about what."""

    about: tuple[str, ...] = ()
    """Parameters that are asked for; the others stay uncertain. Default: all that have a prior."""
    common: tuple[str, ...] = ()
    """Others that equal experiments and the run of ``--after`` share as well: the scale of one camera, the density."""
    wanted: dict[str, QuantityText] = Field({})
    """Parameter asked for → what it is to be known to, one standard deviation (5 %, or in its unit): what each other
    parameter must be known to for it is told."""
    times: Annotated[Array | None, Made(read_times, Times)] = None
    """When readings are taken, on the model's clock; default: ``simulate.times``, else those of the data file."""
    knobs: dict[str, Knob] = Field({})
    """Name → a key of this file and the values that are tried; every combination is a design."""
    choose: Choice | None = None
    experiments: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1,)
    """How many equal experiments are made, of one sample; they share the parameters asked for."""
    price: Price = Price()
    within: Within = Within()
    enough: Annotated[float, Field(ge=0)] = 0.1
    """Information in nats below which no experiment is worth making; a message says if the best design tells less."""
    laws: dict[str, dict[str, Any]] = Field({})
    """Which law holds? Name → keys of this file and values, e.g. ``{model.law: ...}``; ``{}`` is the file itself."""
    method: Literal["auto", "linear", "laplace", "nested"] = "auto"
    """linear: at the prior mean; laplace: linearised over the prior; nested: simulated readings, each explained anew;
    auto: laplace, checked by nested on the first and the best designs and replaced by it where they disagree; a check
    costs a hundred times as many forward runs and ends once it is known to rest on too few effective draws."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        laws = keys.get("laws")
        if isinstance(laws, dict) and laws:
            _check_laws(laws, faults)
            if keys.get("experiments", [1]) != [1]:
                faults.add(("experiments",), "not with laws: which law holds is asked of one experiment", at_key=True)
        knobs = keys.get("knobs")
        if not isinstance(knobs, dict):
            return
        sizes = [len(k["values"]) for k in knobs.values() if isinstance(k, dict) and isinstance(k.get("values"), list)]
        if prod(sizes) > MOST:
            faults.add(("knobs",), f"{prod(sizes)} combinations; at most {MOST}", at_key=True)


def _check_laws(laws: Mapping[str, Any], faults: Faults) -> None:
    if len(laws) < 2:
        faults.add(("laws",), "one law has nothing to be told from; give two or more", at_key=True)
    for name, keys in laws.items():
        for key in keys if isinstance(keys, dict) else ():
            if str(key).split(".")[0] not in OF_A_LAW:
                message = f"laws share the experiment; they differ in keys of {', '.join(OF_A_LAW)}"
                faults.add(("laws", name, key), message, at_key=True)
