"""``en4dvar.estimate``: a function, arrays and priors instead of a file; from there on it is a run like any other.

The arguments become the configuration that a file would hold, and the arrays the data file ``data.csv`` of the run
directory, so that everything a configuration can say can be said here, in the same words.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from en4dvar.config.document import document_of
from en4dvar.config.load import resolve
from en4dvar.config.sequence import resolve_sequence
from en4dvar.diagnosis.analysis import Progress
from en4dvar.inputs.arrays import TIME
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.plumbing.files import make_folder, temporary_folder, write_text
from en4dvar.report.result import Result
from en4dvar.report.sequence import SequenceOutcome
from en4dvar.runs.given import Given
from en4dvar.runs.progress import terminal_progress
from en4dvar.runs.rundir import holds_run
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.sequence_run import run_sequence

ARGUMENTS = {
    ("data", "error"): "error",
    ("data", "window"): "window",
    ("data", "series"): "series",
    ("data", "correlation"): "correlation",
    ("parameters",): "priors",
    ("sequence", "initial_std"): "initial_std",
}
ARRAYS = "arrays of a script"


def estimate(
    model: Callable[[dict[str, float], Array], Any] | ForwardModel | type[ForwardModel] | Mapping[str, Any] | str,
    data: Any,
    priors: Mapping[str, Any],
    *,
    error: Any,
    units: Mapping[str, str] | None = None,
    time: str = TIME,
    observable: str | Sequence[str] | None = None,
    series: Mapping[str, Mapping[str, Any]] | None = None,
    correlation: Mapping[str, Mapping[str, float]] | None = None,
    window: Mapping[str, Any] | None = None,
    name: str = "estimate",
    seed: int = 0,
    directory: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    report: bool = True,
    progress: bool | Progress = True,
    **sections: Any,
) -> Result:
    """Estimate parameters of a model from readings that a script holds.

    Parameters
    ----------
    model: a function ``f(parameters, times) -> values`` (see :class:`~en4dvar.model.function_model.FunctionModel`), a
        :class:`~en4dvar.model.forward.ForwardModel`, its class, or what the ``model:`` section of a file says.
    data: (times, values), a dict of columns, a pandas Series or DataFrame, an xarray DataArray or Dataset, in the units
        of the model. NaN is no reading. Or a dict of several series, name → one of these, each with its own times; its
        name is that of its observable, and ``error`` is then a dict name → error. A function is asked for all times
        together, the union of those of the series, and returns a dict of arrays.
    priors: name → prior, as in a file: ``{"prior": "lognormal", "median": 4, "log_std": 0.5}``; a number fixes a
        parameter. ``t_s`` is a time shift, ``sigma`` the noise scale, ``reading_scale`` that of the predictions.
    error: std of the readings: a number, one a reading, text such as ``"1 % of maximum"``, or a dict as ``data.error``
        of a file, in which an array is one number a reading, and of ``covariance`` the matrix (K, K) of all readings.
    units: of a function's parameters, values (by name) and of ``"time"``; by default none has one.
    time: name of the column, index or coordinate of times.
    observable: what the values are, by its name in the model or the column; by default the only one there is. A list:
        several columns of one table, each a series.
    series: of several series, name → what ``data.series`` of a file says besides: ``{"observable": "head", "places":
        {"column": "cell"}, "weights": [1, 0, 1]}``.
    correlation: of the errors of two series at equal times, ``{"prey": {"predator": 0.5}}``.
    window: as ``data.window`` of a file.
    directory: of the run, with files and report as of :func:`en4dvar.run`; by default nothing is kept on disk.
    force, resume: replace or continue the run in the directory.
    progress: show it on a terminal or in a notebook; or a function that is called as that of :func:`en4dvar.run`, with
        the name of the data set and the record of each iteration.
    sections: further sections of a file by name: ``assimilation``, ``execution``, ``initial_state``, ``model_error``;
        ``prior={"ensemble": {"k": array}}`` may hold the members themselves.

    Raises
    ------
    ConfigError, DataError: says which argument, and what to do. Others as of :func:`en4dvar.run`.
    """
    call = Given(model, data, time, observable, error, units or {}, priors, series or {}, correlation)
    ready, model_section = call.model(model)
    content = {
        "name": name,
        "seed": seed,
        "model": model_section,
        "data": {**call.data(ready), **({"window": window} if window else {})},
        "parameters": priors,
        "output": {"report": report and directory is not None},
        **{key: call.prior(section) if key == "prior" else section for key, section in sections.items()},
    }
    with ExitStack() as held:
        where = Path(directory or Path(held.enter_context(temporary_folder())) / "run")
        _keep_data(where, call.beside, resume or force)  # which the configuration reads
        with _words_of_arguments():
            config = resolve(document_of(content), where.absolute(), ready)
        config = replace(config, directory=where)
        _keep_data(where, call.files, resume or force)
        shown = progress if callable(progress) else held.enter_context(terminal_progress()) if progress else None
        (result,) = run_campaign(config, force=force, resume=resume, progress=shown, command="en4dvar.estimate")
    if directory is None:
        for path in ("/", "/observed_data"):
            result = result.with_attributes(path, data_source=ARRAYS)
    return result


def estimate_sequence(
    model: ForwardModel | type[ForwardModel] | Mapping[str, Any] | str,
    data: Any,
    priors: Mapping[str, Any] | None = None,
    *,
    error: Any,
    initial_std: Mapping[str, Any] | None = None,
    time: str = TIME,
    observable: str | Sequence[str] | None = None,
    series: Mapping[str, Mapping[str, Any]] | None = None,
    correlation: Mapping[str, Mapping[str, float]] | None = None,
    name: str = "sequence",
    seed: int = 0,
    directory: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    report: bool = True,
    **sections: Any,
) -> SequenceOutcome:
    """Follow a series of readings that a script holds, by a filter or a sliding-window smoother.

    Parameters
    ----------
    model: with ``step`` or ``resumed``; data, priors, error, time, observable, series, correlation, directory, force,
        resume: as of :func:`estimate`.
    initial_std: spread of the initial state by field, as ``sequence.initial_std`` of a file.
    sections: further sections of a file by name: ``assimilation`` (required), ``model_error``, ``execution``.

    Raises
    ------
    ConfigError, DataError: says which argument, and what to do. Others as of :func:`run_sequence`.
    """
    call = Given(model, data, time, observable, error, {}, priors or {}, series or {}, correlation)
    ready, model_section = call.model(model)
    content = {
        "name": name,
        "seed": seed,
        "model": model_section,
        "data": call.data(ready),
        "parameters": priors or {},
        "sequence": {"initial_std": initial_std or {}},
        "output": {"report": report and directory is not None},
        **sections,
    }
    with ExitStack() as held:
        where = Path(directory or Path(held.enter_context(temporary_folder())) / "run")
        with _words_of_arguments():
            config = resolve_sequence(document_of(content), where.absolute(), ready)
        config = replace(config, directory=where)
        _keep_data(where, call.files, resume or force)
        return run_sequence(config, force=force, resume=resume, command="en4dvar.estimate_sequence")


@contextmanager
def _words_of_arguments() -> Iterator[None]:
    """Within, a :class:`ConfigError` is raised in the words of the arguments."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError([replace(fault, path=_argument(fault.path)) for fault in error.problems]) from None


def _argument(path: str) -> str:
    parts = tuple(path.split("."))
    if parts[:2] == ("data", "series") and parts[3:4] == ("error",):
        return ".".join(("error", parts[2], *parts[4:]))
    for place, argument in ARGUMENTS.items():
        if parts[: len(place)] == place:
            return ".".join((argument, *parts[len(place) :]))
    return path


def _keep_data(directory: Path, files: Mapping[str, str], replaces: bool) -> None:
    """Write the arrays into the run directory. Raises :class:`OutputError` where another file would be lost."""
    for path, text in ((directory / name, text) for name, text in files.items()):
        old = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else text
        if old != text and not (replaces and holds_run(directory)):
            words = "holds other readings; choose another directory, or give force=True to replace a run"
            raise OutputError(f"{path}: {words}")
        make_folder(directory)
        write_text(path, text)
