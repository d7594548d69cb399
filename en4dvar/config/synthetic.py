"""A synthetic campaign from YAML: the file has a ``campaign:`` section where others have ``data:``."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from en4dvar.config.context import Context, Made, quantity, time_unit
from en4dvar.config.document import Document
from en4dvar.config.load import read_file
from en4dvar.config.parameters import Entry, Fixed, Uncertain, entries
from en4dvar.config.schema import File, Name, Section
from en4dvar.config.validate import Faults
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.plumbing.units import parse_quantity
from en4dvar.priors.prior import PriorTerm


class GroupSection(Section):
    """Data sets of one kind: how many, and what their parameters are drawn from."""

    datasets: Annotated[int, Field(ge=1, le=999)]
    """How many data sets."""
    parameters: Annotated[tuple[Entry, ...], entries("a campaign")]
    """What their truths are drawn from: a prior (drawn for each) or a quantity (common to all)."""

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        """Priors of the parameters that are drawn for each data set."""
        return tuple(entry.term() for entry in self.parameters if isinstance(entry, Uncertain))

    @property
    def fixed(self) -> dict[str, float]:
        """Values that are common to all data sets."""
        return {entry.parameter.name: entry.value for entry in self.parameters if isinstance(entry, Fixed)}


def _end(text: Any, context: Context) -> float:
    return 0.0 if text == 0 and text is not False else parse_quantity(text, time_unit(context))


def _ascending(written: Any, validate: ValidatorFunctionWrapHandler) -> tuple[float, float]:
    low, high = validate(written)
    if low is not None and low > high:
        raise ValueError(f"{written[0]} is larger than {written[1]}")
    return low, high


def _positive(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] is not None and not pair[0] > 0:
        raise ValueError("must be positive")
    return pair


End = Annotated[float, Made(_end)]
Interval = Annotated[tuple[End, End], WrapValidator(_ascending)]


def _below(directory: str, context: Context) -> Path:
    base = Path(os.path.abspath(context.base))  # a link may lead elsewhere, the configuration may not
    if base not in Path(os.path.abspath(base / directory)).parents:
        raise ValueError(f"must be a folder below {base}")
    return context.base / directory


class CampaignSection(Section):
    """How the truths are observed, in the model's units. Pairs are the ends of uniform distributions."""

    directory: Annotated[Path, Made(_below, Annotated[str, Field(min_length=1)])]
    """Folder of the data files, relative to the configuration's."""
    first: Interval
    """Instant of the first reading."""
    spacing: Annotated[Interval, AfterValidator(_positive)]
    """Time between two readings."""
    stop: Annotated[float, Field(gt=0, lt=1)]
    """Readings end with the first one below this times the largest so far."""
    most: Annotated[int, Field(ge=3, le=100_000)] = 60
    """Largest number of readings."""
    fewest: Annotated[int, Field(ge=3)] = 5
    """A data set with fewer readings is drawn again."""
    noise: Annotated[float, quantity(lambda context: context.units.observables[0].unit, "positive")]
    """Std of the error of a reading, in the observable's unit."""
    time_shift: Interval = (0.0, 0.0)
    """t_s: a reading told at t was taken at t + t_s."""
    groups: Annotated[dict[Name, GroupSection], Field(min_length=1)]
    """Data sets of one kind, by name."""

    @model_validator(mode="after")
    def _after_time_zero(self) -> Self:
        first, shift = self.first[0], self.time_shift[0]
        with Faults() as faults:
            if None not in (first, shift) and first + shift < 0:
                faults.add(("first",), "the first reading could be taken before time zero")
        return self


class CampaignFile(File):
    """A synthetic campaign: what is drawn, and how it is observed."""

    name: Name
    """Name of the campaign."""
    campaign: CampaignSection
    """How truths are drawn and observed."""


@dataclass(frozen=True)
class CampaignPlan:
    """A validated campaign; ``directory`` is where its files go."""

    name: str
    seed: int
    model: ForwardModel
    directory: Path
    settings: CampaignSection

    @property
    def observable(self) -> Observable:
        """The observable that is read."""
        return self.model.observables[0]


def resolve_campaign(document: Document, base: Path) -> CampaignPlan:
    """Validate a document with a ``campaign:`` section. Raises :class:`ConfigError`, every fault at once."""
    read = read_file(CampaignFile, document, base)
    file = read.file
    return CampaignPlan(file.name, file.seed, read.model, file.campaign.directory, file.campaign)
