"""Kinds of run that estimate data sets together, from what the result files of their single estimates record: at the
end of the run that made these, or of several finished runs.

A joint estimate is of data sets that share parameters (``en4dvar joint``); a population is mean and spread of
parameters over data sets (``en4dvar population``).
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from en4dvar.config import Config
from en4dvar.config.dependence import SOURCE, reference_value
from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED
from en4dvar.estimation.joint import JointEstimate, Single, estimate_jointly, with_common
from en4dvar.estimation.joint.problem import JointProblem, sharing
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population import campaign as of_campaign
from en4dvar.estimation.population.campaign import FEWEST_SETS, Population, population_of
from en4dvar.estimation.population.own import expected_runs
from en4dvar.executor import Executor, choose_executor
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError, retold
from en4dvar.plumbing.hints import counted, listed, rounded
from en4dvar.problem import InverseProblem
from en4dvar.results import together as stored
from en4dvar.results.checkpoint import FOLDER, Journal, KnownRuns, digest, file_digest, write_checkpoint
from en4dvar.results.pack import PACK
from en4dvar.results.provenance import Identity, identity, provenance
from en4dvar.results.store import load_stored
from en4dvar.runs.engine import Kind, Session, directory_mode
from en4dvar.runs.finished import Finished, carried, finished, finished_set
from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory, note_beginning
from en4dvar.runs.trust import Ask
from en4dvar.runs.worklist import Worklist

Tell = Callable[[str], None]
VARIES = 0.3  # of the mean: one gel is not known to vary by more between its bubbles (published are 14 and 23 %)
DIFFER = (
    "look at what the first and the last of these do not share, as scale, frame rate, gel, batch: mend what is wrong, "
    "and estimate different gels each by itself; if there is nothing, the parameter itself varies so"
)
MISREAD = "implausible-data", "lost-frame"  # that readings of a data set are wrong
MOST = 0.5  # of the data sets: what more share is no oddity of each
SPOILT = 1 / 3  # of the data sets: where more are warned of alike, the warning is serious for all together


@dataclass(frozen=True)
class SetGroup:
    """Names of ``datasets`` that are estimated together, with a ``folder`` of the run directory of their own."""

    name: str
    folder: str
    datasets: frozenset[str]


class TogetherKind(Kind, ABC):
    """An estimate of several data sets. ``what`` it is, in words; ``fewest`` data sets are needed. ``records``: of what
    an estimate within a run was made.
    """

    what: ClassVar[str]
    records: ClassVar[tuple[str, ...]]
    fewest: ClassVar[int]

    @abstractmethod
    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        """Estimate the sets with the seed and settings of ``config``, and write the file ``path``. Raises
        :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
        """

    def of_runs(
        self, run_dirs: Sequence[Path], out: Path, workers: int | None = None, trust: bool = False,
        ask: Ask | None = None, tell: Tell = lambda words: None, force: bool = False, resume: bool = False,
    ) -> tuple[Path, Path]:  # fmt: skip
        """Of the data sets of finished runs, with the settings of the first; returns the paths of result and page.

        What an interrupted estimate of the same had run is not run again, unless ``force`` is given; with ``resume``,
        nor is a finished one made again.

        Raises RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result,
        it is damaged, or a file that no run wrote would be replaced. Others as of :meth:`estimate`.
        """
        names, record, mode = (*self.files, *self.pages), self.records[0], directory_mode(force, resume)
        if mode == "resume":
            note_beginning(out)
        with terminate_as_interrupt(), RunDirectory.open(out, "beside", names) as directory:
            config, sets = finished(run_dirs, trust, ask)
            attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
            configs = {s.config.resolved: s.config for s in sets}.values()
            made_of = [repr(self), *(identity(c.resolved, c.model, {}).settings for c in configs)]
            made_of += [file_digest(run_dir / name) for run_dir in run_dirs for name in (PACK, "posterior.nc")]
            session = Session(config, directory, tell, Identity("", ()), attributes)
            try:
                directory.claim(*names, record, under_way(record))
                directory.folder(FOLDER)
                if mode != "resume":
                    directory.remove(record)
                if mode == "force":
                    directory.remove(under_way(record))
                with tell_interrupt(lambda: f"the forward runs are kept in {out}"):
                    with choose_executor(config.model, None, workers) as executor:
                        self._estimate(session, lambda: sets, executor, attributes, self.result, record, made_of, tell)
                    page = self.page(directory.work)
            finally:
                with suppress(OSError):  # where nothing is kept
                    directory.at(FOLDER).rmdir()
                directory.publish()
        assert page is not None
        return out / self.result, out / page.name

    def _estimate(
        self, run: Session, sets: Callable[[], Sequence[Finished]], executor: Executor, attributes: Mapping[str, Any],
        file: str, record: str, made_of: Sequence[str], tell: Tell,
    ) -> None:  # fmt: skip
        """Estimate the ``sets`` and write the result into a ``file`` of the run, unless it is there, ``made_of`` the
        same, as ``record`` says. Forward runs are kept until it is whole.
        """
        again, fingerprint = f"the {self.what} is made again", digest("\n".join(made_of).encode())
        path = run.directory.at(file)
        done = run.restore(record, fingerprint, str, again)
        if done is not None and path.exists() and file_digest(path) == done:
            return
        known, keeper = run.kept(under_way(record), fingerprint, KnownRuns, again)
        if known:
            tell(f"continued after {sum(map(len, known.forecasts))} forward runs")
        journal = Journal(executor, known or KnownRuns(), keeper)
        self.estimate(sets(), run.config, journal, attributes, path, tell)
        write_checkpoint(run.directory.at(record), fingerprint, file_digest(path))
        run.directory.remove(under_way(record))

    def within(self, work: Worklist, executor: Executor, group: SetGroup | None = None) -> None:
        """Of the data sets of a run (or of one ``group`` of them) that have a posterior, at its end; too few of them
        are told, and so is why they have no estimate together: those of each alone remain. A file that a resumed run
        finds, made of the same, is kept.

        Raises what :meth:`estimate` does, but for :class:`TooFewMembersError`.
        """
        config, run = work.config, work.run
        good = [d for d in work.good() if group is None or d.name in group.datasets]
        what = f"{self.what} of {group.name}" if group else self.what
        if len(good) < self.fewest:
            run.notice(f"no {what}, for which {self.fewest} data sets need a posterior; {len(good)} have one")
            return
        digests = (f"{d.name}: {work.pack.entries[d.stem].content_digest}" for d in good)
        file, record = self.result, self.records[0]
        if group:
            run.directory.folder(group.folder)
            file = f"{group.folder}/{file}"
            record = f"{record}_{group.folder.replace('/', '_')}"

        def sets() -> list[Finished]:
            return [finished_set(config, load_stored(run.directory.work / d.file), run.directory.path) for d in good]

        attributes = {**run.attributes, "runs": config.name, **({"group": group.name} if group else {})}
        try:
            self._estimate(
                run, sets, executor, attributes, file, record, [run.identity.settings, *digests],
                lambda words: run.log(f"{what}: {words}"),
            )  # fmt: skip
        except TooFewMembersError as error:
            run.notice(f"no {what}; the data sets are estimated alone: {error}")


def under_way(record: str) -> str:
    """The file of the forward runs of an estimate under way."""
    return f"{record}.iteration"


def join(
    run_dirs: Sequence[Path], names: Sequence[str], out: Path, *, apart: Sequence[str] = (), **how: Any
) -> tuple[stored.StoredJoint, Path]:
    """Estimate the data sets of finished runs together, with the parameters ``names`` in common, or what their
    configurations say where there are none, and with what is common to all data sets of a campaign
    (:attr:`Parameter.common`) but for that named ``apart``; writes ``joint.nc``, ``joint.csv`` and ``joint.html`` to
    ``out``. Returns what was found and the path of the page.

    Settings of the ensemble and the seed are those of the first run; ``how`` as of :meth:`TogetherKind.of_runs`.

    Raises what :meth:`TogetherKind.of_runs` does; :class:`ConfigError`: the data sets cannot share these parameters.
    """
    file, page = JointKind(tuple(names), tuple(apart)).of_runs(run_dirs, out, **how)
    return stored.load_joint(file), page


@dataclass(frozen=True)
class JointKind(TogetherKind):
    """With ``names`` in common, or what the configurations share; ``apart``: what is each data set's own."""

    name = "joint"
    what = "joint estimate"
    fewest = 2
    result = stored.JOINT
    files = (result,)
    records = (f"{FOLDER}/joint",)
    pages = ("joint.html", "joint.csv")
    writer = "en4dvar.report.together:write_joint"

    names: Sequence[str] = ()
    apart: Sequence[str] = ()

    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        if not self.names and not any(dataset.groups for dataset in sets):
            raise ConfigError("nothing is shared: give --share NAME, or 'shared:' in the configurations of the runs")
        problems = tuple(dataset.problem for dataset in sets)
        groups = tuple(dataset.groups for dataset in sets)
        joint = (
            sharing(problems, self.names, self.apart)
            if self.names
            else JointProblem(problems, with_common(problems, groups, self.apart))
        )
        asked = self.names or {name for of_it in groups for name in of_it}
        common = ", ".join(name for name, _ in joint.shared if name not in asked)
        if common:
            tell(f"constants of medium and camera with one value in all data sets (unless --apart NAME): {common}")
        singles = [Single.of_physical(dataset.problem.prior, dataset.members, dataset.centre) for dataset in sets]
        estimated = estimate_jointly(joint, config.assimilation, config.seed, executor, singles, tell)
        estimated = _with_carried(estimated, sets)
        alone = [dataset.members for dataset in sets]
        shared = " ".join(dict.fromkeys(name for name, _ in joint.shared))
        stored.save_joint(
            path, estimated, alone, {**attributes, "seed": config.seed, "shared": shared, "common": common}
        )


