"""What a script hands over, readings, errors and a model, as the sections of a configuration and one data file."""

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.config.document import document_of
from en4dvar.config.models import HANDED, read_model
from en4dvar.inputs.arrays import TIME, VALUE, columns_of, csv_of, require_columns, stacked, tables_of
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.model.function_model import FunctionModel, digest_of, name_of
from en4dvar.model.state import OF_READINGS, Array, Parameter
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, retold
from en4dvar.plumbing.hints import listed, suggest
from en4dvar.results.checkpoint import digest
from en4dvar.runs.rundir import GIVEN

MODELS = "give f(parameters, times), a ForwardModel, or a dict such as {'name': 'lorenz63'}"


@dataclass
class GivenSeries:
    """One series: its ``columns``, what they are of and their ``error``.

    ``name``: "" of a single one, else that in front of its columns in the data file. ``more``: what it says besides, as
    in ``data.series``. ``used``: the columns that go to the file, by their names there; ``files``: others, with text.
    """

    name: str
    columns: Mapping[str, Array]
    observable: str | None
    error: Any
    more: Mapping[str, Any] = field(default_factory=dict)
    used: dict[str, Array] = field(init=False)
    files: dict[str, str] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.used = {TIME: self.columns[TIME]}

    def observed(self, known: Sequence[str]) -> str:
        """The name of what was observed, of the ``known`` ones. Raises :class:`ConfigError`."""
        if self.observable is not None:
            return self.observable
        others = [name for name in known if name in self.columns and name not in _columns_in(self.error)]
        if len(others) != 1:
            there = ", ".join(name for name in self.columns if name != TIME)
            raise ConfigError(f"observable: name the column of readings, one of: {there}")
        return others[0]

    def section(self, model: ForwardModel) -> dict[str, Any]:
        """What ``data:`` says of it, apart from the path. Raises :class:`DataError`, :class:`ConfigError`."""
        named = {observable.name: observable for observable in model.observables}
        name = self.observed(list(named))
        if name not in named:
            where = f"data: {self.name}" if self.name else "observable"
            raise ConfigError(f"{where}: the model has no {name!r}; it has: {', '.join(named)}")
        readings = {"name": self._kept(self._readings(name)), "unit": named[name].unit}
        return {
            "columns": {TIME: {"name": TIME, "unit": model.time_unit}, name: readings},
            "error": {key: self._placed(value) for key, value in self._error(named[name]).items()},
            **{key: self._placed(value) for key, value in self.more.items()},
        }

    def _readings(self, observable: str) -> str:
        """The column of readings: of several series each may call it after itself, or have no other."""
        if not self.name or observable in self.columns:
            return observable
        beside = _columns_in(self.error) + _columns_in(self.more)
        others = [name for name in self.columns if name != TIME and name not in beside]
        if self.name not in self.columns and len(others) != 1:
            raise DataError(f"data: {self.name}: which column holds the readings? Call it {observable!r}")
        return self.name if self.name in self.columns else others[0]

    def _kept(self, column: str) -> str:
        """What a column is called in the data file, which it goes to. Raises :class:`DataError`."""
        with retold(DataError, DataError, f"data: {self._of()}"):
            require_columns(self.columns, [column])
        name = column if self.name in ("", column) else f"{self.name} {column}"
        self.used[name] = self.columns[column]
        return name

    def _placed(self, value: Any) -> Any:
        """The same, with the file's names of columns."""
        if isinstance(value, list):
            return [self._placed(part) for part in value]
        named = isinstance(value, Mapping) and "column" in value and value["column"] not in self.used
        return {**value, "column": self._kept(str(value["column"]))} if named else value

    def _error(self, observable: Observable) -> dict[str, Any]:
        """What a file says in ``data.error``; errors of each reading become columns."""
        std, unit = f"{observable.name}_std", observable.unit
        error = dict(self.error) if isinstance(self.error, Mapping) else {std: self.error}
        for key, value in error.items():
            if key == "shared":
                parts = np.asarray(value).T if hasattr(value, "shape") else value
                error[key] = [self._stated(part, f"shared {i}", unit) for i, part in enumerate(parts, 1)]
            elif key == "covariance" and np.ndim(value) == 2:
                file = f"data.{self.name}.covariance.csv".replace("..", ".")
                self.files[file] = "".join(",".join(map(repr, row)) + "\n" for row in np.asarray(value, float).tolist())
                error[key] = {"path": file, "unit": "1" if unit == "1" else f"({unit})*({unit})"}
            else:
                error[key] = self._stated(value, key, unit if key == std else "1")
        return error

    def _stated(self, value: Any, key: str, unit: str) -> Any:
        """A number in ``unit``; numbers of each reading as a column of the data file."""
        if isinstance(value, int | float | np.number) and not isinstance(value, bool) and unit != "1":
            return f"{float(value)!r} {unit}"
        if np.ndim(value) != 1:
            return value
        if len(value) != len(self.columns[TIME]):
            counts = f"{len(value)} numbers for {len(self.columns[TIME])} readings"
            raise DataError(f"error: {self._of()}{key} has {counts}")
        column = f"{self.name} error {key}".lstrip()
        self.used[column] = np.asarray(value, dtype=float)
        return {"column": column}

    def _of(self) -> str:
        return f"{self.name}: " if self.name else ""


