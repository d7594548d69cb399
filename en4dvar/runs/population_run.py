"""``en4dvar population``: mean and spread of parameters over the data sets of finished runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from en4dvar.caution import Caution, caution
from en4dvar.diagnostics import HARDLY_INFORMED
from en4dvar.executor import choose_executor
from en4dvar.files import make_folder
from en4dvar.population import Effort, HyperPrior
from en4dvar.population.campaign import CampaignPopulation, population_of
from en4dvar.report.population import write_population
from en4dvar.runs.finished import carried, finished
from en4dvar.runs.trust import Ask
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
        :func:`~en4dvar.population.campaign.population_of` says.
    """
    first, sets = finished(run_dirs, trust, ask)
    tell(f"population of {', '.join(names)} behind {len(sets)} data sets")
    with choose_executor(first.model, None, workers) as executor:
        found = population_of(
            [one.problem for one in sets], [one.white for one in sets], names, first.seed,
            executor=executor, hyper=hyper, effort=effort, workers=workers or 1,
        )  # fmt: skip
    tell(f"{found.estimate.forward_runs} forward runs, {found.estimate.size:.0f} effective draws")
    attributes = {**provenance("", None), "seed": first.seed, "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
    cautions = (*_cautions(found), *carried(sets))
    file = save_population(make_folder(out) / FILE, found, [one.members for one in sets], cautions, attributes)
    stored = load_population(file)
    return stored, write_population(stored, out)


def _cautions(found: CampaignPopulation) -> Iterator[Caution]:
    if not found.estimate.converged:
        words = f"only {found.estimate.size:.0f} effective draws stand behind the population"
        yield caution("chain-not-converged", words)
    for name, share in zip(found.names, found.learned[0], strict=True):
        if share < HARDLY_INFORMED:
            words = f"the data say little about the population's {name}: its interval is that of the hyperprior"
            yield caution("not-informed", words, parameters=(name,))