def _with_carried(estimate: JointEstimate, sets: Sequence[Finished]) -> JointEstimate:
    without = estimate.without
    if without is not None:
        without = _with_carried(without, [s for s in sets if s.name not in estimate.odd])
    return replace(estimate, cautions=(*estimate.cautions, *carried(sets, SPOILT)), without=without)


def population(
    run_dirs: Sequence[Path],
    names: Sequence[str],
    out: Path,
    *,
    hyper: HyperPrior | Mapping[str, float] | None = None,
    effort: Effort | None = None,
    **how: Any,
) -> tuple[stored.StoredPopulation, Path]:
    """Estimate the population of the parameters ``names`` behind the data sets of finished runs; writes
    ``population.nc``, ``.csv``, ``.tex`` and ``.html`` to ``out``. Returns what was found and the path of the page.

    ``hyper`` is in units of the prior's standard deviations; a mapping says what of it differs from that of
    ``population:`` in the configuration of the first run, whose seed is taken as well; ``how`` as of
    :meth:`TogetherKind.of_runs`.

    Raises what :meth:`TogetherKind.of_runs` does, and :class:`ConfigError` where there is no population of these data
    sets, as :func:`~en4dvar.estimation.population.campaign.population_of` says.
    """
    file, page = PopulationKind(tuple(names), hyper, effort).of_runs(run_dirs, out, **how)
    return stored.load_population(file), page


