"""A synthetic campaign from YAML: the file has a ``campaign:`` section where others have ``data:``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.models import read_model
from en4dvar.config.parameters import Fixed, Uncertain, read_parameters
from en4dvar.config.schema import QuantityText, Section
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, Fault
from en4dvar.forward import ForwardModel, Observable
from en4dvar.prior import PriorTerm
from en4dvar.units import UnitError, parse_quantity


class Group(Section):
    """Data sets of one kind: how many, and what their parameters are drawn from."""

    datasets: Annotated[int, Field(ge=1, le=999)]
    """How many data sets."""
    parameters: dict[str, Any]
    """What their truths are drawn from: a prior (drawn for each) or a quantity (common to all)."""


class Campaign(Section):
    """How the truths are observed. Pairs are the ends of uniform distributions."""

    directory: Annotated[str, Field(min_length=1)]
    """Folder of the data files, relative to the configuration's."""
    first: tuple[QuantityText, QuantityText]
    """Instant of the first reading."""
    spacing: tuple[QuantityText, QuantityText]
    """Time between two readings."""
    stop: Annotated[float, Field(gt=0, lt=1)]
    """Readings end with the first one below this times the largest so far."""
    most: Annotated[int, Field(ge=3, le=100_000)] = 60
    """Largest number of readings."""
    fewest: Annotated[int, Field(ge=3)] = 5
    """Data sets with fewer readings are drawn again."""
    noise: QuantityText
    """Std of the error of a reading, in the observable's unit."""
    time_shift: tuple[QuantityText, QuantityText] = (0, 0)
    """t_s: a reading told at t was taken at t + t_s."""
    groups: Annotated[dict[schema.Name, Group], Field(min_length=1)]
    """Data sets of one kind, by name."""


class CampaignSchema(Section):
    """The whole file; ``model`` is as for an estimation."""

    name: schema.Name
    """Name of the campaign."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of truths and readings."""
    model: dict[str, Any]
    """The forward model: its ``name`` (see ``en4dvar models``) and its settings."""
    campaign: dict[str, Any]
    """How truths are drawn and observed."""


@dataclass(frozen=True)
class GroupPlan:
    """``terms`` are drawn for each data set, ``fixed`` are common to all."""

    name: str
    datasets: int
    terms: tuple[PriorTerm, ...]
    fixed: Mapping[str, float]


@dataclass(frozen=True)
class CampaignPlan:
    """A validated campaign, in the model's units; ``directory`` is where its files go."""

    name: str
    seed: int
    model: ForwardModel
    observable: Observable
    directory: Path
    first: tuple[float, float]
    spacing: tuple[float, float]
    stop: float
    most: int
    fewest: int
    noise: float
    time_shift: tuple[float, float]
    groups: tuple[GroupPlan, ...]


def resolve_campaign(document: Document, base: Path) -> CampaignPlan:
    """Validate a document with a ``campaign:`` section. Raises :class:`ConfigError`, every fault at once."""
    faults: list[Fault] = []
    data = document.data
    top = check(CampaignSchema, data, (), document, faults)
    found = read_model(data["model"], base, document, faults) if isinstance(data.get("model"), dict) else None
    section = data.get("campaign")
    if section is None:
        faults.append(document.fault((), "required: campaign:, what is to be drawn"))
    campaign = None if section is None else check(Campaign, section, ("campaign",), document, faults)
    if top is None or found is None or campaign is None:
        raise ConfigError(faults)
    model, observable = found[0], found[0].observables[0]
    groups = tuple(_group(name, group, model, document, faults) for name, group in campaign.groups.items())
    below = Path(os.path.abspath(base))  # a link may lead elsewhere, the configuration may not
    if below not in Path(os.path.abspath(base / campaign.directory)).parents:
        faults.append(document.fault(("campaign", "directory"), f"must be a folder below {below}"))
    unit = model.time_unit
    first = _interval(campaign.first, "first", unit, document, faults)
    spacing = _interval(campaign.spacing, "spacing", unit, document, faults)
    shift = _interval(campaign.time_shift, "time_shift", unit, document, faults)
    noise, _ = _interval((campaign.noise, campaign.noise), "noise", observable.unit, document, faults)
    for name, smallest, least in (("spacing", spacing[0], 0.0), ("noise", noise, 0.0)):
        if not smallest > least and not faults:
            faults.append(document.fault(("campaign", name), "must be positive"))
    if first[0] + shift[0] < 0 and not faults:
        faults.append(document.fault(("campaign", "first"), "the first reading could be taken before time zero"))
    if faults:
        raise ConfigError(faults)
    return CampaignPlan(
        name=top.name,
        seed=top.seed,
        model=model,
        observable=observable,
        directory=base / campaign.directory,
        first=first,
        spacing=spacing,
        stop=campaign.stop,
        most=campaign.most,
        fewest=campaign.fewest,
        noise=noise,
        time_shift=shift,
        groups=groups,
    )


def _group(name: str, group: Group, model: ForwardModel, document: Document, faults: list[Fault]) -> GroupPlan:
    where = ("campaign", "groups", name)
    mine: list[Fault] = []
    entries = read_parameters(group.parameters, model, document, mine)
    inner = [document.fault((*where, *fault.path.split(".")), fault.message) for fault in mine]
    inner += [
        document.fault((*where, "parameters", e.parameter.name), "a campaign has no data file to take a value from")
        for e in entries
        if e.needs_data
    ]
    faults += inner
    terms = tuple(e.term() for e in entries if isinstance(e, Uncertain)) if not inner else ()
    return GroupPlan(name, group.datasets, terms, {e.parameter.name: e.value for e in entries if isinstance(e, Fixed)})


def _interval(
    pair: tuple[QuantityText, QuantityText], name: str, unit: str, document: Document, faults: list[Fault]
) -> tuple[float, float]:
    try:
        low, high = (0.0 if end == 0 else parse_quantity(end, unit) for end in pair)
    except UnitError as error:
        faults.append(document.fault(("campaign", name), str(error)))
        return 0.0, 0.0
    if low > high:
        faults.append(document.fault(("campaign", name), f"{pair[0]} is larger than {pair[1]}"))
    return low, high


def relocated(plan: CampaignPlan, directory: Path) -> CampaignPlan:
    """The same campaign written to another directory."""
    return replace(plan, directory=directory)
