"""``en4dvar.estimate``: a function, arrays and priors instead of a file; from there on it is a run like any other.

The arguments become the configuration that a file would hold, and the arrays the data file ``data.csv`` of the run
directory, so that everything a configuration can say can be said here, in the same words.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.config.document import document_of
from en4dvar.config.load import Config, resolve
from en4dvar.config.models import HANDED, read_model
from en4dvar.errors import ConfigError, DataError, Fault, OutputError
from en4dvar.files import make_folder, write_text
from en4dvar.forward import ForwardModel
from en4dvar.function_model import FunctionModel, digest_of, name_of
from en4dvar.inputs.arrays import TIME, columns_of, csv_of, require_columns
from en4dvar.report.result import Result
from en4dvar.runs.progress import terminal_progress
from en4dvar.runs.rundir import GIVEN, holds_run
from en4dvar.runs.runner import run_campaign
from en4dvar.state import NOISE_SCALE, TIME_SHIFT, Array, Parameter
from en4dvar.storage.checkpoint import digest

ARGUMENTS = {("data", "error"): "error", ("data", "window"): "window", ("parameters",): "priors"}
ARRAYS = "arrays of a script"


def estimate(
    model: Callable[[dict[str, float], Array], Any] | ForwardModel | type[ForwardModel] | Mapping[str, Any] | str,
    data: Any,
    priors: Mapping[str, Any],
    *,
    error: Any,
    units: Mapping[str, str] | None = None,
    time: str = TIME,
    observable: str | None = None,
    window: Mapping[str, Any] | None = None,
    name: str = "estimate",
    seed: int = 0,
    directory: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    report: bool = True,
    progress: bool = True,
    **sections: Any,
) -> Result:
    """Estimate parameters of a model from readings that a script holds.

    Parameters
    ----------
    model: a function ``f(parameters, times) -> values`` (see :class:`~en4dvar.function_model.FunctionModel`), a
        :class:`~en4dvar.forward.ForwardModel`, its class, or what the ``model:`` section of a file says.
    data: (times, values), a dict of columns, a pandas Series or DataFrame, an xarray DataArray or Dataset, in the units
        of the model. NaN is no reading.
    priors: name → prior, as in a file: ``{"prior": "lognormal", "median": 4, "log_std": 0.5}``; a number fixes a
        parameter. ``t_s`` is a time shift, ``sigma`` the noise scale.
    error: std of the readings: a number, one a reading, text such as ``"1 % of maximum"``, or a dict as ``data.error``
        of a file, in which an array is one number a reading.
    units: of a function's parameters, values (by name) and of ``"time"``; by default none has one.
    time: name of the column, index or coordinate of times.
    observable: what the values are, by its name in the model or the column; by default the only one there is.
    window: as ``data.window`` of a file.
    directory: of the run, with files and report as of :func:`en4dvar.run`; by default nothing is kept on disk.
    force, resume: replace or continue the run in the directory.
    progress: show it on a terminal or in a notebook.
    sections: further sections of a file by name: ``assimilation``, ``execution``, ``initial_state``, ``model_error``.

    Raises
    ------
    ConfigError, DataError: says which argument, and what to do. Others as of :func:`en4dvar.run`.
    """
    try:
        columns = columns_of(data, time, observable or _only(model))
    except DataError as problem:
        raise DataError(f"data: {problem}") from None
    given = _Given(columns, observable, error, dict(units or {}), dict(priors))
    ready, model_section = given.model(model)
    content = {
        "name": name,
        "seed": seed,
        "model": model_section,
        "data": {**given.data(ready), **({"window": window} if window else {})},
        "parameters": priors,
        "output": {"report": report and directory is not None},
        **sections,
    }
    with ExitStack() as held:
        where = Path(directory or Path(held.enter_context(tempfile.TemporaryDirectory())) / "run")
        config = replace(_checked(content, where, ready), directory=where)
        _keep_data(where / GIVEN, csv_of(given.used), resume or force)
        shown = held.enter_context(terminal_progress(1)) if progress else None
        campaign = run_campaign(config, force=force, resume=resume, progress=shown, command="en4dvar.estimate")
        (result,) = campaign
    if directory is None:
        result.tree["observed_data"].attrs["data_source"] = result.tree.attrs["data_source"] = ARRAYS
    return result


class _Given:
    """The arguments, and the columns that are ``used``."""

    def __init__(
        self, columns: Mapping[str, Array], observable: str | None, error: Any, units: dict[str, str], priors: Any
    ):
        self.columns, self.observable, self.error, self.units, self.priors = columns, observable, error, units, priors
        self.used: dict[str, Array] = {TIME: columns[TIME]}

    def model(self, model: Any) -> tuple[ForwardModel, dict[str, Any]]:
        """The model, and what a configuration records of it. Raises :class:`ConfigError`."""
        if isinstance(model, str | Mapping):
            section = {"name": model} if isinstance(model, str) else dict(model)
            faults: list[Fault] = []
            found = read_model(section, Path.cwd(), document_of({"model": section}), faults)
            if found is None:
                raise ConfigError(faults)
            return found
        if isinstance(model, type) and issubclass(model, ForwardModel):
            model = model()
        if isinstance(model, ForwardModel):
            return model, {"name": HANDED, "object": name_of(type(model)), "digest": _digest_of_model(model)}
        if not callable(model):
            raise ConfigError(f"model: {type(model).__name__} is neither a function nor a model; {_MODELS}")
        section = {"name": HANDED, "object": name_of(model), "digest": digest_of(model)}
        return self._function(model), section

    def _function(self, function: Any) -> FunctionModel:
        unknown = self.units.keys() - self.priors.keys() - self.columns.keys()
        if unknown:
            raise ConfigError(
                f"units: {sorted(unknown)[0]!r} is neither a parameter in priors nor a column of the data"
            )
        names = [name for name in self.priors if name not in (TIME_SHIFT.name, NOISE_SCALE.name)]
        if wrong := [name for name in names if not str(name).isidentifier()]:
            raise ConfigError(f"priors: {wrong[0]!r} is no name of a parameter; write letters, digits and _")
        parameters = [Parameter(name, self.units.get(name, "1")) for name in names]
        observed = self.observed([name for name in self.columns if name != TIME])
        return FunctionModel(function, parameters, {observed: self.units.get(observed, "1")}, self.units.get(TIME, "1"))

    def observed(self, known: list[str]) -> str:
        """The name of what was observed, of the ``known`` ones. Raises :class:`ConfigError`."""
        if self.observable is not None:
            return self.observable
        others = [name for name in known if name in self.columns and name not in _columns_in(self.error)]
        if len(others) != 1:
            there = ", ".join(name for name in self.columns if name != TIME)
            raise ConfigError(f"observable: name the column of readings, one of: {there}")
        return others[0]

    def data(self, model: ForwardModel) -> dict[str, Any]:
        """The ``data:`` section, apart from the window. Raises :class:`DataError`, :class:`ConfigError`."""
        named = {one.name: one for one in model.observables}
        name = self.observed(list(named))
        if name not in named:
            raise ConfigError(f"observable: the model has no {name!r}; it has: {', '.join(named)}")
        unit = named[name].unit
        error = self._error(name, unit)
        try:
            require_columns(self.columns, [name, *_columns_in(self.error)])
        except DataError as problem:
            raise DataError(f"data: {problem}") from None
        self.used |= {column: self.columns[column] for column in (name, *_columns_in(self.error))}
        return {
            "path": GIVEN,
            "columns": {TIME: {"name": TIME, "unit": model.time_unit}, name: {"name": name, "unit": unit}},
            "error": error,
        }

    def _error(self, name: str, unit: str) -> dict[str, Any]:
        """What a file says in ``data.error``; errors of each reading become columns."""
        error = dict(self.error) if isinstance(self.error, Mapping) else {f"{name}_std": self.error}
        for key, value in error.items():
            if np.ndim(value) == 1 and not isinstance(value, str | Mapping):
                error[key] = {"column": f"error {key}"}
                self.used[f"error {key}"] = self._one_each(np.asarray(value, dtype=float), key)
            elif key == f"{name}_std" and isinstance(value, int | float | np.number) and unit != "1":
                error[key] = f"{float(value)!r} {unit}"
        return error

    def _one_each(self, values: Array, key: str) -> Array:
        if len(values) != len(self.columns[TIME]):
            raise DataError(f"error: {key} has {len(values)} numbers for {len(self.columns[TIME])} readings")
        return values


_MODELS = "give f(parameters, times), a ForwardModel, or a dict such as {'name': 'bubble'}"


def _columns_in(error: Any) -> list[str]:
    """The columns of errors that ``error`` names."""
    values = error.values() if isinstance(error, Mapping) else ()
    return [str(value["column"]) for value in values if isinstance(value, Mapping) and "column" in value]


def _only(model: Any) -> str:
    """What values without a name are called: the model's first observable, else y."""
    observables = getattr(model, "observables", ())
    return observables[0].name if isinstance(observables, tuple) and observables else "y"


def _digest_of_model(model: ForwardModel) -> str:
    """Of a model's settings: what it says when it is sent to a worker; "" where it cannot be."""
    try:
        return digest(pickle.dumps(model))
    except Exception:
        return ""


def _checked(content: Mapping[str, Any], directory: Path, model: ForwardModel) -> Config:
    """The configuration. Raises :class:`ConfigError` in the words of the arguments."""
    try:
        return resolve(document_of(content), directory.absolute(), model)
    except ConfigError as error:
        raise ConfigError([replace(fault, path=_argument(fault.path)) for fault in error.problems]) from None


def _argument(path: str) -> str:
    parts = tuple(path.split("."))
    for place, argument in ARGUMENTS.items():
        if parts[: len(place)] == place:
            return ".".join((argument, *parts[len(place) :]))
    return path


def _keep_data(path: Path, text: str, replaces: bool) -> None:
    """Write the readings into the run directory. Raises :class:`OutputError` where another file would be lost."""
    make_folder(path.parent)
    old = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else text
    if old != text and not (replaces and holds_run(path.parent)):
        raise OutputError(
            f"{path}: holds other readings; choose another directory, or give force=True to replace a run"
        )
    write_text(path, text)
