"""From paths to observations: what paths, folders and patterns name, the data sets in these files, and their readings
with window, clock, errors, weights and places of each series.
"""

import glob
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from en4dvar.config.data import Data, DataPlan, SeriesPlan, TimeZero
from en4dvar.config.quantities import Spread
from en4dvar.data.noise import DecayingErrors, Noise, SharedErrors, noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series, balanced
from en4dvar.inputs.formats import SUFFIXES, TRUTHS
from en4dvar.inputs.members import read_covariance
from en4dvar.inputs.parts import ANY, Column, DataFile, Layout, parts_of
from en4dvar.inputs.readers import Readings, Rows, read_series, scalar_of
from en4dvar.inputs.window import vertex
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import PathError, expanded, open_plain, readable
from en4dvar.plumbing.hints import free_name, natural
from en4dvar.plumbing.units import convert, unit_after

LONGEST_HEAD = 4096  # bytes of a line of names


def with_parts(
    files: Mapping[str, Path], value: Column, layout: Layout = ANY, time: str | None = None
) -> dict[str, DataFile]:
    """Every data set that the files hold, see :func:`~en4dvar.inputs.parts.parts_of`; a number tells apart those of one
    name, as part ``2_3`` of ``a_1`` and part ``3`` of ``a_1_2`` have.
    """
    by_name: dict[str, DataFile] = {}
    for name, path in files.items():
        try:
            parts = parts_of(path, value, layout, time)
        except DataError:  # told with its reason where it is read
            parts = ()
        for part in parts or ("",):
            by_name[free_name(readable(f"{name}_{part}") if part else name, by_name)] = DataFile(path, part)
    return by_name


def find_files(
    base: Path, texts: Sequence[str], left_out: Callable[[Path], object] = lambda path: None
) -> dict[str, Path]:
    """:func:`data_files` of paths, folders and patterns relative to ``base``. Of a folder without data files those of
    its subfolders are taken, and each is named after its subfolder and itself. Truths of a simulated campaign, in a
    folder or among what matches a pattern, are ``left_out``, which is told of each. Raises :class:`DataError`.
    """
    paths: list[Path] = []
    grouped: set[Path] = set()
    for text in texts:
        with retold(PathError, DataError):
            path = base / expanded(text)
        if glob.has_magic(text) and not os.path.exists(path):
            root = next(folder for folder in path.parents if os.path.isdir(folder))  # whose name is no pattern
            inner = glob.glob(str(path.relative_to(root)), root_dir=root, recursive=True)
            every = sorted((root / name for name in inner), key=natural)
            if not (matches := _without_truths(every, left_out)):
                raise DataError(f"{path}: no file matches")
            paths += matches
        elif os.path.isdir(path):
            held = _data_files(path, left_out)
            if not held:
                folders = sorted((p for p in _beside(path) if p.is_dir() and p.name[0] != "."), key=natural)
                held = [file for folder in folders for file in _data_files(folder, left_out)]
                grouped.update(held)
            if not held:
                raise DataError(f"{path}: the folder holds no data file ({', '.join(SUFFIXES)})")
            paths += held
        else:
            paths.append(path)
    again = [path for path, count in Counter(os.path.abspath(p) for p in paths).items() if count > 1]
    if again:
        raise DataError(f"{again[0]}: occurs more than once in data.path")
    return dict(zip(_unique_names(paths, grouped), paths, strict=True))


def _beside(folder: Path) -> list[Path]:
    with retold(OSError, DataError, f"{folder}: cannot be read: "):
        return list(folder.iterdir())


