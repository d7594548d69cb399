"""The kind of run that estimates mean and spread of parameters over data sets: those of a run whose configuration has
``population:``, or of several finished runs (``en4dvar population``).
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from en4dvar.config import Config
from en4dvar.config.sharing import SOURCE, reference_value
from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population import campaign as of_campaign
from en4dvar.estimation.population.campaign import FEWEST_SETS, Population, population_of
from en4dvar.executor import Executor
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError, retold
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.population_file import FILE, GROUPS, StoredPopulation, load_population, save_population
from en4dvar.runs.finished import Finished, carried
from en4dvar.runs.together import SetGroup, Tell, TogetherKind
from en4dvar.runs.trust import Ask


def population(
    run_dirs: Sequence[Path],
    names: Sequence[str],
    out: Path,
    *,
    hyper: HyperPrior | Mapping[str, float] | None = None,
    effort: Effort | None = None,
    workers: int | None = None,
    trust: bool = False,
    ask: Ask | None = None,
    tell: Tell = lambda words: None,
) -> tuple[StoredPopulation, Path]:
    """Estimate the population of the parameters ``names`` behind the data sets of finished runs; writes
    ``population.nc``, ``.csv``, ``.tex`` and ``.html`` to ``out``. Returns what was found and the path of the page.

    ``hyper`` is in units of the prior's standard deviations; a mapping says what of it differs from that of
    ``population:`` in the configuration of the first run, whose seed is taken as well.

    Raises
    ------
    RefusedError, OutputError: as of :meth:`~en4dvar.runs.together.TogetherKind.of_runs`. ConfigError: there is no
        population of these data sets, as :func:`~en4dvar.estimation.population.campaign.population_of` says.
        TooFewMembersError: too many forward runs failed.
    """
    kind = PopulationKind(tuple(names), hyper, effort)
    file, page = kind.of_runs(run_dirs, out, workers, trust, ask, tell)
    return load_population(file), page


@dataclass(frozen=True)
class PopulationKind(TogetherKind):
    """Of the parameters ``names``; without, of what the configuration says."""

    name = "population"
    what = "population"
    fewest = FEWEST_SETS
    result = FILE
    files = (FILE,)
    records = (f"{FOLDER}/population", f"{FOLDER}/population_groups_*")
    pages = ("population.html", "population.csv", "population.tex")
    writer = "en4dvar.report.population:write_population"

    names: Sequence[str] = ()
    hyper: HyperPrior | Mapping[str, float] | None = None
    effort: Effort | None = None

    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        tell(f"population of {', '.join(self.names)} behind {len(sets)} data sets")
        problems, white = [s.problem for s in sets], [s.white for s in sets]
        asked = config.population.hyper if config.population else HyperPrior()
        hyper = self.hyper if isinstance(self.hyper, HyperPrior) else replace(asked, **(self.hyper or {}))
        with retold(ValueError, TooFewMembersError, "no population: "):  # of forward runs that failed
            population = population_of(
                problems, white, self.names, config.seed, kept=[s.drawn for s in sets], hyper=hyper,
                effort=self.effort, executor=executor, tell=tell,
            )  # fmt: skip
        tell(f"{population.forward_runs} forward runs, {population.size:.0f} effective draws")
        used = [s for s in sets if s.name not in population.left_out]
        cautions = (*_cautions(population), *carried(used))
        about = {**attributes, "seed": config.seed, **_elsewhere(config, population, str(attributes.get("group", "")))}
        save_population(path, population, [s.members for s in used], cautions, about)


def groups_of(config: Config, names: Iterable[str]) -> list[SetGroup]:
    """The groups that have a population each, in the order of the configuration; none where it asks for no groups.

    Raises :class:`ConfigError`: a data set is in no group, or in several.
    """
    if config.population is None or (kind := config.population.by) is None:
        return []
    sets: dict[str, set[str]] = {group: set() for group in config.sharing.groups[kind]}
    for name in names:
        sets[config.sharing.group_of(kind, name)].add(name)
    return [
        SetGroup(group, f"{GROUPS}/{i}_{re.sub(r'[^A-Za-z0-9.+-]', '_', group)}", frozenset(of_it))
        for i, (group, of_it) in enumerate(sets.items(), 1)
    ]


def require_population(config: Config, problem: InverseProblem, names: Collection[str]) -> None:
    """Refuse a run before anything is computed, whose data sets ``names``, such as ``problem``, have no population.

    Raises :class:`ConfigError`.
    """
    if config.population is None:
        return
    groups = groups_of(config, names)
    count = max((len(group.datasets) for group in groups), default=len(names))
    try:
        if count < FEWEST_SETS:
            where = " in the largest group" if groups else ""
            raise ConfigError(f"a population needs at least {FEWEST_SETS} data sets, not {count}{where}")
        of_campaign.require_population([problem], config.population.of)
    except ConfigError as error:
        raise ConfigError([config.document.fault(("population",), str(error), at_key=True)]) from None


def _elsewhere(config: Config, population: Population, group: str) -> dict[str, str]:
    """What the configuration says of the same numbers, to compare with and to calibrate with: lines of name, value and
    std, and the source.
    """
    if (asked := config.population) is None:
        return {}
    said: dict[str, str] = {}
    for key, texts in (("reference", asked.reference), ("known", asked.known.get(group, {}))):
        of_it = {t.parameter.name: t.parameter.unit for t in population.terms if t.parameter.name in texts}
        values = {name: reference_value(texts[name], unit) for name, unit in of_it.items()}
        if values:
            said[key] = "\n".join(f"{name} {value:.17g} {std:.17g}" for name, (value, std) in values.items())
    return {**said, "reference_source": asked.reference.get(SOURCE, "")} if "reference" in said else said


def _cautions(population: Population) -> Iterator[Caution]:
    if not population.converged:
        words = f"only {population.size:.0f} effective draws stand behind the population"
        advice = "the median of the data sets one by one, which needs none, stands in the place of its numbers"
        yield replace(caution("chain-not-converged", words), advice=advice)
    if population.odd:
        names, chances = [p.observations.name for p in population.problems], 1 - population.belongs
        odd = [f"{names[s]} (with probability {chances[s]:.2g})" for s in population.odd]
        words = f"perhaps not of the population, where {population.hyper.odd:.2g} was expected: {', '.join(odd)}"
        yield caution("odd-data-set", f"{words}; as far as they are not, mean and spread are those of the others")
    for name, reason in population.left_out.items():
        yield caution("odd-data-set", f"{name} is left out: {reason}")
    for name, share in zip(population.names, population.learned[0], strict=True):
        if share < HARDLY_INFORMED:
            words = f"the data say little about the population's {name}: its interval is that of the hyperprior"
            yield caution("not-informed", words, parameters=(name,))
