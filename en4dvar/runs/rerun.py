"""``en4dvar rerun``: a run repeated from what its result files record, and compared with them to the last bit.

Configuration, seed and observations are those in the files, so that the data need not be there any more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from en4dvar.assimilate import assimilate
from en4dvar.config.build import inverse_plan, problem_of
from en4dvar.config.document import parse_document
from en4dvar.config.load import resolve
from en4dvar.errors import OutputError
from en4dvar.executor import choose_executor, one_blas_thread
from en4dvar.observations import SEVERAL
from en4dvar.report.result import Result, load_result
from en4dvar.runs.trust import Ask, of_strangers
from en4dvar.storage.campaign_file import failed_datasets
from en4dvar.storage.fingerprint import Identity, digest_of, identity
from en4dvar.storage.provenance import provenance
from en4dvar.storage.store import result_files

SURROUNDINGS = ("python_version", "package_versions", "platform", "cpu", "git_commit")


@dataclass(frozen=True)
class Repeated:
    """One data set: how many variables were compared, which of them ``differ`` and by how much, and about its file."""

    name: str
    variables: int
    differ: tuple[str, ...]
    data: str


@dataclass(frozen=True)
class Rerun:
    """``changed``: a diff of what decides the numbers (configuration, versions, sources), from the run to now;
    ``surroundings``: what else is different now; ``failures``: data sets without a result, which are not repeated."""

    sets: tuple[Repeated, ...]
    changed: str
    surroundings: tuple[str, ...]
    failures: Mapping[str, str]

    @property
    def same(self) -> bool:
        """Whether every bit is."""
        return not any(one.differ for one in self.sets)

    def __str__(self) -> str:
        lines = []
        for one in self.sets:
            told = "; ".join(one.differ) if one.differ else f"the same bits ({one.variables} variables)"
            lines.append(f"{one.name}: {told}{f'; {one.data}' if one.data else ''}")
        if self.failures:
            lines.append(f"not repeated, for they have no result: {', '.join(self.failures)}")
        if self.changed:
            lines.append(f"changed since the run:\n{self.changed}")
        return "\n".join([*lines, *self.surroundings])


def rerun(run_dir: str | Path, workers: int | None = None, *, trust: bool = False, ask: Ask | None = None) -> Rerun:
    """Repeat every estimate of a run and compare.

    Parameters
    ----------
    run_dir: of ``en4dvar run``. workers: as of a run; the numbers do not depend on it.
    trust: run whatever code the files name, a law or a model of a stranger's too. By default that is code below the
        working directory and of installed packages alone; for other code ``ask`` is asked, which gets the question.

    Raises
    ------
    RefusedError: the files name other code, which is not trusted; nothing of it has run.
    OutputError: there is no result, or it is damaged. ConfigError: the recorded configuration cannot be used any more,
        for instance because the file of a user's own model is gone. TooFewMembersError: the ensemble is lost.
    """
    run_dir = Path(run_dir)
    campaign = run_dir / "posterior.nc"
    files = result_files(run_dir)
    first = load_result(files[0])
    if "identity" not in first.attributes:
        raise OutputError(f"{files[0]}: does not record all that a run is made of; it was written by a program")
    document = parse_document(str(first.attributes["configuration_resolved"]), f"{files[0]}: configuration_resolved")
    with of_strangers(run_dir, ask, trust):
        config = resolve(document, run_dir.absolute())
    now = provenance("", None)
    was = {key: str(first.attributes[key]) for key in SURROUNDINGS}
    repeated = []
    with one_blas_thread(), choose_executor(config.model, None, workers) as executor:
        for file in files:
            recorded = load_result(file)
            observables = {one.name: one.observable for one in inverse_plan(config).series}
            problem = problem_of(config, recorded.observations(observables))
            analysis = assimilate(problem, config.assimilation, int(recorded.attributes["seed"]), executor)
            again = Result.from_analysis(analysis, {})
            variables, differ = differences(recorded, again)
            repeated.append(Repeated(recorded.name, variables, differ, _data_file(recorded)))
    return Rerun(
        tuple(repeated),
        identity(config.resolved, config.model, {}).difference(
            Identity(str(first.attributes["identity"]), ()), frozenset()
        ),
        tuple(f"{key.replace('_', ' ')}: {was[key]} → {now[key]}" for key in SURROUNDINGS if was[key] != now[key]),
        failed_datasets(campaign) if files != [campaign] else {},
    )


def differences(recorded: Result, again: Result) -> tuple[int, tuple[str, ...]]:
    """Number of variables compared, and the words for each that is not the same to the bit."""
    count, told = 0, []
    for path, node in recorded.tree.to_dict().items():
        other = again.tree.children.get(path.strip("/"))
        variables = other.to_dataset() if other is not None else xr.Dataset()
        for name, variable in node.variables.items():
            count += 1
            if name not in variables.variables:
                told.append(f"{path}/{name} is missing")
            elif not _same_bits(variable.values, variables[name].values):
                told.append(f"{path}/{name} differs{_by_how_much(variable.values, variables[name].values)}")
    return count, tuple(told)


def _same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape:
        return False
    if a.dtype.kind in "OUS":
        return bool(np.array_equal(a.astype(str), b.astype(str)))
    return a.dtype == b.dtype and a.tobytes() == b.tobytes()


def _by_how_much(a: np.ndarray, b: np.ndarray) -> str:
    if a.shape != b.shape or a.dtype.kind != "f":
        return ""
    scale = float(np.nanmax(np.abs(a), initial=0.0)) or 1.0
    return f" by up to {float(np.nanmax(np.abs(a - b), initial=0.0)) / scale:.2g} of its largest value"


def _data_file(recorded: Result) -> str:
    """What became of the data file; "" where it is as it was."""
    sources = [Path(text) for text in str(recorded.observed_data.attrs["data_source"]).split(SEVERAL)]
    source = next((path for path in sources if not path.is_file()), None)
    if source is not None:
        return f"{source} is gone, the recorded observations were used"
    if digest_of(sources) != recorded.attributes["data_sha256"]:
        return f"{SEVERAL.join(map(str, sources))} has changed since, the recorded observations were used"
    return ""
