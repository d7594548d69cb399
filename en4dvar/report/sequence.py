"""Page and figures of a sequence, from ``sequence.nc`` alone: state, parameters, innovations in time, and ranks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure

from en4dvar.report.cycles import RANKS, labelled, ranks, stacked_axes, write_cycles_page
from en4dvar.report.drawing import Captioned
from en4dvar.report.style import LIGHT, PAGE, band, styled
from en4dvar.report.text import plain_number, pretty_unit, with_unit
from en4dvar.state import Array
from en4dvar.storage.cycles_file import read_cycles
from en4dvar.units import convert

SHOWN = 5  # variables or observations in a figure
CERTAIN = 1e-9  # of its size: the spread of what is known


def write_sequence_report(run_dir: Path, files: bool = False) -> Path:
    """Write ``report.html`` from ``sequence.nc``, with ``files`` also its figures as PDF and PNG; returns its path.

    Raises :class:`~en4dvar.errors.OutputError` where there is nothing to read or the directory cannot be written.
    """
    data = read_cycles(run_dir / "sequence.nc")
    words = (
        "Of a filter or smoother that is right, normalised innovations have a root mean square of 1, and 95 % of the "
        "innovations lie within two expected standard deviations."
    )
    columns = ["observed", "readings", "root mean square of normalised innovations", "within 2 std"]
    last = "The analysis at the last observation time, given all observations."
    return write_cycles_page(
        run_dir,
        data,
        kind="Sequential assimilation",
        what=f"the series {data.attrs['data_set']}, cycle by cycle.",
        facts=_facts(data),
        tables=[
            ("State and parameters at the end", ["variable", "mean", "std", "unit"], _estimates(data), last),
            ("Innovations", columns, _innovations(data), words),
        ],
        figures=sequence_figures(data),
        files=files,
    )


def sequence_figures(data: xr.Dataset) -> Iterator[Captioned]:
    """Each figure with its caption."""
    best = _best(data)
    held = _parameters(data)
    spread = data[f"{best}_std"].values.max(axis=0)
    uncertain = np.flatnonzero(spread > CERTAIN * np.abs(data[f"{best}_mean"].values).max(axis=0))
    dynamic = np.array([i for i in uncertain if i not in held], dtype=np.intp)
    if len(dynamic):
        words = "" if len(dynamic) <= SHOWN else f" {SHOWN} of {len(dynamic)} variables."
        caption = f"The state in time: mean of the {best} ensemble within two standard deviations, and readings of it."
        yield "state", caption + words, in_time(data, best, _some(dynamic, SHOWN))
    if len(held):
        caption = "The parameters in time: mean of the analysis within two standard deviations, given the data so far."
        yield "parameters", caption, in_time(data, "analysis", held[:SHOWN])
    caption = "Innovations, the readings minus their forecasts, within two of their expected standard deviations."
    yield "innovations", caption, innovations(data)
    yield "ranks", RANKS, ranks(data)


@styled
def in_time(data: xr.Dataset, kind: str, chosen: npt.NDArray[np.intp]) -> Figure:
    """Mean ± 2 std of some variables of the state, one panel each, and the readings that are of them."""
    figure, stack = stacked_axes(len(chosen), 2.8, PAGE)
    time, read_as = _times(data), list(data["observation_state"].values)
    for i, ax in zip(chosen, stack, strict=True):
        name = str(data["state"].values[i])
        unit, shown = str(data["units"].values[i]), str(data["display_units"].values[i])
        mean, std = (convert(data[f"{kind}_{what}"].values[:, i], unit, shown) for what in ("mean", "std"))
        colour = LIGHT["posterior"]
        low, high = band(mean, std, 2, bool(data["positive"].values[i]))
        ax.fill_between(time, low, high, color=colour, alpha=0.25, lw=0, label="± 2 std")
        ax.plot(time, mean, color=colour, lw=0.9, label=kind)
        if name in read_as:
            readings = convert(data["observations"].values[:, read_as.index(name)], unit, shown)
            ax.plot(time, readings, ".", color=LIGHT["ink"], ms=2.5, label="readings", zorder=3)
        ax.set_ylabel(with_unit(name, shown))
    stack = sorted(stack, key=lambda ax: len(ax.get_lines()), reverse=True)[:1] + list(stack)  # its legend has it all
    return labelled(figure, stack, str(data["time"].attrs["display_units"]))


@styled
def innovations(data: xr.Dataset) -> Figure:
    """Innovations in time over ± 2 expected std, some of the observations."""
    chosen = _some(np.arange(data.sizes["observation"]), SHOWN)
    figure, stack = stacked_axes(len(chosen), 2.6, PAGE)
    time = _times(data)
    innovation = data["observations"].values - data["predicted_mean"].values
    expected = _expected(data)
    for i, ax in zip(chosen, stack, strict=True):
        units = (str(data[f"observation_{kind}"].values[i]) for kind in ("units", "display_units"))
        unit, shown = units
        there = np.isfinite(innovation[:, i])
        at, width = time[there], 2 * convert(expected[there, i], unit, shown)
        ax.fill_between(at, -width, width, color=LIGHT["prior"], alpha=0.3, lw=0, label="± 2 expected std")
        ax.axhline(0, color=LIGHT["muted"], lw=0.5)
        ax.plot(at, convert(innovation[there, i], unit, shown), ".", color=LIGHT["ink"], ms=2.5, label="innovation")
        ax.set_ylabel(with_unit(str(data["observation"].values[i]), shown))
    return labelled(figure, stack, str(data["time"].attrs["display_units"]))


def _best(data: xr.Dataset) -> str:
    return "smoothed" if "smoothed_mean" in data else "analysis"


def _times(data: xr.Dataset) -> Array:
    a = data["time"].attrs
    return np.asarray(convert(data["time"].values, str(a["units"]), str(a["display_units"])))


def _expected(data: xr.Dataset) -> Array:
    """(K, p) expected standard deviations of the innovations."""
    return np.asarray(np.hypot(data["predicted_std"].values, data["observation_std"].values))


def _parameters(data: xr.Dataset) -> npt.NDArray[np.intp]:
    """Where the estimated parameters stand in the state."""
    names, state = str(data.attrs["parameters"]).split(", "), [str(name) for name in data["state"].values]
    return np.array([state.index(name) for name in names if name in state], dtype=np.intp)


def _some(places: npt.NDArray[np.intp], most: int) -> npt.NDArray[np.intp]:
    """All of few, else some that are spread evenly."""
    return places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))]


def _estimates(data: xr.Dataset) -> list[tuple[str, str, str, str]]:
    rows: list[tuple[str, str, str, str]] = []
    last = {what: data[f"analysis_{what}"].values[-1] for what in ("mean", "std")}
    for i, name in enumerate(data["state"].values):
        unit, shown = str(data["units"].values[i]), str(data["display_units"].values[i])
        mean, std = (float(convert(float(values[i]), unit, shown)) for values in last.values())
        if std > CERTAIN * abs(mean) and len(rows) < 40:
            rows.append((str(name), plain_number(mean, 4), plain_number(std, 2), pretty_unit(shown)))
    return rows


def _innovations(data: xr.Dataset) -> list[tuple[str, str, str, str]]:
    rows = []
    for i, name in enumerate(data["observation"].values[:40]):
        found = data["normalised_innovation"].values[:, i]
        found = found[np.isfinite(found)]
        size = plain_number(float(np.sqrt(np.mean(found**2))), 3) if len(found) else "–"
        share = f"{100 * np.mean(np.abs(found) <= 2):.0f} %" if len(found) else "–"
        rows.append((str(name), str(len(found)), size, share))
    return rows


def _facts(data: xr.Dataset) -> list[tuple[str, str, str]]:
    """(quantity, value, in words) for the tiles on top."""
    a = data.attrs
    members, lost = int(a["members"]), int(a["members_lost"])
    iterations = plain_number(float(data["iterations"].values.mean()), 3)
    readings = int(np.isfinite(data["observations"].values).sum())
    return [
        ("Scheme", str(a["scheme"]), f"forecasts of the window an observation time: {iterations}"),
        ("Members alive", f"{members - lost} of {members}", "at the end of the run"),
        ("Times", str(data.sizes["time"]), "at which there were observations"),
        ("Readings", str(readings), f"of {data.sizes['observation']} quantities"),
        ("Forward runs", str(int(a["forward_runs"])), "of one member over a window"),
    ]
