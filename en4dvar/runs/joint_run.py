"""Data sets estimated together, from what the result files of their single estimates record: those of a run whose
configuration shares parameters, or of several finished runs (``en4dvar joint``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from en4dvar.config import Config
from en4dvar.errors import ConfigError
from en4dvar.executor import Executor, choose_executor
from en4dvar.files import make_folder
from en4dvar.joint.estimate import Single, estimate_jointly
from en4dvar.joint.problem import JointProblem, sharing
from en4dvar.runs.finished import Finished, carried, finished
from en4dvar.runs.together import once_together
from en4dvar.runs.trust import Ask
from en4dvar.runs.worklist import Worklist
from en4dvar.storage.joint_file import FILE, Alone, StoredJoint, load_joint, save_joint
from en4dvar.storage.provenance import provenance


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
    from en4dvar.report.joint import write_joint  # what draws pages is slow to import

    first, sets = finished(run_dirs, trust, ask)
    if not names and not any(one.groups for one in sets):
        raise ConfigError("nothing is shared: give --share NAME, or 'shared:' in the configurations of the runs")
    attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
    path = out / FILE
    with choose_executor(first.model, None, workers) as executor:
        _save(sets, attributes, path, tell, names=names, config=first, executor=executor)
    stored = load_joint(path)
    return stored, write_joint(stored, out)


def join_within(work: Worklist, executor: Executor) -> None:
    """The joint estimate of a run whose configuration shares parameters: ``joint.nc`` in its directory.

    Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
    """
    estimate = partial(_save, names=(), config=work.config, executor=executor)
    once_together(work, FILE, "joint estimate", 2, estimate)


def _save(
    sets: Sequence[Finished], attributes: Mapping[str, Any], path: Path, tell: Callable[[str], None], *,
    names: Sequence[str], config: Config, executor: Executor,
) -> None:  # fmt: skip
    """Estimate them together, with ``names`` in common, or what their configurations share, and the settings and the
    seed of ``config``, and write the file.

    Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
    """
    problems = tuple(one.problem for one in sets)
    joint = sharing(problems, names) if names else JointProblem(problems, tuple(one.groups for one in sets))
    make_folder(path.parent)
    singles = [Single.of_physical(one.problem.prior, one.members, one.centre) for one in sets]
    found = estimate_jointly(joint, config.assimilation, config.seed, executor, singles, tell)
    found = replace(found, cautions=(*found.cautions, *carried(sets)))
    alone = [Alone(one.problem.prior.names, one.members) for one in sets]
    shared = " ".join(dict.fromkeys(name for name, _ in joint.shared))
    save_joint(path, found, alone, {**attributes, "seed": config.seed, "shared": shared})