class Given:
    """The arguments of :func:`~en4dvar.runs.estimate.estimate`.

    Raises :class:`DataError` for readings in no form that is known, :class:`ConfigError` where ``error``, ``series`` or
    ``correlation`` do not suit the series.
    """

    def __init__(
        self, model: Any, data: Any, time: str, observable: str | Sequence[str] | None, error: Any,
        units: Mapping[str, str], priors: Mapping[str, Any], series: Mapping[str, Any], correlation: Any,
    ):  # fmt: skip
        self.units, self.priors, self.correlation = units, priors, correlation
        self.beside: dict[str, str] = {}
        with retold(DataError, DataError, "data: "):
            tables = tables_of(data, time, None if isinstance(observable, str) else observable)
        self.alone = tables is None
        if tables is not None:
            if isinstance(observable, str):
                raise ConfigError("observable: of several series each says its own: series={'name': {'observable': …}}")
            _check_keys("error", error, tables, whole=True)
            _check_keys("series", series, tables)
            self.series = [
                self._one(name, table, time, error[name], series.get(name, {})) for name, table in tables.items()
            ]
            return
        if series or correlation:
            raise ConfigError(f"{'series' if series else 'correlation'}: data is one series, not a dict of several")
        chosen = observable if isinstance(observable, str) else None
        columns = _columns("data", data, time, chosen or _only(model))
        self.series = [GivenSeries("", columns, chosen, error)]

    def _one(self, name: str, table: Any, time: str, error: Any, more: Mapping[str, Any]) -> GivenSeries:
        chosen = str(more.get("observable", name))
        return GivenSeries(name, _columns(f"data: {name}", table, time, chosen), chosen, error, more)

    def prior(self, section: Any) -> Any:
        """The ``prior:`` section, with a file for an ensemble of arrays. Raises :class:`DataError`."""
        if not (isinstance(section, Mapping) and isinstance(members := section.get("ensemble"), Mapping)):
            return section
        columns = {name: np.asarray(values, dtype=float) for name, values in members.items()}
        if len({values.shape for values in columns.values()}) != 1 or next(iter(columns.values())).ndim != 1:
            raise DataError("prior: give one number a member for each parameter, of all the same number of members")
        self.beside["data.prior.csv"] = csv_of(columns)
        return {**section, "ensemble": "data.prior.csv"}

    @property
    def files(self) -> dict[str, str]:
        """Names of the data file and of those beside it, and their texts."""
        beside = dict(item for series in self.series for item in series.files.items())
        return {GIVEN: csv_of(stacked([series.used for series in self.series])), **beside, **self.beside}

    def data(self, model: ForwardModel) -> dict[str, Any]:
        """The ``data:`` section, apart from the window. Raises :class:`DataError`, :class:`ConfigError`."""
        if self.alone:
            return {"path": GIVEN, **self.series[0].section(model)}
        correlation = {"correlation": self.correlation} if self.correlation else {}
        return {"path": GIVEN, "series": {series.name: series.section(model) for series in self.series}, **correlation}

    def model(self, model: Any) -> tuple[ForwardModel, dict[str, Any]]:
        """The model, and what a configuration records of it. Raises :class:`ConfigError`."""
        if isinstance(model, str | Mapping):
            section = {"name": model} if isinstance(model, str) else dict(model)
            faults: list[Fault] = []
            built = read_model(section, Path.cwd(), document_of({"model": section}), faults)
            if built is None:
                raise ConfigError(faults)
            return built
        if isinstance(model, type) and issubclass(model, ForwardModel):
            model = model()
        if isinstance(model, ForwardModel):
            return model, {"name": HANDED, "object": name_of(type(model)), "digest": _digest_of_model(model)}
        if not callable(model):
            raise ConfigError(f"model: {type(model).__name__} is neither a function nor a model; {MODELS}")
        section = {"name": HANDED, "object": name_of(model), "digest": digest_of(model)}
        return self._function(model), section

    def _function(self, function: Any) -> FunctionModel:
        names = [name for name in self.priors if name not in {p.name for p in OF_READINGS}]
        if wrong := [name for name in names if not str(name).isidentifier()]:
            raise ConfigError(f"priors: {wrong[0]!r} cannot be the name of a parameter; use letters, digits and _")
        columns = {name for series in self.series for name in series.columns}
        observed = [series.observed([name for name in series.columns if name != TIME]) for series in self.series]
        unknown = self.units.keys() - self.priors.keys() - columns - set(observed)
        if unknown:
            raise ConfigError(
                f"units: {sorted(unknown)[0]!r} is neither a parameter in priors nor a column of the data"
            )
        parameters = [Parameter(name, self.units.get(name, "1")) for name in names]
        observables = {name: self.units.get(name, "1") for name in observed}
        return FunctionModel(function, parameters, observables, self.units.get(TIME, "1"))


