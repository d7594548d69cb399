"""The ``design:`` section: which experiments are compared, about what, and how accurately."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import product
from math import prod
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from en4dvar.config.context import Context, Made, quantity, time_unit
from en4dvar.config.schema import QuantityText, Section, section_of
from en4dvar.config.times import Times, read_times
from en4dvar.config.validate import Faults
from en4dvar.design.evaluate import SampleSizes
from en4dvar.state import Array

MOST = 2000  # designs
Value = QuantityText | bool


class Knob(Section):
    """What the experimenter can turn: a key of this file, and the values that are tried."""

    key: Annotated[str, Field(pattern=r"^[\w-]+(\.[\w-]+)*$")]
    """The key, its sections before it: ``model.pulse.amplitude``, ``design.times.step``, ``data.error.radius_std``."""
    values: Annotated[tuple[Value, ...], Field(min_length=1)]
    """The values, as they would stand in the file."""


class Choice(Section):
    """The most informative few of the readings at ``times``."""

    readings: Annotated[int, Field(ge=1)]
    """How many readings are taken."""
    apart: Annotated[float, quantity(time_unit, "not negative")] = 0.0
    """Least time between two of them, e.g. 2 us."""


class Price(Section):
    """What an experiment costs, in any unit."""

    reading: Annotated[float, Field(ge=0)] = 1.0
    """Of a reading."""
    experiment: Annotated[float, Field(ge=0)] = 0.0
    """Of an experiment, beside its readings."""


_SampleSizes: Any = section_of(SampleSizes)


class Design(_SampleSizes):
    """Which experiments ``en4dvar design`` compares, and about what."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    about: tuple[str, ...] = ()
    """Parameters that are asked for; the others are uncertain all the same. Default: all that have a prior."""
    times: Annotated[Array | None, Made(read_times, Times)] = None
    """When readings are taken, on the model's clock; default: ``simulate.times``, else those of the data file."""
    knobs: dict[str, Knob] = Field({})
    """Name → a key of this file and the values that are tried; every combination is a design."""
    choose: Choice | None = None
    """Take only the most informative readings."""
    experiments: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1,)
    """How many experiments alike are made, e.g. bubbles of one gel: they share what is asked for."""
    price: Price = Price()
    """What an experiment costs: information is compared with it."""
    method: Literal["auto", "linear", "laplace", "nested"] = "auto"
    """linear: at the prior mean; laplace: linearised over the prior; nested: simulated readings, each explained anew;
    auto: laplace, checked by nested on the first and the best designs and replaced by it where they disagree."""

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        knobs = given.get("knobs")
        if not isinstance(knobs, dict):
            return
        sizes = [len(k["values"]) for k in knobs.values() if isinstance(k, dict) and isinstance(k.get("values"), list)]
        if prod(sizes) > MOST:
            faults.add(("knobs",), f"{prod(sizes)} combinations; at most {MOST}", at_key=True)

    @property
    def sizes(self) -> SampleSizes:
        """How many runs."""
        return SampleSizes(**{field.name: getattr(self, field.name) for field in fields(SampleSizes)})

    def settings(self) -> Iterator[dict[str, Value]]:
        """Name of the knob → value, of every combination."""
        for values in product(*(knob.values for knob in self.knobs.values())):
            yield dict(zip(self.knobs, values, strict=True))
