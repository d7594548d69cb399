"""``simulate``: bubbles without assimilation."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from en4dvar.errors import ConfigError
from en4dvar_bubble.driving import Driving, Reading, histotripsy, silence
from en4dvar_bubble.laws import ConstitutiveLaw, get_law
from en4dvar_bubble.medium import WATER_25C, Medium
from en4dvar_bubble.model import BubbleModel, Gas, Heat, Start, Vapour
from en4dvar_bubble.packing import conduction_slope, from_kirchhoff
from en4dvar_bubble.paths import Paths
from en4dvar_bubble.solver.driver import ACCURACIES, Accuracy, AccuracyName, Radial

if TYPE_CHECKING:
    import xarray as xr

_CHUNK = 64


def simulate(
    law: str | ConstitutiveLaw = "quadratic-kelvin-voigt",
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    times: npt.ArrayLike | None = None,
    *,
    start: Start = "acoustic",
    gas: Gas = "heat",
    driving: Driving | None = None,
    driving_read: Reading = "instantaneous",
    medium: Medium = WATER_25C,
    radial: Radial = "keller-miksis",
    vapour: Vapour = "none",
    medium_heat: Heat = "cold",
    accuracy: AccuracyName | Accuracy = "standard",
    workers: int = 1,
) -> xr.Dataset:
    """Integrate one bubble or an ensemble.

    Parameters
    ----------
    law: name of a constitutive law (``en4dvar laws``), or an instance.
    parameters: SI values, name → number or (member,). The law's (``G``, ``alpha``, ``mu``), with ``R0`` for the
    acoustic start,
        ``R_max`` and ``R_eq`` (or ``R0``, the same there) for the laser start.
    times: output times (time,) in s, increasing; time zero is the start of the simulation (laser: the instant of
    R_max). start, gas, driving, driving_read, medium, radial, vapour, medium_heat, accuracy: the model (see
    :class:`BubbleModel`); defaults are the acoustic start with the histotripsy pulse
        and the constants of water at 25 °C, p_f read at t, heat equation in the gas with a cold wall.
    workers: threads; the result does not depend on it.

    Returns
    -------
    Dataset with ``R`` (m), ``Rdot`` (m/s), ``p_b`` (Pa) on (member, time), NaN where a member failed; per member
    ``status`` (0 is ok), ``reason``, ``steps``, ``max_wall_mach`` and, with the heat equation, ``max_temperature``
    (K, innermost node); the parameters as coordinates.

    Raises
    ------
    ConfigError: unknown law, missing or unknown parameters, lengths that differ, times that do not increase.
    """
    import xarray as xr

    chosen = get_law(law) if isinstance(law, str) else law
    model = BubbleModel(
        law=chosen,
        gas=gas,
        start=start,
        driving=driving or (histotripsy() if start == "acoustic" else silence()),
        reading=driving_read,
        medium=medium,
        radial=radial,
        vapour=vapour,
        medium_heat=medium_heat,
        accuracy=ACCURACIES[accuracy] if isinstance(accuracy, str) else accuracy,
    )
    theta = _members(model, dict(parameters or {}))
    t = np.atleast_1d(np.asarray([] if times is None else times, dtype=float))
    if t.ndim != 1 or len(t) == 0 or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
        raise ConfigError("times: give a one-dimensional, increasing sequence of seconds")
    try:
        x = model.initial_states(theta)
    except ValueError as error:
        raise ConfigError(f"parameters: {error}") from error

    chunks = [x[i : i + _CHUNK] for i in range(0, len(x), _CHUNK)]

    def run(chunk: npt.NDArray[np.float64]) -> Paths:
        return model.integrate(chunk, np.broadcast_to(t, (len(chunk), len(t))))

    if workers > 1:
        with ThreadPoolExecutor(workers) as pool:
            paths = list(pool.map(run, chunks))
    else:
        paths = [run(chunk) for chunk in chunks]

    status = np.concatenate([p.solution.status for p in paths])
    record = np.concatenate([p.solution.record for p in paths])
    failed = status[:, None] != 0
    fields = {
        name: (
            ("member", "time"),
            np.where(failed, np.nan, np.concatenate([p[name] for p in paths])),
            {"units": unit, "long_name": text},
        )
        for name, unit, text in (
            ("R", "m", "bubble radius"),
            ("Rdot", "m s-1", "bubble wall velocity"),
            ("p_b", "Pa", "pressure in the bubble"),
        )
    }
    reasons = [p.solution.reason(i) for p in paths for i in range(len(p.solution.status))]
    data = {
        **fields,
        "status": ("member", status, {"long_name": "0 where the member was integrated to the end"}),
        "reason": ("member", np.array(reasons, dtype=object), {"long_name": "why the member failed"}),
        "steps": ("member", record[:, 0].astype(int), {"long_name": "accepted time steps"}),
        "max_wall_mach": ("member", record[:, 2], {"units": "1", "long_name": "largest wall Mach number"}),
    }
    if model.system.gas:
        hottest = medium.T_inf * from_kirchhoff(record[:, 3], conduction_slope(medium))
        data["max_temperature"] = (
            "member",
            hottest,
            {"units": "K", "long_name": "highest temperature near the centre"},
        )
    coordinates = {"time": ("time", t, {"units": "s", "long_name": "time"})} | {
        p.name: ("member", theta[p.name], {"units": p.unit, "long_name": p.label}) for p in model.parameters
    }
    attributes = {"law": chosen.name, "start": start, "gas": gas, "driving_read": driving_read, "radial": radial}
    attributes |= {"vapour": vapour, "medium_heat": medium_heat}
    return xr.Dataset(data, coords=coordinates, attrs=attributes)


def _members(model: BubbleModel, given: dict[str, npt.ArrayLike]) -> dict[str, npt.NDArray[np.float64]]:
    """Parameters as arrays of one length. Raises :class:`ConfigError`."""
    if model.start == "laser" and "R0" in given and "R_eq" not in given:
        given["R_eq"] = given.pop("R0")
    wanted = {p.name: p for p in model.parameters}
    missing = [f"{n} ({wanted[n].unit})" for n in wanted if n not in given]
    unknown = [n for n in given if n not in wanted]
    if missing or unknown:
        parts = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        raise ConfigError(
            f"parameters: {'; '.join(parts)} ({model.law.name}, {model.start} start, takes {', '.join(wanted)})"
        )
    arrays = {n: np.atleast_1d(np.asarray(v, dtype=float)) for n, v in given.items()}
    lengths = {len(a) for a in arrays.values()} - {1}
    if len(lengths) > 1 or any(a.ndim != 1 for a in arrays.values()):
        raise ConfigError(f"parameters: lengths differ: { {n: a.shape for n, a in arrays.items()} }")
    n_members = lengths.pop() if lengths else 1
    return {n: np.broadcast_to(a, (n_members,)).copy() for n, a in arrays.items()}
