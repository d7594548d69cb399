"""A population ⇄ ``population.nc``: draws of mean, spread and the next data set, those of each data set given all, and
what each said alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.caution import Caution, worst_first
from en4dvar.population.campaign import CampaignPopulation, Combination, Draws
from en4dvar.prior import PriorTerm
from en4dvar.state import Array, Parameter
from en4dvar.storage.joint_file import QUANTILES, StoredGroups, load_groups
from en4dvar.storage.netcdf import Group, Groups, Variable, to_bytes, variable

FILE = "population.nc"
WORDS = {"mean": "mean of the population", "between": "standard deviation between data sets", "next": "the next one"}
_DRAWS = ("chain", "draw")


def save_population(
    path: Path, found: CampaignPopulation, alone: Sequence[Array], cautions: Sequence[Caution],
    attributes: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Write the file; it appears complete or not at all. ``alone``: physical members (N_i, n) of each data set.

    Raises :class:`OutputError`.
    """
    return to_bytes(population_groups(found, alone, cautions, attributes)).write(path)


def population_groups(
    found: CampaignPopulation, alone: Sequence[Array], cautions: Sequence[Caution], attributes: Mapping[str, Any]
) -> Groups:
    """All of the file."""
    names = np.array([one.observations.name for one in found.problems], dtype=object)
    datasets = {"dataset": variable("dataset", names, "", "data set")}
    free, effective = found.without_hyperprior(int(attributes["seed"]))
    root = {
        **attributes,
        "parameters": " ".join(found.names),
        "hyperprior_mean_std": found.hyper.mean_std,
        "hyperprior_spread": found.hyper.spread,
        "effective_draws": found.estimate.size,
        "effective_draws_without_hyperprior": effective,
        "log_evidence": found.estimate.log_evidence - sum(p.observations.log_normalisation() for p in found.problems),
        "forward_runs": found.estimate.forward_runs,
        "combinations": "\n".join(map(combination_line, found.combinations())),
        "warnings": "\n".join(c.line for c in worst_first(cautions)),
    }
    return {
        "/": Group(attrs=root),
        "/posterior": Group(_draws(found, found.posterior) | _sets(found), datasets),
        "/prior": Group(_draws(found, found.prior)),
        "/without_hyperprior": Group(_draws(found, free)),
        "/alone": Group(_alone(found, alone), datasets),
    }


def combination_line(one: Combination) -> str:
    """``0.05 G 1 alpha 0.98``: the standard deviation, then names and exponents."""
    return " ".join([f"{one.std:.17g}", *(f"{name} {exponent:.17g}" for name, exponent in one.parts)])


def _about(p: Parameter) -> dict[str, Any]:
    return {"symbol": p.symbol, "display_units": p.display_unit, "label": p.label}


def _draws(found: CampaignPopulation, draws: Draws) -> dict[str, Variable]:
    learned = dict(zip(("mean", "between"), found.learned, strict=True))
    result = {}
    for j, term in enumerate(found.terms):
        p = term.parameter
        for what, words in WORDS.items():
            values = getattr(draws, what)[None, :, j]
            more: dict[str, Any] = {"transform": term.transform}
            if what in learned:
                more["learned"] = float(learned[what][j])
            result[f"{p.name}_{what}"] = variable(_DRAWS, values, p.unit, f"{p.label}: {words}", **_about(p), **more)
    return result


def _sets(found: CampaignPopulation) -> dict[str, Variable]:
    """(chain, draw, dataset) of every parameter, given all data."""
    terms: tuple[PriorTerm, ...] = found.problems[0].prior.terms
    return {
        p.name: variable((*_DRAWS, "dataset"), found.sets[None, :, :, j], p.unit, p.label, **_about(p))
        for j, p in enumerate(term.parameter for term in terms)
    }


def _alone(found: CampaignPopulation, alone: Sequence[Array]) -> dict[str, Variable]:
    """Quantiles (dataset, quantile) of the parameters of the population as each data set has them by itself."""
    result = {}
    for term in found.terms:
        p = term.parameter
        rows = [
            np.quantile(members[:, problem.prior.names.index(p.name)], QUANTILES)
            for problem, members in zip(found.problems, alone, strict=True)
        ]
        result[p.name] = variable(("dataset", "quantile"), np.array(rows), p.unit, "5, 50 and 95 % of a data set alone")
    return result


@dataclass(frozen=True)
class StoredPopulation(StoredGroups):
    """A file of :func:`save_population`: a thin view of ``tree``."""

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets."""
        return tuple(map(str, self.group("alone")["dataset"].values))

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the population."""
        return tuple(str(self.tree.attrs["parameters"]).split())

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What the data determine together and not one by one."""
        found = []
        for line in str(self.tree.attrs["combinations"]).splitlines():
            std, *rest = line.split()
            parts = tuple((name, float(a)) for name, a in zip(rest[::2], rest[1::2], strict=True))
            found.append(Combination(parts, float(std)))
        return tuple(found)


def load_population(path: Path) -> StoredPopulation:
    """Read the file into memory. Raises :class:`OutputError`: it is none, cut short or altered."""
    return StoredPopulation(load_groups(path, ("posterior", "prior", "without_hyperprior", "alone"), "a population"))
