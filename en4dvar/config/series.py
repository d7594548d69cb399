"""The ``data:`` section of several series, and what both kinds of it come to: a plan of the series of a data set."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, Discriminator, Field, Tag, WithJsonSchema

from en4dvar.config.context import Context, Made
from en4dvar.config.data import Data
from en4dvar.config.schema import Section
from en4dvar.config.validate import Faults, Place
from en4dvar.model.forward import Observable
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown, suggest

RESERVED = ("time", "path_time", "reading", "parameter", "chain", "draw", "correlation", "mode", "active", "dfs")
EACH = {"type": "object", "minProperties": 1, "additionalProperties": {"x-definition": "series"}}
Correlation = Annotated[float, Field(gt=-1, lt=1)]


class SeriesData(Data):
    """One series: where its readings are, and what they are of."""

    observable: str | None = None
    """Name of the observable that was read; default: the name of the series."""
    group: Annotated[str | None, Field(min_length=1)] = None
    """Series of one group count as one when weights are ``balanced``; default: each by itself."""


@dataclass(frozen=True)
class SeriesPlan:
    """How one series is read."""

    name: str
    observable: Observable
    data: Data
    group: str = ""


@dataclass(frozen=True)
class DataPlan:
    """How a data set is read: its series, and the correlation of the errors of two of them at equal times."""

    series: tuple[SeriesPlan, ...]
    correlation: Mapping[tuple[str, str], float]

    @classmethod
    def of(cls, data: "Data | DataPlan", observable: Observable) -> "DataPlan":
        """The plan of either kind of section; ``observable`` is that of a single series."""
        return data if isinstance(data, DataPlan) else cls((SeriesPlan(observable.name, observable, data),), {})

    @property
    def alone(self) -> bool:
        """True if there is one series."""
        return len(self.series) == 1

    def as_written(self, source: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was written, each series complete, with absolute paths."""
        common, written = _common(source), dict[str, Any]()
        for series in self.series:
            section = series.data.as_written(_merged(common, source["series"][series.name]))
            written[series.name] = {key: value for key, value in section.items() if value is not None and key != "name"}
        rest = {key: source[key] for key in ("name", "correlation") if source.get(key)}
        return {"series": written, **rest}


class DataOfSeries(Section):
    """Several series that are assimilated together, each with its own file, times, units, errors and weights.

    Every other key of ``data:`` holds for all series that do not say otherwise, for instance the path of a file that
    has a column of each.
    """

    model_config = ConfigDict(extra="allow")

    series: Annotated[dict[str, Any], Field(min_length=1), WithJsonSchema(EACH)]
    """Name of the series → what ``data:`` says of a single one; the name is that of its observable, unless it says
    ``observable``."""
    correlation: dict[str, dict[str, Correlation]] | None = None
    """Correlation of the errors of two series at equal times: ``prey: {predator: 0.5}``."""


def _common(keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if key not in ("series", "correlation")}


def _merged(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a series over those that hold for all; sections are merged key by key."""
    return {
        **common,
        **{
            key: {**common[key], **value} if isinstance(value, dict) and isinstance(common.get(key), dict) else value
            for key, value in own.items()
        },
    }


def _plan(section: DataOfSeries, context: Context) -> DataPlan:
    keys = {"series": section.series, **(section.model_extra or {})}
    common, plans = _common(keys), dict[str, SeriesPlan]()
    with Faults() as faults:
        for name, own in section.series.items():
            if not isinstance(own, dict):
                faults.add(("series", name), "expected 'key: value' lines")
                continue

            if "name" in own:
                words = "a data set has one name; write it above the series"
                faults.add(("series", name, "name"), words, at_key=True)
                continue
            if fault := _name_fault(name, {**common, **own}, context):
                faults.add(("series", name), fault, at_key=True)
                continue

            def place(where: Place, name: str = name, own: dict[str, Any] = own) -> Place:
                return ("series", name, *where) if _has(own, where) or not _has(common, where) else where

            with faults.at(schema=SeriesData, place=place):
                plans[name] = _series(name, _merged(common, own), context)
                if plans[name].data.error is not None and plans[name].data.error.discrepancy is not None:
                    words = "a discrepancy is that of a single series; leave it out, or estimate this series by itself"
                    raise ConfigError(words, "error.discrepancy")
        for name, others in (section.correlation or {}).items():
            for other in others:
                _check_pair(name, other, section, faults)
    context.observed = None
    pairs = {(a, b): value for a, others in (section.correlation or {}).items() for b, value in others.items()}
    return DataPlan(tuple(plans.values()), pairs)


def _has(keys: Any, where: Place) -> bool:
    """True if the section says something at a place, or above it."""
    return (
        bool(where)
        and isinstance(keys, dict)
        and where[0] in keys
        and (len(where) == 1 or not isinstance(keys[where[0]], dict) or _has(keys[where[0]], where[1:]))
    )


def _name_fault(name: str, keys: Mapping[str, Any], context: Context) -> str:
    """The fault of a series' name, after which variables of the result are called; "" where there is none."""
    if not name.isidentifier() or name in RESERVED:
        return f"{shown(name)} cannot be the name of a series; use letters, digits and _, as in well_3"
    known = [observable.name for observable in context.units.observables]
    if "observable" in keys or name in known:
        return ""
    return f"unknown observable {shown(name)}{suggest(name, known)}; of another name, it has to say observable: NAME"


def _series(name: str, keys: dict[str, Any], context: Context) -> SeriesPlan:
    known = {observable.name: observable for observable in context.units.observables}
    chosen = str(keys.get("observable", name))
    if chosen not in known:
        raise ConfigError(f"unknown observable {shown(str(chosen))}{suggest(str(chosen), known)}", "observable")
    context.observed = known[chosen]
    data = SeriesData.model_validate(keys, context=context)
    return SeriesPlan(name, known[chosen], data, data.group or name)


def _check_pair(name: str, other: str, section: DataOfSeries, faults: Faults) -> None:
    if name not in section.series:
        faults.add(("correlation", name), f"no series {shown(name)}{suggest(name, section.series)}", at_key=True)
    elif other not in section.series or other == name:
        others = [candidate for candidate in section.series if candidate != name]
        message = f"no other series {shown(other)}{suggest(other, others)}"
        faults.add(("correlation", name, other), message, at_key=True)
    elif name in ((section.correlation or {}).get(other) or {}) and name > other:
        faults.add(("correlation", name, other), f"given as {other}: {{{name}: …}} as well", at_key=True)


def _kind(written: Any) -> str:
    several = (isinstance(written, dict) and "series" in written) or isinstance(written, DataPlan)
    return "of several series" if several else "of one series"


DATA = Annotated[
    Annotated[Data, Tag("of one series")] | Annotated[DataPlan, Made(_plan, DataOfSeries), Tag("of several series")],
    Discriminator(_kind),
]
