"""The observations of a result file, as they went into the estimate."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array

from en4dvar.data.noise import SIDES, noise_of_readings, noise_of_record
from en4dvar.data.observations import Observations
from en4dvar.data.series import Part, Places
from en4dvar.model.forward import Observable, Trajectory
from en4dvar.model.state import Array
from en4dvar.results.declared import Axis
from en4dvar.results.netcdf import Group
from en4dvar.results.scalars import SCALAR


def observations_of(
    data: Group, axes: Sequence[Axis], name: str, observables: Mapping[str, Observable], later: Group | None = None
) -> Observations:
    """From ``observed_data`` and what is beside it: :meth:`en4dvar.results.store.StoredResult.observations`.

    ``later``: the group of the readings after the window.
    """
    attributes = data.attrs

    def each(suffix: str) -> Array:
        return np.concatenate([data[f"{axis.name}{suffix}"].values for axis in axes])

    def own(what: str) -> Array:
        return np.concatenate([data[axis.own(what)].values for axis in axes])

    times, parts = own("time"), _parts(data, axes, observables)
    if parts:
        matrix = _correlation(data, len(times)) if "correlation" in data else None
        within = [float(attributes.get(f"{p.name}_huber_threshold", math.inf)) for p in parts]
        thresholds = np.repeat(within, [p.end - p.begin for p in parts])
        sides = data[SIDES].values if SIDES in data else None
        noise = noise_of_readings(each("_reading_std"), own("time_std"), matrix, thresholds, sides)
    else:
        held = {key.removeprefix(f"{axes[0].name}_"): value.values for key, value in data.variables.items()}
        noise = noise_of_record(times, each("_reading_std"), own("time_std"), held, attributes)
    return Observations(
        times=times,
        values=each(""),
        noise=noise,
        weights=own("weights"),
        name=name,
        source=str(attributes["data_source"]),
        scalars={k.removeprefix(SCALAR): float(v) for k, v in attributes.items() if k.startswith(SCALAR)},
        parts=parts,
        continued=None if later is None else _continued(data, later, axes[0].name, name),
    )


def _continued(data: Group, later: Group, series: str, name: str) -> Observations:
    """The readings of the window and those after it."""

    def both(of_window: str, after: str = "") -> Array:
        return np.concatenate([data[of_window].values, later[after or of_window].values])

    times, std = both("time", "withheld_time"), both(f"{series}_reading_std")
    noise = noise_of_record(times, std, both("time_std"), {}, data.attrs)
    return Observations(times, both(series), noise, np.ones(len(times)), name)


def _correlation(data: Group, count: int) -> csr_array:
    """Of all readings, from the matrix or from its entries that are not zero."""
    values = data["correlation"].values
    if values.ndim == 2:
        return csr_array(values)
    rows, columns = (data[f"correlation_{side}"].values for side in ("row", "column"))
    return csr_array((values, (rows, columns)), shape=(count, count))


def _parts(data: Group, axes: Sequence[Axis], observables: Mapping[str, Observable]) -> tuple[Part, ...]:
    """The series; () of a single one without places."""
    ends = np.cumsum([len(data[axis.name].values) for axis in axes]).tolist()
    parts = [
        Part(axis.name, observables.get(axis.name) or _unread(data, axis), begin, end, _places(data, axis))
        for axis, begin, end in zip(axes, [0, *ends], ends, strict=False)
    ]
    return () if len(parts) == 1 and parts[0].places is None else tuple(parts)


def _places(data: Group, axis: Axis) -> Places | None:
    name = f"{axis.name}_place"
    if name not in data:
        return None
    indices, shares = data[f"{name}_index"].values.astype(np.intp), data[f"{name}_share"].values
    return Places(indices, shares, data[name].values, str(data[name].attrs["units"]))


def _unread(data: Group, axis: Axis) -> Observable:
    """What a file knows of an observable; only a model knows how it is predicted."""

    def refuse(trajectory: Trajectory) -> Array:
        raise NotImplementedError(f"{axis.name} is that of a file; give the model's observable")

    about = data[axis.name].attrs
    label = str(about["long_name"]).removesuffix(", observed")
    return Observable(axis.name, about["units"], refuse, about["symbol"], about["display_units"], label)
