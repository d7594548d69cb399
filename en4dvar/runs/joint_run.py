"""Data sets estimated together, from what the result files of their single estimates record: those of a run whose
configuration shares parameters, or of several finished runs (``en4dvar joint``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.caution import Caution, caution
from en4dvar.config import Config
from en4dvar.config.build import problem_of
from en4dvar.config.document import parse_document
from en4dvar.config.load import resolve
from en4dvar.errors import ConfigError, OutputError
from en4dvar.executor import Executor, choose_executor
from en4dvar.files import make_folder
from en4dvar.joint.estimate import Single, estimate_jointly
from en4dvar.joint.problem import JointProblem, sharing
from en4dvar.problem import InverseProblem
from en4dvar.report.joint import write_joint
from en4dvar.runs.trust import Ask, of_strangers
from en4dvar.runs.worklist import Worklist
from en4dvar.storage.checkpoint import FOLDER, digest, file_digest, write_checkpoint
from en4dvar.storage.joint_file import FILE, Alone, StoredJoint, load_joint, save_joint
from en4dvar.storage.provenance import provenance
from en4dvar.storage.store import StoredResult, load_stored, result_files

CARRIED = ("implausible-data", "misfit", "residual-structure", "model-validity")
MOST_NAMES = 4
JOINED = f"{FOLDER}/joint"


@dataclass
class Gathered:
    """Finished estimates of data sets that are to be estimated together, in order."""

    problems: list[InverseProblem] = field(default_factory=list)
    groups: list[Mapping[str, str]] = field(default_factory=list)
    singles: list[Single] = field(default_factory=list)
    alone: list[Alone] = field(default_factory=list)
    cautions: list[tuple[str, Caution]] = field(default_factory=list)

    def add(self, config: Config, result: StoredResult, where: Path) -> None:
        """One more; its configuration says what it shares. Raises :class:`ConfigError`, :class:`OutputError`."""
        if len(result.axes) > 1:  # the file and page of a joint estimate know one series a data set
            raise ConfigError(f"{where}: {result.name} has several series; it cannot be estimated jointly")
        problem = problem_of(config, result.observations())
        if problem.varying:
            raise ConfigError(f"{where}: parameters that vary in time cannot be estimated jointly")
        members = _members(result, problem)
        centre = result.sample_stats["centre"].sel(parameter=list(problem.prior.names)).values
        self.problems.append(problem)
        self.groups.append(config.sharing.of_dataset(result.name))
        self.singles.append(_single(problem, members, np.asarray(centre, dtype=float)))
        self.alone.append(Alone(problem.prior.names, members))
        self.cautions += [(result.name, one) for one in result.cautions]

    def save(
        self, joint: JointProblem, config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Callable[[str], None],
    ) -> Path:  # fmt: skip
        """Estimate them together, with the settings and the seed of ``config``, and write the file.

        Raises :class:`TooFewMembersError`, :class:`OutputError`.
        """
        found = estimate_jointly(joint, config.assimilation, config.seed, executor, self.singles, tell)
        found = replace(found, cautions=(*found.cautions, *_carried(self.cautions)))
        shared = " ".join(dict.fromkeys(name for name, _ in joint.shared))
        return save_joint(path, found, self.alone, {**attributes, "seed": config.seed, "shared": shared})


def join(
    run_dirs: Sequence[Path],
    names: Sequence[str],
    out: Path,
    *,
    workers: int | None = None,
    trust: bool = False,
    ask: Ask | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> tuple[StoredJoint, Path]:
    """Estimate the data sets of finished runs together, with the parameters ``names`` in common, or what their
    configurations say where there are none; writes ``joint.nc``, ``joint.csv`` and ``joint.html`` to ``out``. Returns
    what was found and the path of the page.

    Settings of the ensemble and the seed are those of the first run.

    Raises
    ------
    RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result, or it is
        damaged. ConfigError: the data sets cannot share these parameters. TooFewMembersError: the ensemble is lost.
    """
    gathered = Gathered()
    configs: list[Config] = []
    for run_dir in run_dirs:
        config, results = _recorded(run_dir, trust, ask)
        configs.append(config)
        for result in results:
            gathered.add(config, result, run_dir)
    apart = tuple(_named_apart(gathered.problems))
    if not names and not any(config.sharing for config in configs):
        raise ConfigError("nothing is shared: give --share NAME, or 'shared:' in the configurations of the runs")
    joint = sharing(apart, names) if names else JointProblem(apart, tuple(gathered.groups))
    attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
    first = configs[0]
    with choose_executor(first.model, None, workers) as executor:
        path = gathered.save(joint, first, executor, attributes, make_folder(out) / FILE, tell)
    stored = load_joint(path)
    return stored, write_joint(stored, out)


def join_within(work: Worklist, executor: Executor) -> None:
    """The joint estimate of a run whose configuration shares parameters: ``joint.nc`` in its directory.

    One that a resumed run finds, made of the same single estimates, is kept.

    Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
    """
    config, run = work.config, work.run
    good = [d for d in work.sets if not work.ended[d.name].failure]
    if len(good) < 2:
        run.notice("no joint estimate, for which two data sets need a posterior")
        return
    made_of = [run.identity.settings, *(f"{d.name}: {work.ended[d.name].sha256}" for d in good)]
    fingerprint, path = digest("\n".join(made_of).encode()), run.directory.at(FILE)
    done = run.restore(JOINED, fingerprint, str, "the joint estimate is made again")
    if done is not None and path.exists() and file_digest(path) == done:
        return
    gathered = Gathered()
    for d in good:
        gathered.add(config, load_stored(run.directory.at(d.file)), run.directory.path)
    joint = JointProblem(tuple(gathered.problems), tuple(gathered.groups))
    attributes = {**run.attributes, "identity": run.identity.settings, "runs": config.name}
    gathered.save(joint, config, executor, attributes, path, lambda words: run.log.write(f"joint: {words}"))
    write_checkpoint(run.directory.at(JOINED), fingerprint, file_digest(path))


def _carried(cautions: Sequence[tuple[str, Caution]]) -> Iterator[Caution]:
    """Warnings of single data sets that hold for the joint estimate too, each code once."""
    for code in CARRIED:
        of_it = [(name, one) for name, one in cautions if one.code == code and one.severity == "serious"]
        if of_it:
            names = [name for name, _ in of_it]
            others = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            told = f"{', '.join(names[:MOST_NAMES])}{others}: {of_it[0][1].words}"
            yield caution(code, f"of single data sets, {told}", "serious")


def _recorded(run_dir: Path, trust: bool, ask: Ask | None) -> tuple[Config, list[StoredResult]]:
    """The configuration of a run and its results."""
    results = [load_stored(file) for file in result_files(run_dir)]
    attributes = results[0].attributes
    if "configuration_resolved" not in attributes:
        raise OutputError(f"{run_dir}: its results do not record a configuration; they were written by a program")
    document = parse_document(str(attributes["configuration_resolved"]), f"{run_dir}: configuration_resolved")
    with of_strangers(run_dir, ask, trust):
        return resolve(document, run_dir.absolute()), results


def _members(result: StoredResult, problem: InverseProblem) -> np.ndarray:
    """(N, n) physical members of the posterior that are alive."""
    columns = [np.asarray(result.posterior[name].values, dtype=float).ravel() for name in problem.prior.names]
    members = np.column_stack(columns)
    return np.asarray(members[result.alive & np.isfinite(members).all(axis=1)])


def _single(problem: InverseProblem, members: np.ndarray, centre: np.ndarray) -> Single:
    try:
        return Single.of_physical(problem.prior, members, centre)
    except ValueError as error:
        raise OutputError(f"{problem.observations.name}: {error}") from None


def _named_apart(problems: Sequence[InverseProblem]) -> Iterator[InverseProblem]:
    """Data sets of one name in several runs get a number."""
    seen: dict[str, int] = {}
    for problem in problems:
        name = problem.observations.name
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1:
            problem = replace(problem, observations=replace(problem.observations, name=f"{name}_{seen[name]}"))
        yield problem
