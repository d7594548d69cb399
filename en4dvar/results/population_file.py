"""A population ⇄ ``population.nc``: draws of mean, spread and the next data set, those of each data set given all, and
what each said alone.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.population.campaign import Combination, Draws, Population
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, worst_first
from en4dvar.plumbing.hints import natural
from en4dvar.priors.prior import PriorTerm
from en4dvar.results.checkpoint import digest
from en4dvar.results.declared import parameter_of, text
from en4dvar.results.joint_file import DRAWS, QUANTILES, StoredGroups, load_groups, of_parameter
from en4dvar.results.netcdf import Group, Variable, to_bytes, understood, variable

FILE = "population.nc"
GROUPS = "groups"  # the folder of a run directory that holds one folder a group, each with its FILE
WORDS = {
    "median": "median of the population",
    "mean": "mean of the population",
    "between": "standard deviation between data sets",
    "next": "the next one",
}
HEADLINE = "median"


def save_population(
    path: Path, population: Population, alone: Sequence[Array], cautions: Sequence[Caution],
    attributes: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Write the file; it appears complete or not at all. ``alone``: physical members (N_i, n) of each data set.

    Raises :class:`OutputError`.
    """
    observed = [problem.observations for problem in population.problems]
    datasets = {"dataset": variable("dataset", text(o.name for o in observed), "", "data set")}
    free, effective = population.without_hyperprior(int(attributes["seed"]))
    combinations = (  # "0.05 G 1 alpha 0.98": the standard deviation, then names and exponents
        " ".join([f"{c.std:.17g}", *(f"{name} {exponent:.17g}" for name, exponent in c.parts)])
        for c in population.combinations()
    )
    root = {
        **attributes,
        "parameters": " ".join(population.names),
        "hyperprior_mean_std": population.hyper.mean_std,
        "hyperprior_spread": population.hyper.spread,
        "hyperprior_odd": population.hyper.odd,
        "common": " ".join(population.common),
        "effective_draws": population.size,
        "effective_draws_without_hyperprior": effective,
        "log_evidence": population.log_evidence - sum(o.log_normalisation() for o in observed),
        "forward_runs": population.forward_runs,
        "combinations": "\n".join(combinations),
        "warnings": "\n".join(c.line for c in worst_first(cautions)),
    }
    beside = _alone(population, alone)
    if len(population.belongs):
        words = "probability that the data set is of the population"
        beside["belongs"] = variable("dataset", population.belongs, "1", words)
    digests = text(digest(o.times.tobytes() + o.values.tobytes()) for o in observed)  # of the same readings the same
    beside["readings"] = variable("dataset", digests, "", "SHA-256 of times and values of the readings")
    groups = {
        "/": Group(attrs=root),
        "/posterior": Group(_draws(population, population.posterior) | _sets(population), datasets),
        "/prior": Group(_draws(population, population.prior)),
        "/without_hyperprior": Group(_draws(population, free)),
        "/white": Group(_white(population)),
        "/alone": Group(beside, datasets),
        "/empirical": Group(_empirical(population)),
    }
    return to_bytes(groups).write(path)


def _draws(population: Population, draws: Draws) -> dict[str, Variable]:
    of_centre, of_spread = population.learned
    learned = {"median": of_centre, "mean": of_centre, "between": of_spread}
    result = {}
    for j, term in enumerate(population.terms):
        p = term.parameter
        for what, words in WORDS.items():
            more: dict[str, Any] = {"label": p.label, "transform": term.transform}
            if what in learned:
                more["learned"] = float(learned[what][j])
            if what == HEADLINE and draws is population.posterior:
                more["std_between"], more["std_common"] = (float(part[j]) for part in population.parts)
            values, words = getattr(draws, what)[None, :, j], f"{p.label}: {words}"
            result[f"{p.name}_{what}"] = of_parameter(p, DRAWS, values, words, **more)
    return result


def _white(population: Population) -> dict[str, Variable]:
    """(chain, draw) of the centres and of what is common in units of their priors, as the draws of ``posterior``."""
    first, draws = population.problems[0].prior, (population.posterior.nu, population.theta)
    columns = np.hstack([part for part in draws if part.size])
    white = {}
    for j, name in enumerate((*population.names, *population.common)):
        term = first.terms[first.names.index(name)]
        prior = json.dumps([term.transform, term.mean, term.std, [*term.bounds], [*term.shape]])
        white[name] = variable(DRAWS, columns[None, :, j], "1", f"{name} in units of its prior", prior=prior)
    return white


def _empirical(population: Population) -> dict[str, Variable]:
    """(quantile,) of the median over the data sets one by one."""
    result = {}
    for term, median in zip(population.terms, population.empirical, strict=True):
        p = term.parameter
        words = f"{p.label}: 5, 50 and 95 % of the median of the data sets one by one"
        parts = {"label": p.label, "std_between": median.between, "std_common": median.common}
        result[p.name] = of_parameter(p, "quantile", median.quantiles, words, **parts)
    return result


