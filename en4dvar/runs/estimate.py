"""``en4dvar.estimate``: a function, arrays and priors instead of a file; from there on it is a run like any other.

The arguments become the configuration that a file would hold, and the arrays the data file ``data.csv`` of the run
directory, so that everything a configuration can say can be said here, in the same words.
"""

import pickle
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from en4dvar.config import Config, SequenceConfig
from en4dvar.config.document import Document, document_of
from en4dvar.config.kinds import resolve_sequence
from en4dvar.config.load import resolve
from en4dvar.config.models import HANDED, checked, read_model
from en4dvar.diagnosis.analysis import Progress
from en4dvar.inputs.arrays import TIME, VALUE, columns_of, csv_of, require_columns, tables_of
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.model.function_model import FunctionModel, digest_of, name_of
from en4dvar.model.state import OF_READINGS, Array, Parameter, floats
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, OutputError, retold
from en4dvar.plumbing.files import expanded, make_folder, temporary_folder, write_text
from en4dvar.plumbing.hints import listed, suggest
from en4dvar.plumbing.units import UnitError, parse_unit
from en4dvar.plumbing.user_file import absolute, is_file_reference
from en4dvar.report.result import Result
from en4dvar.report.sequence import SequenceOutcome
from en4dvar.results.checkpoint import digest
from en4dvar.runs.cycles import run_sequence
from en4dvar.runs.progress import terminal_progress
from en4dvar.runs.rundir import GIVEN, holds_run
from en4dvar.runs.runner import run_campaign

