"""Data sets estimated together, from what the result files of their single estimates record: those of a run whose
configuration shares parameters, or of several finished runs (``en4dvar joint``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from en4dvar.config import Config
from en4dvar.errors import ConfigError
from en4dvar.executor import Executor, choose_executor
from en4dvar.files import make_folder
from en4dvar.joint.estimate import Single, estimate_jointly
from en4dvar.joint.problem import JointProblem, sharing
from en4dvar.runs.finished import Finished, carried, finished, finished_set
from en4dvar.runs.trust import Ask
from en4dvar.runs.worklist import Worklist
from en4dvar.storage.checkpoint import FOLDER, digest, file_digest, write_checkpoint
from en4dvar.storage.joint_file import FILE, Alone, StoredJoint, load_joint, save_joint
from en4dvar.storage.provenance import provenance
from en4dvar.storage.store import load_stored

JOINED = f"{FOLDER}/joint"


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
    joint = sharing([one.problem for one in sets], names) if names else _as_configured(sets)
    attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
    with choose_executor(first.model, None, workers) as executor:
        path = _save(joint, sets, first, executor, attributes, make_folder(out) / FILE, tell)
    stored = load_joint(path)
    return stored, write_joint(stored, out)


def join_within(work: Worklist, executor: Executor) -> None:
    """The joint estimate of a run whose configuration shares parameters: ``joint.nc`` in its directory.

    One that a resumed run finds, made of the same single estimates, is kept.

    Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
    """
    config, run = work.config, work.run
    good = work.good()
    if len(good) < 2:
        run.notice("no joint estimate, for which two data sets need a posterior")
        return
    made_of = [run.identity.settings, *(f"{name}: {work.ended[name].sha256}" for name in good)]
    fingerprint, path = digest("\n".join(made_of).encode()), run.directory.at(FILE)
    done = run.restore(JOINED, fingerprint, str, "the joint estimate is made again")
    if done is not None and path.exists() and file_digest(path) == done:
        return
    sets = [finished_set(config, load_stored(address), run.directory.path) for address in good.values()]
    attributes = {**run.attributes, "identity": run.identity.settings, "runs": config.name}
    log = run.log
    _save(_as_configured(sets), sets, config, executor, attributes, path, lambda words: log.write(f"joint: {words}"))
    write_checkpoint(run.directory.at(JOINED), fingerprint, file_digest(path))


def _as_configured(sets: Sequence[Finished]) -> JointProblem:
    """With what their configurations share."""
    return JointProblem(tuple(one.problem for one in sets), tuple(one.groups for one in sets))


def _save(
    joint: JointProblem,
    sets: Sequence[Finished],
    config: Config,
    executor: Executor,
    attributes: Mapping[str, Any],
    path: Path,
    tell: Callable[[str], None],
) -> Path:
    """Estimate them together, with the settings and the seed of ``config``, and write the file.

    Raises :class:`TooFewMembersError`, :class:`OutputError`.
    """
    singles = [Single.of_physical(one.problem.prior, one.members, one.centre) for one in sets]
    found = estimate_jointly(joint, config.assimilation, config.seed, executor, singles, tell)
    found = replace(found, cautions=(*found.cautions, *carried(sets)))
    alone = [Alone(one.problem.prior.names, one.members) for one in sets]
    shared = " ".join(dict.fromkeys(name for name, _ in joint.shared))
    return save_joint(path, found, alone, {**attributes, "seed": config.seed, "shared": shared})
