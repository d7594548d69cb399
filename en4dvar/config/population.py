"""The ``population:`` section: which parameters vary from data set to data set about a common mean."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Annotated, Any

from pydantic import Field

from en4dvar.config.document import Document
from en4dvar.config.parameters import Entry, Uncertain
from en4dvar.config.schema import section_of
from en4dvar.errors import ConfigError, Fault
from en4dvar.hints import suggest
from en4dvar.population import HyperPrior

_HyperPrior: Any = section_of(HyperPrior)


class PopulationSection(_HyperPrior):
    """Mean and spread of parameters over the data sets of the run, estimated at its end."""

    of: Annotated[tuple[str, ...], Field(min_length=1)]
    """Parameters that vary from data set to data set about a common mean, e.g. [G, mu]."""

    @property
    def hyper(self) -> HyperPrior:
        """What is known of mean and spread before the data."""
        return HyperPrior(**{field.name: getattr(self, field.name) for field in fields(HyperPrior)})


def check_population(section: PopulationSection, entries: Sequence[Entry], document: Document) -> None:
    """Raises :class:`ConfigError`: every parameter that is not estimated, or whose prior depends on the data set."""
    if faults := list(_faults(section, entries, document)):
        raise ConfigError(faults)


def _faults(section: PopulationSection, entries: Sequence[Entry], document: Document) -> Iterator[Fault]:
    estimated = {e.parameter.name: e for e in entries if isinstance(e, Uncertain)}
    for i, name in enumerate(section.of):
        where = ("population", "of", i)
        if name not in estimated:
            yield document.fault(where, f"{name}: not estimated, it has no prior{suggest(name, estimated)}")
        elif estimated[name].needs_data:
            yield document.fault(where, f"{name}: its prior depends on the data set ('maximum'), a population has one")