def _data_files(folder: Path, left_out: Callable[[Path], object]) -> list[Path]:
    held = [p for p in _beside(folder) if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    return sorted(_without_truths(held, left_out), key=natural)


def _without_truths(paths: Sequence[Path], left_out: Callable[[Path], object]) -> list[Path]:
    truths = [path for path in paths if _holds_truths(path)]
    for path in truths:
        left_out(path)
    return [path for path in paths if path not in truths]


def _holds_truths(path: Path) -> bool:
    """Whether a file is the table of truths that ``en4dvar simulate`` writes beside the data sets of a campaign."""
    if path.suffix == ".csv":
        with suppress(OSError), open_plain(path) as file:
            lines = iter(lambda: file.readline(LONGEST_HEAD), b"")
            head = next((line for line in lines if not line.startswith(b"#")), b"").strip().split(b",")
            return (*head[:2], head[-1]) == tuple(name.encode() for name in TRUTHS)
    return False


def _unique_names(paths: list[Path], grouped: Set[Path]) -> list[str]:
    stems = Counter(p.stem for p in paths)
    names: dict[str, None] = {}
    for path in paths:
        name = path.stem if stems[path.stem] == 1 and path not in grouped else f"{path.parent.name}_{path.stem}"
        names[free_name(readable(name), names)] = None
    return list(names)


def read_observations(plan: DataPlan, file: DataFile, name: str, weights: str = "sum") -> Observations:
    """The observations (y, t, R) of a data set, of its window; ``weights`` of the scheme. Raises :class:`DataError`."""
    files = (file, *file.others)
    series = []
    for series_plan, where in zip(plan.series, files, strict=True):
        with retold(DataError, DataError, "", series_plan.name):
            series.append(read_one(series_plan, where, fewest=series_plan.observable.fewest if len(files) == 1 else 1))
    observations = Observations.of_series(series, plan.correlation, name)
    own = observations.weights
    if weights == "sum":
        return observations
    if weights == "mean":
        return replace(observations, weights=own / len(own))
    groups = np.concatenate([np.full(p.end - p.begin, p.group, dtype=object) for p in observations.parts] or [own * 0])
    return replace(observations, weights=balanced(own, groups.astype(str)))


def read_one(plan: SeriesPlan, file: DataFile, fewest: int) -> Series:
    """One series inside its window. Raises :class:`DataError`."""
    data, path, weights, places = plan.data, file.path, plan.data.weights, plan.data.places
    read = read_series(
        path, data.columns.time, data.columns.observable, data.part(Layout), [*data.columns_beside.values()],
        file.part, repeats=places is not None, fewest=fewest,
    )  # fmt: skip
    beside = {key: read.errors[column.name] for key, column in data.columns_beside.items()}
    asked = data.window
    window = read.window(asked.start, asked.end, asked.prominence)
    times, values = read.times[window], read.values[window]
    zero = _zero_of(data.time_zero, read, times[0], path)
    times = times - zero
    if times[0] < 0:
        clock = data.columns.time
        early, unit = -times[0], ""
        if isinstance(clock, Column):
            early, unit = convert(early, clock.target, clock.unit), unit_after(clock.unit)
        words = f"the first observation used lies {early:g}{unit} before time zero, where the model's clock starts"
        raise DataError(f"{path}: {words}; put it earlier (data.time_zero), or begin later (data.window.from)")

    def errors(part: slice) -> Noise:
        stated = {key: column[part] for key, column in beside.items()}
        rows = partial(read.rows_among, used=part)
        return errors_of(data, read.times[part] - zero, values, stated, step_of(read.times), rows)

    try:
        until = read.window(asked.start, asked.until, asked.prominence).stop
        noise, whole = errors(window), slice(window.start, max(window.stop, until))
        stated = {key: column[window] for key, column in beside.items()}
        if len(times) < fewest:
            held = f"{len(times)} of {len(read.times)} usable observations"
            raise DataError(f"the window data.window holds {held}; at least {fewest} are needed")
        return Series(
            observable=plan.observable,
            times=times,
            values=values,
            noise=noise,
            weights=weights.weights(times, values, asked.prominence, stated.get("weights")) if weights else None,
            name=plan.name,
            group=plan.group,
            places=places.places(len(times), stated.get("places")) if places else None,
            source=readable(path),
            scalars=read.scalars,
            doubts=read.doubts_of(window, asked.start),
            continued=(read.times[whole] - zero, read.values[whole], errors(whole))
            if window.stop < whole.stop and data.error.separate and not places
            else None,
            error_unit=data.error.std.unit if data.error.std else "",
            next_end=read.next_end(window.start, range(window.stop, whole.stop), asked.prominence),
            zero=zero,
        )
    except (ValueError, DataError) as error:
        words = str(error)
        raise DataError(words if words.startswith(str(path)) else f"{readable(path)}: {words}") from None


def _zero_of(asked: TimeZero | float | tuple[Column, float], read: Readings, first: float, path: Path) -> float:
    """Where the model's clock starts on that of the file, of which the ``first`` reading is used."""
    if isinstance(asked, tuple):
        scalar, plus = asked
        return scalar_of(scalar, read.scalars, path, "data.time_zero") + plus
    if asked == "top":
        return vertex(read.times, read.values)
    return {"file": 0.0, "window": first}[asked] if isinstance(asked, str) else asked


def step_of(times: Array) -> float:
    """The median time between readings; 0 of a single one."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


def errors_of(
    data: Data,
    times: Array,
    values: Array,
    stated: Mapping[str, Array],
    step: float,
    rows: Callable[[int], Rows] = np.arange,
) -> Noise:
    """The observation errors at ``times`` (K,).

    ``values`` are those in the window. ``stated``: ``std``, ``time_std``, ``shared 0`` and so on, ``at_most`` and
    ``at_least`` (K,) where columns of the file hold them. ``step``: the time between readings. ``rows``: where the
    observations stand in a covariance file of so many rows, see
    :meth:`~en4dvar.inputs.readers.Readings.rows_among`.
    """
    error, correlation = data.error, cast(Array | SharedErrors | DecayingErrors | None, None)
    largest = float(values.max())
    kernel = error.discrepancy.kernel_at(times) if error.discrepancy else None
    timing = error.time_std.absolute(step) if isinstance(error.time_std, Spread) else error.time_std
    time_std = stated["time_std"] if isinstance(timing, Column) else np.full(len(times), timing)
    if error.covariance is not None:
        covariance = read_covariance(error.covariance)
        with retold(DataError, DataError, f"{error.covariance.path}: "):
            where = rows(len(covariance))
        covariance = covariance[np.ix_(where, where)]
        std = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(std, std)
        np.fill_diagonal(correlation, 1.0)
        return noise_of(std, time_std, correlation, discrepancy=kernel)
    assert error.std is not None  # a rule of the section

    def of(part: Spread | Column, key: str) -> Array:
        return np.full(len(times), part.absolute(largest)) if isinstance(part, Spread) else stated[key]

    std = of(error.std, "std")
    if error.model_std is not None:
        std = np.hypot(std, error.model_std.absolute(largest))
    if error.shared:
        columns = [of(part, f"shared {i}") for i, part in enumerate(error.shared)]
        std, correlation = SharedErrors.beside(std, np.stack(columns, axis=1))
    if error.correlation_time is not None:
        correlation = DecayingErrors(times / error.correlation_time)
    upper, lower = (np.asarray(stated.get(key, on), dtype=bool) for key, on in error.bounds.items())
    if np.any(upper & lower):
        raise DataError("a reading is both at_most and at_least; give two series, one of each")
    sides = np.broadcast_to(upper.astype(float) - lower, times.shape)
    return noise_of(std, time_std, correlation, error.threshold if error.robust else None, kernel, sides)
