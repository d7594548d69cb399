"""The data sets of finished runs, from what their result files record: for estimates of several, and for evidences."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.assembly.build import problem_of
from en4dvar.config import Config
from en4dvar.estimation.population.own import OwnDraws, own_draws
from en4dvar.executor import choose_executor, one_blas_thread
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, Severity, caution
from en4dvar.plumbing.errors import ConfigError, OutputError, retold
from en4dvar.plumbing.hints import free_name, listed
from en4dvar.plumbing.user_code import RefusedError
from en4dvar.problem import InverseProblem
from en4dvar.results.run_results import result_files
from en4dvar.results.store import StoredResult, load_stored
from en4dvar.runs.trust import Ask, recorded_config
from en4dvar.sampling.modes import TOO_FEW

CARRIED = ("implausible-data", "lost-frame", "misfit", "residual-structure", "model-validity")
MOST_NAMES = 4


@dataclass(frozen=True)
class Finished:
    """One data set: its problem, physical members (N, n) of its posterior that are alive, its centre (n,), warnings.

    ``white``: the members in white coordinates of the prior; ``groups``: what its configuration shares, and with whom;
    ``drawn``: draws of its posterior, where it was sampled. Data sets of one name in several runs get a number.
    """

    config: Config
    problem: InverseProblem
    members: Array
    white: Array
    centre: Array
    cautions: tuple[Caution, ...]
    groups: Mapping[str, str]
    drawn: OwnDraws | None

    @property
    def name(self) -> str:
        return self.problem.observations.name


def finished(run_dirs: Sequence[Path], trust: bool, ask: Ask | None) -> tuple[Config, list[Finished]]:
    """The configuration of the first run, and the data sets of all.

    Raises :class:`RefusedError`: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. :class:`OutputError`: there
    is no result, or it is damaged. :class:`ConfigError`: a data set of several series, or with parameters that vary in
    time.
    """
    first: Config | None = None
    sets: list[Finished] = []
    for run_dir in run_dirs:
        files = result_files(run_dir)
        config = recorded_config(run_dir, load_stored(files[0]).attributes, trust, ask)
        assert isinstance(config, Config)
        first = first or config
        sets += [finished_set(config, load_stored(file), run_dir) for file in files]
    if first is None:
        raise ConfigError("no run is given")
    return first, list(_named_apart(sets))


def carried(sets: Sequence[Finished], spoilt: float = 1.0) -> Iterator[Caution]:
    """Serious warnings of single data sets that hold for an estimate of all of them too, each code once.

    They are serious there where more than the share ``spoilt`` of the data sets has them. An estimate that tests its
    data sets against each other is not spoilt by what spoils a single interval.
    """
    for code in CARRIED:
        of_it = [(s.name, c) for s in sets for c in s.cautions if c.code == code and c.severity == "serious"]
        if of_it:
            told = f"{listed((name for name, _ in of_it), MOST_NAMES)}: {of_it[0][1].words}"
            severity: Severity = "serious" if len(of_it) > spoilt * len(sets) else "caution"
            yield caution(code, f"of single data sets, {told}", severity)


def finished_set(config: Config, result: StoredResult, run_dir: Path) -> Finished:
    """One data set of a run. Raises :class:`ConfigError`, :class:`OutputError`, see :func:`finished`."""
    if len(result.axes) > 1:  # files and pages of such estimates know one series a data set
        raise ConfigError(f"{run_dir}: {result.name} has several series; it cannot be estimated with others")
    problem = problem_of(config, result.observations())
    if problem.walks:
        raise ConfigError(f"{run_dir}: parameters that vary in time cannot be estimated with other data sets")
    names, prior = problem.prior.names, problem.prior
    columns = [np.asarray(result.parameters[name].values, dtype=float).ravel() for name in names]
    members = np.column_stack(columns)
    members = members[result.alive & np.isfinite(members).all(axis=1)]
    centre = result.centres(names)
    with retold(ValueError, OutputError, f"{result.name}: "):
        white = prior.white(prior.from_physical(np.vstack([members, centre])))
        drawn = _kept_draws(problem, result)
    groups = config.sharing.of_dataset(result.name)
    return Finished(config, problem, members, white[:-1], centre, result.cautions, groups, drawn)


def _kept_draws(problem: InverseProblem, result: StoredResult) -> OwnDraws | None:
    """The draws of a posterior that was sampled. Raises :class:`ValueError` for what no estimate keeps."""
    if (held := result.groups.get("/posterior_draws")) is None:
        return None
    stats = result.groups["/sample_stats"].attrs
    effective, log_evidence = (
        float(stats.get(key, np.nan)) for key in ("importance_effective_sample_size", "log_evidence")
    )
    draws = np.column_stack([np.asarray(held[name].values, dtype=float) for name in problem.prior.names])
    if not (effective > 0 and np.isfinite(log_evidence) and np.isfinite(draws).all()):
        raise ValueError("its draws are not finite, or nothing is said of them")
    return OwnDraws.kept(problem, draws, effective, log_evidence)


def _named_apart(sets: Sequence[Finished]) -> Iterator[Finished]:
    names: dict[str, None] = {}
    for s in sets:
        names[name := free_name(s.name, names)] = None
        observations = replace(s.problem.observations, name=name)
        yield replace(s, problem=replace(s.problem, observations=observations))


def sampled_evidences(run_dir: Path, workers: int | None, trust: bool, tell: Callable[[str], None]) -> dict[str, float]:
    """Data set → log-evidence, by the draws that its estimate has kept or by its own, where enough are effective.
    ``tell`` gets a line where there are none: a model that is not cheap, draws that fail, code that is not run unasked.
    """
    try:
        config, sets = finished([run_dir], trust, None)
        if not all(s.problem.model.cheap for s in sets):
            raise ConfigError("its model is not cheap")
        with choose_executor(config.model, None, workers) as executor, one_blas_thread():
            drawn = [s.drawn or own_draws(s.problem, s.white, config.seed, executor) for s in sets]
    except (ConfigError, OutputError, RefusedError, ValueError) as error:
        tell(f"{run_dir}: evidence by Laplace's approximation, as stored: {error}")
        return {}
    return {
        s.name: draws.log_evidence - s.problem.observations.log_normalisation()
        for s, draws in zip(sets, drawn, strict=True)
        if draws.effective >= TOO_FEW
    }
