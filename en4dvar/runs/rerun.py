"""``en4dvar rerun``: a run repeated from what its result files record, and compared with them to the last bit.

Configuration, seed and observations are those in the files, so that the data need not be there any more; the data of a
sequence are read again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.assembly.build import inverse_plan, problem_of
from en4dvar.config import AnyConfig, Config
from en4dvar.data.observations import SEVERAL
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import choose_executor, one_blas_thread
from en4dvar.results.campaign_file import failed_datasets
from en4dvar.results.netcdf import read_groups
from en4dvar.results.provenance import Identity, digest_of, identity, provenance
from en4dvar.results.run_results import result_files
from en4dvar.results.series_file import series_file
from en4dvar.results.store import StoredResult, load_stored
from en4dvar.runs.cycles import cycles_of
from en4dvar.runs.trust import Ask, of_strangers, recorded_config

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
        return not any(dataset.differ for dataset in self.sets)

    def __str__(self) -> str:
        lines = []
        for dataset in self.sets:
            told = "; ".join(dataset.differ) if dataset.differ else f"the same bits ({dataset.variables} variables)"
            lines.append(f"{dataset.name}: {told}{f'; {dataset.data}' if dataset.data else ''}")
        if self.failures:
            lines.append(f"not repeated, for they have no result: {', '.join(self.failures)}")
        if self.changed:
            lines.append(f"changed since the run:\n{self.changed}")
        return "\n".join([*lines, *self.surroundings])


def rerun(run_dir: str | Path, workers: int | None = None, *, trust: bool = False, ask: Ask | None = None) -> Rerun:
    """Repeat every estimate of a run and compare.

    ``run_dir``: of ``en4dvar run``. ``workers``: as of a run; the numbers do not depend on it. ``trust``: run whatever
    code the files name, a law or a model of a stranger's too. By default that is code below the working directory and
    of installed packages alone; for other code ``ask`` is asked, which gets the question.

    Raises :class:`RefusedError`: the files name other code, which is not trusted; nothing of it has run.
    :class:`OutputError`: there is no result, or it is damaged. :class:`ConfigError`: the recorded configuration cannot
    be used any more, for instance because the file of a user's own model is gone. :class:`TooFewMembersError`: the
    ensemble is lost.
    """
    run_dir = Path(run_dir)
    if cycles := series_file(run_dir):
        return _of_cycles(cycles, workers, trust, ask)
    campaign = run_dir / "posterior.nc"
    files = result_files(run_dir)
    first = load_stored(files[0])
    config = recorded_config(run_dir, first.attributes, trust, ask)
    assert isinstance(config, Config)
    repeated = []
    with one_blas_thread(), choose_executor(config.model, None, workers) as executor:
        for file in files:
            recorded = load_stored(file)
            observables = {series.name: series.observable for series in inverse_plan(config).series}
            problem = problem_of(config, recorded.observations(observables))
            analysis = assimilate(problem, config.assimilation, int(recorded.attributes["seed"]), executor)
            again = StoredResult.from_analysis(analysis, {})
            values = _values(recorded)
            differ = differences(values, _values(again))
            repeated.append(Repeated(recorded.name, len(values), differ, _data_file(recorded)))
    failures = failed_datasets(campaign) if files != [campaign] else {}
    return _compared(repeated, config, first.attributes, failures)


def _of_cycles(file: Path, workers: int | None, trust: bool, ask: Ask | None) -> Rerun:
    """Of a twin experiment or a sequence, whose data are read again. Raises as :func:`rerun`, :class:`DataError`."""
    recorded = read_groups(file)["/"]
    config = recorded_config(file.parent, recorded.attrs, trust, ask)
    assert not isinstance(config, Config)
    kind = cycles_of(config)
    with of_strangers(file.parent, ask, trust):  # data may have weights by a function
        kind.check()
    with choose_executor(config.model, workers=workers or 1) as executor:
        again = kind.again(executor)
    was, now = ({f"/{name}": v.values for name, v in result.every.items()} for result in (recorded, again))
    repeated = Repeated(config.name, len(was), differences(was, now), "")
    return _compared([repeated], config, recorded.attrs, {})


def _compared(
    sets: Sequence[Repeated], config: AnyConfig, attributes: Mapping[Any, Any], failures: Mapping[str, str]
) -> Rerun:
    now, was = provenance("", None), Identity(str(attributes["identity"]), ())
    changed = identity(config.resolved, config.model, {}).difference(was, frozenset())
    told = [(key, str(attributes[key]), now[key]) for key in SURROUNDINGS]
    surroundings = tuple(f"{key.replace('_', ' ')}: {old} → {new}" for key, old, new in told if old != new)
    return Rerun(tuple(sets), changed, surroundings, failures)


def _values(result: StoredResult) -> dict[str, np.ndarray]:
    return {f"{path}/{name}": v.stored for path, group in result.groups.items() for name, v in group.every.items()}


def differences(recorded: Mapping[str, np.ndarray], again: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Words for each variable, by its path, that is not the same to the bit."""
    told = []
    for name, values in recorded.items():
        if name not in again:
            told.append(f"{name} is missing")
        elif not _same_bits(values, again[name]):
            told.append(f"{name} differs{_by_how_much(values, again[name])}")
    return tuple(told)


def _same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape:
        return False
    if a.dtype.kind in "OUS":
        return bool(np.array_equal(a.astype(str), b.astype(str)))
    return a.dtype == b.dtype and a.tobytes() == b.tobytes()


def _by_how_much(a: np.ndarray, b: np.ndarray) -> str:
    if a.shape != b.shape or a.dtype.kind != "f":
        return ""
    if np.any(np.isnan(a) != np.isnan(b)):
        return ": other values are missing (NaN)"
    scale = float(np.nanmax(np.abs(a), initial=0.0)) or 1.0
    return f" by up to {float(np.nanmax(np.abs(a - b), initial=0.0)) / scale:.2g} of its largest value"


def _data_file(recorded: StoredResult) -> str:
    """What became of the data file; "" where it is as it was."""
    sources = [Path(text) for text in str(recorded.group("observed_data").attrs["data_source"]).split(SEVERAL)]
    source = next((path for path in sources if not path.is_file()), None)
    if source is not None:
        return f"{source} is gone, the recorded observations were used"
    if digest_of(sources) != recorded.attributes["data_sha256"]:
        return f"{SEVERAL.join(map(str, sources))} has changed since, the recorded observations were used"
    return ""