@dataclass(frozen=True)
class PopulationKind(TogetherKind):
    """Of the parameters ``names``; without, of what the configuration says."""

    name = "population"
    what = "population"
    fewest = FEWEST_SETS
    result = stored.POPULATION
    readers = ("report", "compare")
    files = (result,)
    records = (f"{FOLDER}/population", f"{FOLDER}/population_groups_*")
    pages = ("population.html", "population.csv", "population.tex")
    writer = "en4dvar.report.together:write_population"

    names: Sequence[str] = ()
    hyper: HyperPrior | Mapping[str, float] | None = None
    effort: Effort | None = None

    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        drawn = sum(s.drawn is None for s in sets)
        cost = f"; cost: up to about {rounded(*expected_runs(sets[0].problem))} forward runs each of {drawn}" * (
            drawn > 0
        )
        less = f", {len(sets) - drawn} have kept their draws" * (drawn < len(sets))
        names = " and ".join(self.names)
        tell(f"population: the mean of {names} over {len(sets)} data sets, and how much these differ{cost}{less}")
        problems, white = [s.problem for s in sets], [s.white for s in sets]
        asked = config.population.part(HyperPrior) if config.population else HyperPrior()
        hyper = self.hyper if isinstance(self.hyper, HyperPrior) else replace(asked, **(self.hyper or {}))
        with retold(ValueError, TooFewMembersError):  # of forward runs that failed
            population = population_of(
                problems, white, self.names, config.seed, kept=[s.drawn for s in sets], hyper=hyper,
                effort=self.effort, executor=executor, tell=tell, doubted=_doubted(sets),
            )  # fmt: skip
        tell(f"{counted(population.forward_runs, 'forward run')}, {counted(population.size, 'effective draw')}")
        used = [s for s in sets if s.name not in population.left_out]
        cautions = (*_cautions(population), *carried(used))
        about = {**attributes, "seed": config.seed, **_elsewhere(config, population, str(attributes.get("group", "")))}
        stored.save_population(path, population, [s.members for s in used], cautions, about)


