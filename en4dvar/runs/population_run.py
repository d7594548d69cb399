"""Mean and spread of parameters over data sets: those of a run whose configuration has ``population:``, or of several
finished runs (``en4dvar population``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from en4dvar.caution import Caution, caution
from en4dvar.config import Config
from en4dvar.diagnostics import HARDLY_INFORMED
from en4dvar.errors import ConfigError, TooFewMembersError
from en4dvar.executor import Executor, choose_executor
from en4dvar.files import make_folder
from en4dvar.population import Effort, HyperPrior
from en4dvar.population.campaign import FEWEST_SETS, CampaignPopulation, population_of, runs_of
from en4dvar.problem import InverseProblem
from en4dvar.runs.finished import Finished, carried, finished
from en4dvar.runs.together import once_together
from en4dvar.runs.trust import Ask
from en4dvar.runs.worklist import Worklist
from en4dvar.storage.population_file import FILE, StoredPopulation, load_population, save_population
from en4dvar.storage.provenance import provenance


def population(
    run_dirs: Sequence[Path],
    names: Sequence[str],
    out: Path,
    *,
    hyper: HyperPrior | None = None,
    effort: Effort | None = None,
    workers: int | None = None,
    trust: bool = False,
    ask: Ask | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> tuple[StoredPopulation, Path]:
    """Estimate the population of the parameters ``names`` behind the data sets of finished runs; writes
    ``population.nc``, ``.csv``, ``.tex`` and ``.html`` to ``out``. Returns what was found and the path of the page.

    ``hyper`` is in units of the prior's standard deviations. The seed is that of the first run.

    Raises
    ------
    RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result, or it is
        damaged. ConfigError: there is no population of these data sets, as
        :func:`~en4dvar.population.campaign.population_of` says. TooFewMembersError: too many forward runs failed.
    """
    from en4dvar.report.population import write_population  # what draws pages is slow to import

    first, sets = finished(run_dirs, trust, ask)
    attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
    path = out / FILE
    with choose_executor(first.model, None, workers) as executor:
        _save(
            sets, attributes, path, tell, names=names, seed=first.seed, hyper=hyper, effort=effort,
            workers=workers or 1, executor=executor,
        )  # fmt: skip
    stored = load_population(path)
    return stored, write_population(stored, out)


def population_within(work: Worklist, executor: Executor) -> None:
    """The population that the configuration of a run asks for: ``population.nc`` in its directory.

    Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
    """
    config, asked = work.config, work.config.population
    if asked is None:
        return
    estimate = partial(
        _save, names=asked.of, seed=config.seed, hyper=asked.hyper, workers=config.execution.workers or 1,
        executor=executor,
    )  # fmt: skip
    once_together(work, FILE, "population", FEWEST_SETS, estimate)


def require_population(config: Config, problem: InverseProblem, count: int) -> None:
    """Refuse a run before anything is computed, whose ``count`` data sets, such as ``problem``, have no population.

    Raises :class:`ConfigError`.
    """
    if config.population is None:
        return
    try:
        if count < FEWEST_SETS:
            raise ConfigError(f"a population needs at least {FEWEST_SETS} data sets, not {count}")
        runs_of([problem], config.population.of)
    except ConfigError as error:
        raise ConfigError([config.document.fault(("population",), str(error), at_key=True)]) from None


def _save(
    sets: Sequence[Finished], attributes: Mapping[str, Any], path: Path, tell: Callable[[str], None], *,
    names: Sequence[str], seed: int, **options: Any,
) -> None:  # fmt: skip
    """Estimate it and write the file."""
    tell(f"population of {', '.join(names)} behind {len(sets)} data sets")
    try:
        found = population_of([one.problem for one in sets], [one.white for one in sets], names, seed, **options)
    except ValueError as error:  # of forward runs that failed
        raise TooFewMembersError(f"no population: {error}") from None
    tell(f"{found.estimate.forward_runs} forward runs, {found.estimate.size:.0f} effective draws")
    cautions = (*_cautions(found), *carried(sets))
    make_folder(path.parent)
    save_population(path, found, [one.members for one in sets], cautions, {**attributes, "seed": seed})


def _cautions(found: CampaignPopulation) -> Iterator[Caution]:
    if not found.estimate.converged:
        words = f"only {found.estimate.size:.0f} effective draws stand behind the population"
        yield caution("chain-not-converged", words)
    for name, share in zip(found.names, found.learned[0], strict=True):
        if share < HARDLY_INFORMED:
            words = f"the data say little about the population's {name}: its interval is that of the hyperprior"
            yield caution("not-informed", words, parameters=(name,))