def _check_keys(argument: str, keys: Any, series: Mapping[str, Any], whole: bool = False) -> None:
    """Raise :class:`ConfigError` unless it is a dict with one entry a series, each of them where it shall be whole."""
    if not isinstance(keys, Mapping):
        raise ConfigError(f"{argument}: give a dict with one for each series: {listed(series)}")
    if unknown := [str(name) for name in keys if name not in series]:
        raise ConfigError(f"{argument}: no series {unknown[0]!r} in data{suggest(unknown[0], series)}")
    if missing := [name for name in series if whole and name not in keys]:
        raise ConfigError(f"{argument}: none for {missing[0]!r}; give one for each series: {listed(series)}")
    if wrong := [name for name, own in keys.items() if not (whole or isinstance(own, Mapping))]:
        raise ConfigError(f"{argument}: {wrong[0]}: give a dict such as {{'observable': 'y'}}")


def _columns(where: str, table: Any, time: str, value: str) -> dict[str, Array]:
    with retold(DataError, DataError, f"{where}: "):
        return columns_of(table, time, value)


def _columns_in(sections: Any) -> list[str]:
    """The columns that ``error``, or what a series says besides, names."""
    values = list(sections.values()) if isinstance(sections, Mapping) else []
    values += [part for value in values if isinstance(value, list) for part in value]
    return [str(value["column"]) for value in values if isinstance(value, Mapping) and "column" in value]


def _only(model: Any) -> str:
    """What values without a name are called: the model's first observable, else y."""
    observables = getattr(model, "observables", ())
    return observables[0].name if isinstance(observables, tuple) and observables else VALUE


def _digest_of_model(model: ForwardModel) -> str:
    """Of a model's settings: what it says when it is sent to a worker; "" where it cannot be."""
    try:
        return digest(pickle.dumps(model))
    except Exception:
        return ""
