"""``en4dvar joint``: finished runs estimated together, from what their result files record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from en4dvar.caution import Caution, caution
from en4dvar.config import Config
from en4dvar.config.build import problem_of
from en4dvar.config.document import parse_document
from en4dvar.config.load import resolve
from en4dvar.errors import ConfigError, OutputError
from en4dvar.executor import choose_executor
from en4dvar.files import make_folder
from en4dvar.joint.estimate import Single, estimate_jointly
from en4dvar.joint.problem import sharing
from en4dvar.problem import InverseProblem
from en4dvar.report.joint import write_joint
from en4dvar.runs.trust import Ask, of_strangers
from en4dvar.storage.joint_file import FILE, Alone, StoredJoint, load_joint, save_joint
from en4dvar.storage.provenance import provenance
from en4dvar.storage.store import StoredResult, load_stored, result_files

CARRIED = ("implausible-data", "misfit", "residual-structure", "model-validity")
MOST_NAMES = 4


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
    """Estimate the data sets of finished runs together, with the parameters ``names`` in common; writes ``joint.nc``,
    ``joint.csv`` and ``joint.html`` to ``out``. Returns what was found and the path of the page.

    Settings of the ensemble and the seed are those of the first run.

    Raises
    ------
    RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result, or it is
        damaged. ConfigError: the data sets cannot share these parameters. TooFewMembersError: the ensemble is lost.
    """
    problems: list[InverseProblem] = []
    singles: list[Single] = []
    alone: list[Alone] = []
    cautions: list[tuple[str, Caution]] = []
    first: Config | None = None
    for run_dir in run_dirs:
        config, results = _recorded(run_dir, trust, ask)
        first = first or config
        for result in results:
            if len(result.axes) > 1:  # the file and page of a joint estimate know one series a data set
                raise ConfigError(f"{run_dir}: {result.name} has several series; it cannot be estimated jointly")
            problem = problem_of(config, result.observations())
            if problem.varying:
                raise ConfigError(f"{run_dir}: parameters that vary in time cannot be estimated jointly")
            members = _members(result, problem)
            centre = result.sample_stats["centre"].sel(parameter=list(problem.prior.names)).values
            problems.append(problem)
            singles.append(_single(problem, members, np.asarray(centre, dtype=float)))
            alone.append(Alone(problem.prior.names, members))
            cautions += [(result.name, one) for one in result.cautions]
    if first is None:
        raise ConfigError("a joint estimate takes at least two data sets")
    joint = sharing(list(_named_apart(problems, run_dirs)), names)
    with choose_executor(first.model, None, workers) as executor:
        found = estimate_jointly(joint, first.assimilation, first.seed, executor, singles, tell)
    found = replace(found, cautions=(*found.cautions, *_carried(cautions)))
    attributes = {
        **provenance("", None),
        "seed": first.seed,
        "shared": " ".join(names),
        "runs": ", ".join(run_dir.name for run_dir in run_dirs),
    }
    stored = load_joint(save_joint(make_folder(out) / FILE, found, alone, attributes))
    return stored, write_joint(stored, out)


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


def _named_apart(problems: Sequence[InverseProblem], run_dirs: Sequence[Path]) -> Iterator[InverseProblem]:
    """Data sets of one name in several runs get a number."""
    seen: dict[str, int] = {}
    for problem in problems:
        name = problem.observations.name
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1:
            problem = replace(problem, observations=replace(problem.observations, name=f"{name}_{seen[name]}"))
        yield problem
