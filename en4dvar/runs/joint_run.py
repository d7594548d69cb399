"""The kind of run that estimates data sets together which share parameters: those of a run whose configuration says so,
or of several finished runs (``en4dvar joint``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from en4dvar.config import Config
from en4dvar.estimation.joint import JointEstimate, Single, estimate_jointly
from en4dvar.estimation.joint.problem import JointProblem, sharing
from en4dvar.executor import Executor
from en4dvar.plumbing.errors import ConfigError
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.joint_file import FILE, StoredJoint, load_joint, save_joint
from en4dvar.runs.finished import Finished, carried
from en4dvar.runs.together import Tell, TogetherKind
from en4dvar.runs.trust import Ask

SPOILT = 1 / 3  # of the data sets: where more are warned of alike, the warning is serious for all together


def join(
    run_dirs: Sequence[Path],
    names: Sequence[str],
    out: Path,
    *,
    workers: int | None = None,
    trust: bool = False,
    ask: Ask | None = None,
    tell: Tell = lambda words: None,
) -> tuple[StoredJoint, Path]:
    """Estimate the data sets of finished runs together, with the parameters ``names`` in common, or what their
    configurations say where there are none; writes ``joint.nc``, ``joint.csv`` and ``joint.html`` to ``out``. Returns
    what was found and the path of the page.

    Settings of the ensemble and the seed are those of the first run.

    Raises
    ------
    RefusedError, OutputError: as of :meth:`~en4dvar.runs.together.TogetherKind.of_runs`. ConfigError: the data sets
        cannot share these parameters. TooFewMembersError: the ensemble is lost.
    """
    file, page = JointKind(tuple(names)).of_runs(run_dirs, out, workers, trust, ask, tell)
    return load_joint(file), page


@dataclass(frozen=True)
class JointKind(TogetherKind):
    """With ``names`` in common, or what the configurations share."""

    name = "joint"
    what = "joint estimate"
    fewest = 2
    result = FILE
    files = (FILE,)
    records = (f"{FOLDER}/joint",)
    pages = ("joint.html", "joint.csv")
    writer = "en4dvar.report.joint:write_joint"

    names: Sequence[str] = ()

    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        if not self.names and not any(dataset.groups for dataset in sets):
            raise ConfigError("nothing is shared: give --share NAME, or 'shared:' in the configurations of the runs")
        problems = tuple(dataset.problem for dataset in sets)
        groups = tuple(dataset.groups for dataset in sets)
        joint = sharing(problems, self.names) if self.names else JointProblem(problems, groups)
        singles = [Single.of_physical(dataset.problem.prior, dataset.members, dataset.centre) for dataset in sets]
        estimated = estimate_jointly(joint, config.assimilation, config.seed, executor, singles, tell)
        estimated = _with_carried(estimated, sets)
        alone = [dataset.members for dataset in sets]
        shared = " ".join(dict.fromkeys(name for name, _ in joint.shared))
        save_joint(path, estimated, alone, {**attributes, "seed": config.seed, "shared": shared})


def _with_carried(estimate: JointEstimate, sets: Sequence[Finished]) -> JointEstimate:
    """With the warnings of its data sets."""
    without = estimate.without
    if without is not None:
        without = _with_carried(without, [s for s in sets if s.name not in estimate.odd])
    return replace(estimate, cautions=(*estimate.cautions, *carried(sets, SPOILT)), without=without)
