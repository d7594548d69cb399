"""``simulate``: bubbles without assimilation."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np
import numpy.typing as npt

from en4dvar.model.forward import instants_of
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.units import parse_quantity
from en4dvar_bubble.driving import Driving, Reading
from en4dvar_bubble.dynamics import Gas, Heat, Start, Vapour, Wall
from en4dvar_bubble.laws import ConstitutiveLaw, get_law
from en4dvar_bubble.medium import CONSTANT_SETS, WATER_25C, Medium
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings, MediumName
from en4dvar_bubble.solver.driver import Accuracy, AccuracyName, Radial
from en4dvar_bubble.solver.integrate import MAX_MACH, MAX_THETA, RECORD, STEPS
from en4dvar_bubble.solver.lanes import WIDTH

if TYPE_CHECKING:
    import xarray as xr

_CHUNK = 64
_SHARE = 384
"""Unknowns of all members together that are worth a thread: 64 members of the paper's, 4 ms. With less, a thread that
the machine is late to start is waited for longer than it helps."""
_FIELDS = {
    "R": ("m", "bubble radius"),
    "Rdot": ("m s-1", "bubble wall velocity"),
    "p_b": ("Pa", "pressure in the bubble"),
}


def simulate(
    law: str | ConstitutiveLaw = "quadratic-kelvin-voigt", parameters: Mapping[str, npt.ArrayLike] | None = None,
    times: npt.ArrayLike | None = None, *, start: Start = "acoustic", gas: Gas = "heat", driving: Driving | None = None,
    driving_read: Reading = "instantaneous", medium: Medium | str = WATER_25C, radial: Radial = "keller-miksis",
    vapour: Vapour = "none", medium_heat: Heat = "cold", wall: Wall | None = None,
    accuracy: AccuracyName | Accuracy = "standard", workers: int = 1,
) -> xr.Dataset:  # fmt: skip
    """Integrate one bubble or an ensemble.

    Parameters
    ----------
    law: name of a constitutive law (``en4dvar laws``), or an instance.
    parameters: SI values, or text such as ``"4 kPa"``, name → one or (member,): the law's (``G``, ``alpha``, ``mu``,
        …), with ``R0`` for the acoustic start, ``R_max`` and ``R_eq`` (or ``R0``, the same there) for the laser start;
        where wanted, any of :mod:`en4dvar_bubble.numbers` (``p_A``, ``surface_tension``, ``c``, …) in place of the
        model's.
    times: output times (time,) in s, increasing; time zero is the start of the simulation (laser: the instant of
        R_max).
    start, gas, driving, driving_read, medium, radial, vapour, medium_heat, wall, accuracy: the model, see
        :class:`BubbleModel` (a ``medium`` also by its name, as in a file); by default the acoustic start with the
        histotripsy pulse and the constants of water at 25 °C, p_f read at t, heat equation in the gas with a cold wall.
    workers: threads at most (few members are integrated by one); the result does not depend on it.

    Returns
    -------
    Dataset with ``R`` (m), ``Rdot`` (m/s), ``p_b`` (Pa) on ("member", time), NaN where a member failed; per member
    ``status`` (0 is ok), ``reason``, ``steps``, ``max_wall_mach`` and, with the heat equation, ``max_temperature``
    (K, innermost node); the parameters as coordinates; the model and its constants, with unit and source (JSON), as
    attributes. Beyond the result itself it takes a few MB, whatever the number of members.

    Raises
    ------
    ConfigError: unknown law or other name, a model that contradicts itself, missing or unknown parameters, lengths
        that differ, times that do not increase, fewer than one worker.
    """
    if workers < 1:
        raise ConfigError(f"workers: at least 1, not {workers}")
    chosen = get_law(law) if isinstance(law, str) else law
    with retold(ValueError, ConfigError):
        usual, fine = cast(Driving, driving), cast(Accuracy, accuracy)  # None and names are completed
        model = BubbleModel(
            chosen, gas, start, usual, driving_read, _medium(medium), fine, radial, vapour, medium_heat, wall=wall
        )
    model = model.with_parameters(dict(parameters or {}))
    theta = _members(model, dict(parameters or {}))
    t = instants_of(() if times is None else times, "s")
    with retold(ValueError, ConfigError, "parameters: "):
        x = model.initial_states(theta)
    return _dataset(model, theta, t, *_run(model, x, t, workers))


def _run(model: BubbleModel, x: Array, t: Array, workers: int) -> tuple[dict[str, Array], Array]:
    """Of N members at K times: what is kept of each by name, :data:`_FIELDS` (N, K), ``status`` and ``reason`` (N,),
    and the solver's record (N, …). Chunk by chunk, each by all threads together; a chunk writes its rows and is
    forgotten (law tables alone are 32 kB per member).
    """
    n = len(x)
    workers = max(1, min(workers, n * model.system.size // _SHARE))
    chunk = _CHUNK * workers
    fields = {name: np.empty((n, len(t))) for name in _FIELDS}
    status, reasons, record = np.empty(n, dtype=np.int64), np.full(n, "", dtype=object), np.empty((n, RECORD))
    with ThreadPoolExecutor(workers - 1) if workers > 1 else nullcontext() as pool:
        for begin in range(0, n, chunk):
            rows = slice(begin, min(begin + chunk, n))
            size = rows.stop - rows.start
            work, finish = model.prepared(x[rows], t)
            others = [pool.submit(work) for _ in range(min(workers, -(-size // WIDTH)) - 1)] if pool else []
            work()
            for other in others:
                other.result()
            paths = finish()
            solution = paths.solution
            failed = solution.status != 0
            for name, values in fields.items():
                values[rows] = np.where(failed[:, None], np.nan, paths[name])
            status[rows], record[rows] = solution.status, solution.record
            reasons[rows] = [solution.reason(i) for i in range(size)]
    return {**fields, "status": status, "reason": reasons.astype(str)}, record


def _dataset(
    model: BubbleModel, theta: Mapping[str, Array], t: Array, kept: Mapping[str, Array], record: Array
) -> xr.Dataset:
    import xarray as xr

    data: dict[str, Any] = {
        name: (("member", "time"), kept[name], {"units": unit, "long_name": text})
        for name, (unit, text) in _FIELDS.items()
    }
    data["status"] = ("member", kept["status"], {"long_name": "0 where the member was integrated to the end"})
    data["reason"] = ("member", kept["reason"], {"long_name": "why the member failed"})
    data["steps"] = ("member", record[:, STEPS].astype(int), {"long_name": "accepted time steps"})
    data["max_wall_mach"] = ("member", record[:, MAX_MACH], {"units": "1", "long_name": "largest wall Mach number"})
    if model.system.gas:
        own, about = model.medium_of(theta), {"units": "K", "long_name": "highest temperature near the centre"}
        data["max_temperature"] = ("member", own.T_inf * own.from_kirchhoff(record[:, MAX_THETA]), about)
    coordinates: dict[str, Any] = {"time": ("time", t, {"units": "s", "long_name": "time"})}
    for p in model.parameters:
        coordinates[p.name] = ("member", theta[p.name], {"units": p.unit, "long_name": p.label})
    attributes = {name: getattr(model, name) for name in ("start", "gas", "radial", "vapour", "medium_heat")}
    attributes |= {"law": model.law.name, "driving_read": model.reading, "wall": str(model.wall or "none")}
    return xr.Dataset(data, coords=coordinates, attrs={**attributes, "constants": model.medium.json})


def _medium(medium: Medium | str) -> Medium:
    """Also that of a name of ``model.constants`` or ``model.medium`` of a file. Raises :class:`ConfigError`."""
    if not isinstance(medium, str):
        return medium
    names = (*CONSTANT_SETS, *get_args(MediumName))
    if medium not in names:
        raise ConfigError(f"medium: unknown name {shown(medium)}{suggest(medium, names)}")
    return CONSTANT_SETS.get(medium) or BubbleSettings.model_validate({"medium": medium}).liquid


def _numbers(value: Any, parameter: Parameter) -> Array:
    """In the unit of the parameter. Raises :class:`ConfigError`."""
    with retold((TypeError, ValueError), ConfigError, f"parameters: {parameter.name}: "):
        return np.asarray(parse_quantity(value, parameter.unit) if isinstance(value, str) else value, dtype=float)


def _members(model: BubbleModel, values: dict[str, npt.ArrayLike]) -> dict[str, Array]:
    """Parameters as arrays of one length. Raises :class:`ConfigError`."""
    if model.start == "laser" and "R0" in values and "R_eq" not in values:
        values["R_eq"] = values.pop("R0")
    wanted = {p.name: p for p in model.parameters}
    missing = [f"{n} ({wanted[n].unit})" for n in wanted if n not in values]
    unknown = [n for n in values if n not in wanted]
    if missing or unknown:
        parts = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        raise ConfigError(
            f"parameters: {'; '.join(parts)} ({model.law.name}, {model.start} start, takes {', '.join(wanted)})"
        )
    arrays = {n: np.atleast_1d(_numbers(v, wanted[n])) for n, v in values.items()}
    lengths = {len(a) for a in arrays.values()} - {1}
    if len(lengths) > 1 or any(a.ndim != 1 for a in arrays.values()):
        raise ConfigError(f"parameters: lengths differ: { {n: a.shape for n, a in arrays.items()} }")
    n_members = lengths.pop() if lengths else 1
    return {n: np.broadcast_to(a, (n_members,)).copy() for n, a in arrays.items()}