def _sets(population: Population) -> dict[str, Variable]:
    """(chain, draw, dataset) of every parameter, given all data."""
    terms: tuple[PriorTerm, ...] = population.problems[0].constant.prior.terms
    return {
        p.name: of_parameter(p, (*DRAWS, "dataset"), population.sets[None, :, :, j], label=p.label)
        for j, p in enumerate(term.parameter for term in terms)
    }


def _alone(population: Population, alone: Sequence[Array]) -> dict[str, Variable]:
    """Quantiles (dataset, quantile) of the parameters of the population as each data set has them by itself."""
    result = {}
    for term in population.terms:
        p = term.parameter
        rows = [
            member_quantiles(members[:, problem.prior.names.index(p.name)], QUANTILES)
            for problem, members in zip(population.problems, alone, strict=True)
        ]
        result[p.name] = variable(("dataset", "quantile"), np.array(rows), p.unit, "5, 50 and 95 % of a data set alone")
    return result


@dataclass(frozen=True)
class StoredPopulation(StoredGroups):
    """A file of :func:`save_population`: a thin view of ``tree``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the population."""
        return tuple(str(self.tree.attrs["parameters"]).split())

    @property
    def headline(self) -> str:
        """What stands for the population: its median; in files of version 1.0 the mean, for they hold no other."""
        return HEADLINE if f"{self.names[0]}_{HEADLINE}" in self.group("posterior") else "mean"

    @property
    def words(self) -> dict[str, str]:
        """What is stored of a population → in words."""
        return {what: words for what, words in WORDS.items() if what in (self.headline, "mean", "between", "next")}

    @property
    def reference(self) -> dict[str, tuple[float, float]]:
        """Parameter → a value of others to compare with and its std (NaN if not stated), in the parameter's unit."""
        return self._values("reference")

    @property
    def known(self) -> dict[str, tuple[float, float]]:
        """Parameter → its median and std as known from elsewhere, in the parameter's unit."""
        return self._values("known")

    def _values(self, attribute: str) -> dict[str, tuple[float, float]]:
        lines = (line.split() for line in str(self.tree.attrs.get(attribute, "")).splitlines())
        return {name: (float(value), float(std)) for name, value, std in lines}

    @property
    def common(self) -> tuple[str, ...]:
        """Quantities that have one value in all data sets."""
        return tuple(str(self.tree.attrs.get("common", "")).split())

    @property
    def belongs(self) -> dict[str, float]:
        """Data set → probability that it is of the population; empty in files of version 1.0."""
        alone = self.group("alone")
        if "belongs" not in alone:
            return {}
        return dict(zip(self.datasets, map(float, alone["belongs"].values), strict=True))

    @property
    def readings(self) -> dict[str, str]:
        """Digest of its readings → data set; empty in files of version 1.0."""
        alone = self.group("alone")
        return dict(zip(map(str, alone["readings"].values), self.datasets, strict=True)) if "readings" in alone else {}

    def white(self, name: str) -> Array:
        """Draws (M,) of a centre or of what is common, in units of its prior."""
        return np.asarray(self.group("white")[name].values, dtype=float).ravel()

    def prior_of(self, name: str) -> PriorTerm:
        """The prior of a parameter of the population, or of what is common."""
        transform, mean, std, bounds, shape = json.loads(self.group("white")[name].attrs["prior"])
        p = parameter_of(name, self.group("posterior")[name].attrs)
        return PriorTerm(p, transform, mean, std, tuple(bounds), tuple(shape))

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What the data determine together and not one by one."""
        combinations = []
        for line in str(self.tree.attrs["combinations"]).splitlines():
            std, *rest = line.split()
            parts = tuple((name, float(a)) for name, a in zip(rest[::2], rest[1::2], strict=True))
            combinations.append(Combination(parts, float(std)))
        return tuple(combinations)


def load_population(path: Path) -> StoredPopulation:
    """Read the file into memory. Raises :class:`OutputError`: it is none, cut short or altered."""
    groups = ("posterior", "prior", "without_hyperprior", "alone")
    population = StoredPopulation(load_groups(path, groups, "a population"))
    with understood(path):
        _ = population.datasets, population.names, population.combinations, population.cautions
    return population


def load_groups_of(run_dir: Path) -> dict[str, tuple[Path, StoredPopulation]]:
    """Group of data sets of a run → the folder of its population, and this; in the order of the configuration.

    Raises :class:`OutputError`, see :func:`load_population`.
    """
    folders = sorted((file.parent for file in (run_dir / GROUPS).glob(f"*/{FILE}")), key=natural)
    stored = [(folder, load_population(folder / FILE)) for folder in folders]
    return {str(of.tree.attrs.get("group", folder.name)): (folder, of) for folder, of in stored}


def populations_of(run_dir: Path) -> dict[str, tuple[Path, StoredPopulation]]:
    """As :func:`load_groups_of`, and under the name "" the population of all data sets, where there is one."""
    whole = {"": (run_dir, load_population(run_dir / FILE))} if (run_dir / FILE).exists() else {}
    return load_groups_of(run_dir) | whole