MODELS = "give f(parameters, times), a ForwardModel, or a dict such as {'name': 'lorenz63'}"
ARGUMENTS = {  # section of a file → argument
    **{f"data.{argument}": argument for argument in ("error", "window", "series", "correlation")},
    "parameters": "priors",
    "sequence.initial_std": "initial_std",
}
ARRAYS = "arrays of a script"
FILES = ("path", "ensemble", "from")  # keys of files
C = TypeVar("C", Config, SequenceConfig)


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
    cheap: bool = False,
    **sections: Any,
) -> Result:
    """Estimate parameters of a model from readings that a script holds.

    Parameters
    ----------
    model: a function ``f(parameters, times) -> values`` (see :class:`~en4dvar.model.function_model.FunctionModel`), a
        :class:`~en4dvar.model.forward.ForwardModel`, its class, or what the ``model:`` section of a file says.
    data: (times, values), a dict of columns, a pandas Series or DataFrame, an xarray DataArray or Dataset, in the units
        of the model. NaN, or masked, is no reading. Or a dict of several series, name → one of these, each with its own
        times; its name is that of its observable, and ``error`` is then a dict name → error. A function is asked for
        all times together, the union of those of the series, and returns a dict of arrays.
    priors: name → prior, as in a file: ``{"prior": "lognormal", "median": 4, "log_std": 0.5}``; a number fixes a
        parameter. ``t_s`` is a time shift, ``sigma`` the noise scale, ``reading_scale`` that of the predictions.
    error: std of the readings: a number, one a reading, text such as ``"1 % of maximum"``, or a dict as ``data.error``
        of a file, in which an array is one number a reading, and of ``covariance`` the matrix (K, K) of all readings.
        Files are named from the working directory.
    units: of a function's parameters, values (by name) and of ``"time"``; by default none has one.
    time: name of the column, index or coordinate of times.
    observable: what the values are, by its name in the model or the column; by default the only one there is. A list:
        several columns of one table, each a series.
    series: of several series, name → what ``data.series`` of a file says besides: ``{"observable": "head", "places":
        {"column": "cell"}, "weights": [1, 0, 1]}``.
    correlation: of the errors of two series at equal times, ``{"prey": {"predator": 0.5}}``.
    window: as ``data.window`` of a file.
    name, seed: of the run, as in a file; members and draws follow from the seed.
    directory: of the run, with files as of :func:`en4dvar.run`, and its page unless ``report`` is False; by default
        nothing is kept on disk.
    force, resume: replace or continue the run in the directory.
    progress: show it on a terminal or in a notebook; or a function that is called as that of :func:`en4dvar.run`, with
        the name of the data set and the record of each iteration.
    cheap: ten thousand calls of a function take seconds, so that a doubt about the posterior is settled by sampling it.
    sections: further sections of a file by name: ``assimilation``, ``execution``, ``initial_state``, ``model_error``,
        ``prior_correlation``; ``prior={"ensemble": {"k": array}}`` may hold the members themselves.

    Raises
    ------
    ConfigError, DataError: says which argument, and what to do. Others as of :func:`en4dvar.run`.
    """
    call = Given(model, data, time, observable, error, units or {}, priors, series or {}, correlation)
    sections = _from_here(sections)
    if "prior" in sections:
        sections["prior"] = call.prior(sections["prior"])
    ready, content = call.content(model, name, seed, cheap, **({"window": window} if window else {}))
    content |= {"output": {"report": report and directory is not None}, **sections}
    with ExitStack() as held:
        config = held.enter_context(_configured(resolve, content, ready, call, directory, resume or force))
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
    model: with ``step`` or ``resumed``; data, priors, error, time, observable, series, correlation, name, seed,
        directory, report, force, resume: as of :func:`estimate`.
    initial_std: spread of the initial state by field, as ``sequence.initial_std`` of a file.
    sections: further sections of a file by name: ``assimilation`` (required), ``model_error``, ``execution``.

    Raises
    ------
    ConfigError, DataError: says which argument, and what to do. Others as of :func:`run_sequence`.
    """
    call = Given(model, data, time, observable, error, {}, priors or {}, series or {}, correlation)
    ready, content = call.content(model, name, seed)
    content |= {"sequence": {"initial_std": initial_std or {}}}
    content |= {"output": {"report": report and directory is not None}, **_from_here(sections)}
    with _configured(resolve_sequence, content, ready, call, directory, resume or force) as config:
        return run_sequence(config, force=force, resume=resume, command="en4dvar.estimate_sequence")


@contextmanager
def _configured(
    resolve: Callable[[Document, Path, ForwardModel], C], content: Mapping[str, Any], model: ForwardModel,
    call: "Given", directory: str | Path | None, replaces: bool,
) -> Iterator[C]:  # fmt: skip
    """What the ``content`` of a file asks for, whose arrays lie in the ``directory``, or in one that is there within.
    Raises :class:`ConfigError` in the words of the arguments, :class:`OutputError`.
    """
    with ExitStack() as held:
        where = Path(directory or held.enter_context(temporary_folder()) / "run")
        _keep_data(where, call.beside, replaces)  # which the configuration reads
        try:
            config = resolve(document_of(content), where.absolute(), model)
        except ConfigError as error:
            raise ConfigError([replace(fault, path=_argument(fault.path)) for fault in error.problems]) from None
        _keep_data(where, call.files, replaces)
        try:
            yield replace(config, directory=where)
        except DataError as error:
            raise DataError(call.words(error, where)) from None


def _from_here(value: Any, key: Any = "") -> Any:
    """The same, with absolute paths of the files that it names from the working directory."""
    if isinstance(value, Mapping):
        return {name: _from_here(part, name) for name, part in value.items()}
    if isinstance(value, str) and is_file_reference(value):
        return absolute(value)
    return str(expanded(value).absolute()) if isinstance(value, str) and key in FILES else value


def _argument(path: str) -> str:
    path = re.sub(r"^data\.series\.([^.]+)\.error(?=\.|$)", r"data.error.\1", path)
    place = next((place for place in ARGUMENTS if f"{path}.".startswith(f"{place}.")), "")
    return ARGUMENTS.get(place, "") + path.removeprefix(place)


def _keep_data(directory: Path, files: Mapping[str, str], replaces: bool) -> None:
    """Write the arrays into the run directory. Raises :class:`OutputError` where another file would be lost."""
    for path, text in ((directory / name, text) for name, text in files.items()):
        old = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else text
        if old != text and not (replaces and holds_run(directory)):
            words = "holds other readings; choose another directory, or give force=True to replace a run"
            raise OutputError(f"{path}: {words}")
        make_folder(directory)
        write_text(path, text)


# What a script hands over, readings, errors and a model, as the sections of a configuration and one data file


@dataclass
class GivenSeries:
    """One series: its ``columns``, what they are of and their ``error``.

    ``name``: "" of a single one, else that in front of its columns in the data file. ``more``: what it says besides, as
    in ``data.series``. ``index``: that of pandas, which errors share. ``used``: the columns that go to the file, by
    their names there; ``files``: others, with text.
    """

    name: str
    columns: Mapping[str, Array]
    observable: str | None
    error: Any
    more: Mapping[str, Any]
    index: Any = None
    used: dict[str, Array] = field(default_factory=dict, init=False)
    files: dict[str, str] = field(default_factory=dict, init=False)

    def observed(self, known: Sequence[str]) -> str:
        """The name of what was observed, of the ``known`` ones. Raises :class:`ConfigError`."""
        if self.observable is not None:
            return self.observable
        others = [name for name in known if name in self.columns and name not in _columns_in(self.error)]
        if len(others) != 1:
            what = "name the column of readings" if others else "call the column of readings what the model observes"
            raise ConfigError(f"observable: {what}, one of: {', '.join(others or known)}")
        return others[0]

    def section(self, model: ForwardModel) -> dict[str, Any]:
        """What ``data:`` says of it, apart from the path. Raises :class:`DataError`, :class:`ConfigError`."""
        named = {observable.name: observable for observable in model.observables}
        name = self.observed(list(named))
        if name not in named:
            where = f"data: {self.name}" if self.name else "observable"
            raise ConfigError(f"{where}: the model has no {name!r}; it has: {', '.join(named)}")
        clock = {"name": self._kept(TIME), "unit": model.time_unit}
        readings = {"name": self._kept(self._readings(name)), "unit": named[name].unit}
        return {
            "columns": {TIME: clock, name: readings},
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
                parts = np.asanyarray(value).T if hasattr(value, "shape") else value
                error[key] = [self._stated(part, f"shared {i}", unit) for i, part in enumerate(parts, 1)]
            elif key == "covariance" and np.ndim(value) == 2:
                file = f"data.{self.name}.covariance.csv".replace("..", ".")
                matrix, times = _floats(value, f"error: {self._of()}{key}"), self.columns[TIME]
                if matrix.shape != 2 * times.shape:
                    raise DataError(f"error: {self._of()}{key} has shape {matrix.shape} for {len(times)} readings")
                if self.name:  # in a file as long as the longest series
                    there = ~np.isnan(times + self.columns[self._readings(observable.name)])
                    matrix = matrix[there][:, there]
                self.files[file] = "".join(",".join(map(repr, row)) + "\n" for row in matrix.tolist())
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
        if self.index is not None and hasattr(value, "iloc") and not value.index.equals(self.index):
            how = "align them by .reindex_like, or pass .to_numpy() to go by order"
            raise DataError(f"error: {self._of()}{key} has another index than the readings; {how}")
        column = f"{self.name} error {key}".lstrip()
        self.used[column] = _floats(value, f"error: {self._of()}{key}")
        return {"column": column}

    def _of(self) -> str:
        return f"{self.name}: " if self.name else ""


def _floats(values: Any, whose: str) -> Array:
    with retold(TypeError, DataError):
        return floats(values, whose)


class Given:
    """The arguments of :func:`estimate`.

    Raises :class:`DataError` for readings in no form that is known, :class:`ConfigError` where ``error``, ``series`` or
    ``correlation`` do not suit the series.
    """

    def __init__(
        self, model: Any, data: Any, time: str, observable: str | Sequence[str] | None, error: Any,
        units: Mapping[str, str], priors: Mapping[str, Any], series: Mapping[str, Any], correlation: Any,
    ):  # fmt: skip
        self.units, self.priors, self.correlation = units, priors, correlation
        self.of_section = _of_section(model) if isinstance(model, str | Mapping) else None
        error, series = _from_here(error), _from_here(series)
        names = () if observable is None else observable if isinstance(observable, Iterable) else (observable,)
        if wrong := [name for name in names if not isinstance(name, str)]:
            raise ConfigError(f"observable: {wrong[0]!r} is no name of a column; give a text, or a list of them")
        if not isinstance(units, Mapping):
            raise ConfigError("units: give a dict, e.g. {'k': '1/s'}")
        self.beside: dict[str, str] = {}
        with retold(DataError, DataError, "data: "):
            tables = tables_of(data, time, None if isinstance(observable, str) else observable)
        self.alone = tables is None
        if tables is not None and isinstance(observable, str):
            raise ConfigError("observable: of several series each says its own: series={'name': {'observable': …}}")
        if tables is None and (series or correlation):
            raise ConfigError(f"{'series' if series else 'correlation'}: data is one series, not a dict of several")
        if tables is not None:
            _check_keys("error", error, tables, whole=True)
            _check_keys("series", series, tables)
        self.series = []
        for name, table in ({"": data} if tables is None else tables).items():
            more, own = ({}, error) if self.alone else (series.get(name, {}), error[name])
            chosen: Any = observable if self.alone else str(more.get("observable", name))
            with retold(DataError, DataError, f"data: {name}: " if name else "data: "):
                columns = columns_of(table, time, chosen or _only(self.of_section[0] if self.of_section else model))
            index = next((held.index for held in (table, data) if hasattr(held, "iloc")), None)
            self.series.append(GivenSeries(name, columns, chosen, own, more, index))

    def prior(self, section: Any) -> Any:
        """The ``prior:`` section, with a file for an ensemble of arrays. Raises :class:`DataError`."""
        if not (isinstance(section, Mapping) and isinstance(members := section.get("ensemble"), Mapping)):
            return section
        columns = {name: _floats(values, f"prior: {name}") for name, values in members.items()}
        if len({values.shape for values in columns.values()}) != 1 or next(iter(columns.values())).ndim != 1:
            raise DataError("prior: give one number a member for each parameter, of all the same number of members")
        self.beside["data.prior.csv"] = csv_of(columns)
        return {**section, "ensemble": "data.prior.csv"}

    def words(self, error: DataError, directory: Path) -> str:
        """The message of an ``error`` about the files in a directory as one about the arrays that they hold."""

        def reading(row_of: re.Match[str]) -> str:
            return f"reading {int(row_of[1]) - 1} of {'data' if self.alone else error.series}"

        folder = re.escape(f"{directory.absolute()}")
        message = re.sub(rf"{folder}.{re.escape(GIVEN)}:(\d+)", reading, str(error))
        message = re.sub(rf"{folder}.data(?:\.(\S+))?\.csv", lambda file: file[1] or "data", message)
        return re.sub(r" \(data\.[^)]*\)|; see data\.\w+", "", message)

    @property
    def files(self) -> dict[str, str]:
        """Names of the data file and of those beside it, and their texts."""
        beside = dict(item for series in self.series for item in series.files.items())
        columns = dict(item for series in self.series for item in series.used.items())  # names of series have no blank
        return {GIVEN: csv_of(columns), **beside, **self.beside}

    def content(
        self, model: Any, name: str, seed: int, cheap: bool = False, **of_data: Any
    ) -> tuple[ForwardModel, dict[str, Any]]:
        """The model, and what a file says of it, of the data (and ``of_data`` besides) and of the parameters."""
        ready, section = self.model(model, cheap)
        own = {series.name: series.section(ready) for series in self.series}
        correlation = {"correlation": self.correlation} if self.correlation else {}
        data = {"path": GIVEN, **(own[""] if self.alone else {"series": own, **correlation}), **of_data}
        return ready, {"name": name, "seed": seed, "model": section, "data": data, "parameters": self.priors}

    def model(self, model: Any, cheap: bool = False) -> tuple[ForwardModel, dict[str, Any]]:
        """The model, ``cheap`` or not, and what a configuration records of it. Raises :class:`ConfigError`."""
        if cheap and isinstance(model, str | Mapping | type | ForwardModel):
            raise ConfigError("cheap: it is said of a function; a model says it itself (ForwardModel.cheap)")
        if self.of_section is not None:
            return self.of_section
        if isinstance(model, type) and issubclass(model, ForwardModel):
            model = model()
        if isinstance(model, ForwardModel):
            return checked(model), {"name": HANDED, "object": name_of(type(model)), "digest": _digest_of_model(model)}
        if not callable(model):
            raise ConfigError(f"model: {type(model).__name__} is neither a function nor a model; {MODELS}")
        section = {"name": HANDED, "object": name_of(model), "digest": digest_of(model)}
        return self._function(model, cheap), section | ({"cheap": True} if cheap else {})

    def _function(self, function: Any, cheap: bool) -> FunctionModel:
        names = [name for name in self.priors if name not in {p.name for p in OF_READINGS}]
        if not names:
            raise ConfigError("priors: none is of a parameter of the function; give one a prior, or a fixed number")
        if wrong := [name for name in names if not str(name).isidentifier()]:
            raise ConfigError(f"priors: {wrong[0]!r} cannot be the name of a parameter; use letters, digits and _")
        columns = {name for series in self.series for name in series.columns}
        observed = [series.observed([name for name in series.columns if name != TIME]) for series in self.series]
        unknown = self.units.keys() - self.priors.keys() - columns - set(observed)
        if unknown:
            raise ConfigError(
                f"units: {sorted(unknown)[0]!r} is neither a parameter in priors nor a column of the data"
            )
        for name, unit in self.units.items():
            with retold(UnitError, ConfigError, f"units: {name}: "):
                parse_unit(unit)
        parameters = [Parameter(name, self.units.get(name, "1")) for name in names]
        observables = {name: self.units.get(name, "1") for name in observed}
        return FunctionModel(function, parameters, observables, self.units.get(TIME, "1"), cheap=cheap)


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


def _columns_in(sections: Any) -> list[str]:
    """The columns that ``error``, or what a series says besides, names."""
    values = list(sections.values()) if isinstance(sections, Mapping) else []
    values += [part for value in values if isinstance(value, list) for part in value]
    return [str(value["column"]) for value in values if isinstance(value, Mapping) and "column" in value]


def _of_section(model: str | Mapping[str, Any]) -> tuple[ForwardModel, dict[str, Any]]:
    section = {"name": model} if isinstance(model, str) else dict(model)
    faults: list[Fault] = []
    built = read_model(section, Path.cwd(), document_of({"model": section}), faults)
    if built is None:
        raise ConfigError(faults)
    return built


def _only(model: Any) -> str:
    """What values without a name are called: the model's first observable, else y."""
    made = model() if isinstance(model, type) and issubclass(model, ForwardModel) else model  # which may set them
    observables = getattr(made, "observables", ())
    return observables[0].name if isinstance(observables, tuple | list) and observables else VALUE


def _digest_of_model(model: ForwardModel) -> str:
    """Of a model's settings: what it says when it is sent to a worker; "" where it cannot be."""
    try:
        return digest(pickle.dumps(model))
    except Exception:
        return ""