def _doubted(sets: Sequence[Finished]) -> set[str]:
    """Names of the data sets whose own warnings say that readings are wrong."""
    serious = [(c.code, s.name) for s in sets for c in s.cautions if c.severity == "serious"]
    each = [{name for of_it, name in serious if of_it == code} for code in MISREAD]
    return set[str]().union(*(names for names in each if len(names) <= MOST * len(sets)))


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
        SetGroup(group, f"{stored.GROUPS}/{i}_{re.sub(r'[^A-Za-z0-9.+-]', '_', group)}", frozenset(of_it))
        for i, (group, of_it) in enumerate(sets.items(), 1)
    ]


def require_population(config: Config, problem: InverseProblem, names: Collection[str]) -> None:
    """Refuse data sets ``names``, as ``problem``, without a population, before a run. Raises :class:`ConfigError`."""
    if config.population is None:
        return
    groups = groups_of(config, names)
    count = max((len(group.datasets) for group in groups), default=len(names))
    alone = "to estimate each without one: --set population=null"
    try:
        if len(problem.parts) > 1:  # as finished_set, before anything is computed
            raise ConfigError(f"a population needs data sets of one series each; {alone}")
        if count < FEWEST_SETS:
            where = " in the largest group" if groups else ""
            raise ConfigError(f"a population needs at least {FEWEST_SETS} data sets, not {count}{where}; {alone}")
        of_campaign.require_population([problem], config.population.of)
    except ConfigError as error:
        raise ConfigError([config.document.fault(("population",), str(error), at_key=True)]) from None


def _elsewhere(config: Config, population: Population, group: str) -> dict[str, str]:
    """What the configuration says of the same numbers, to compare and calibrate: name, value and std; the source."""
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
    sets = [p.observations.name for p in population.problems]
    if not population.converged:
        words = f"only {population.size:.0f} effective draws support the population"
        advice = "the median of the data sets one by one, which needs no draws, replaces its numbers"
        yield replace(caution("chain-not-converged", words), advice=advice)
    if population.odd:
        chances = 1 - population.belongs
        odd = [f"{sets[s]} (with probability {chances[s]:.2g})" for s in population.odd]
        words = f"perhaps not of the population ({population.hyper.odd:.2g} was expected): {', '.join(odd)}"
        odd_sets = caution("odd-data-set", f"{words}; they count in mean and spread only as far as they belong")
        yield replace(odd_sets, advice="check their data, scale, frame rate and residuals")
    for name, reason in population.left_out.items():
        yield caution("odd-data-set", f"{name} is left out: {reason}")
    for name, share in zip(population.names, population.learned[0], strict=True):
        if share < HARDLY_INFORMED:
            words = f"the data say little about the population's {name}: its interval is that of the hyperprior"
            yield caution("not-informed", words, parameters=(name,))
    for j, term in enumerate(population.terms):
        shares = population.posterior.between[:, j] / population.posterior.mean[:, j]
        if term.transform == "lognormal" and (least := float(np.quantile(shares, 0.05))) > VARIES:
            name = population.names[j]
            column = population.problems[0].prior.names.index(name)
            order = np.argsort(np.median(population.sets[:, :, column], axis=0), kind="stable")
            words = f"{name} differs between data sets by {100 * least:.0f} % or more; from the lowest to the highest: "
            told = caution("data-sets-differ", words + listed([sets[i] for i in order]), "caution")
            yield replace(told, advice=DIFFER)
