"""``en4dvar joint``: finished runs estimated together, from what their result files record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from en4dvar.executor import choose_executor
from en4dvar.files import make_folder
from en4dvar.joint.estimate import Single, estimate_jointly
from en4dvar.joint.problem import sharing
from en4dvar.report.joint import write_joint
from en4dvar.runs.finished import carried, finished
from en4dvar.runs.trust import Ask
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
    """Estimate the data sets of finished runs together, with the parameters ``names`` in common; writes ``joint.nc``,
    ``joint.csv`` and ``joint.html`` to ``out``. Returns what was found and the path of the page.

    Settings of the ensemble and the seed are those of the first run.

    Raises
    ------
    RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result, or it is
        damaged. ConfigError: the data sets cannot share these parameters. TooFewMembersError: the ensemble is lost.
    """
    first, sets = finished(run_dirs, trust, ask)
    alone = [Alone(one.problem.prior.names, one.members) for one in sets]
    singles = [Single.of_physical(one.problem.prior, one.members, one.centre) for one in sets]
    joint = sharing([one.problem for one in sets], names)
    with choose_executor(first.model, None, workers) as executor:
        found = estimate_jointly(joint, first.assimilation, first.seed, executor, singles, tell)
    found = replace(found, cautions=(*found.cautions, *carried(sets)))
    attributes = {
        **provenance("", None),
        "seed": first.seed,
        "shared": " ".join(names),
        "runs": ", ".join(run_dir.name for run_dir in run_dirs),
    }
    stored = load_joint(save_joint(make_folder(out) / FILE, found, alone, attributes))
    return stored, write_joint(stored, out)
