"""Page and figures of a twin experiment, from ``twin.nc`` alone: RMSE and spread in time, the state and its truth,
ranks of the truth among the members, and whether the spread says how large the error is.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from en4dvar.report.cycles import RANKS, labelled, ranks, stacked_axes, write_cycles_page
from en4dvar.report.style import COLUMN, LIGHT, Captioned, styled
from en4dvar.report.text import plain_number, pretty_unit, with_unit
from en4dvar.storage.cycles_file import read_cycles
from en4dvar.storage.twin_file import MEAN

COLOURS = {"forecast": "prior", "analysis": "posterior", "smoothed": "background"}
SHOWN = 4  # variables of the state in the second figure
LAST = 200  # cycles in it
MOST_BARS = 21  # of the histogram of the truth's rank
GROUPS = 12  # of spreads


def write_twin_report(run_dir: Path) -> Path:
    """Write figures (PDF and PNG) and ``report.html`` from ``twin.nc``; returns the path of the page.

    Raises :class:`~en4dvar.errors.OutputError` where there is nothing to read or the directory cannot be written.
    """
    data = read_cycles(run_dir / "twin.nc")
    columns = ["estimate", with_unit("RMSE", _unit(data)), with_unit("spread", _unit(data)), "spread / RMSE"]
    words = "Averages over the cycles after the burn-in. The spread of a reliable ensemble is about its RMSE."
    return write_cycles_page(
        run_dir,
        data,
        kind="Twin experiment",
        what="a truth is drawn and observed, and the assimilation is judged against it.",
        facts=_facts(data),
        tables=[("Scores", columns, _scores(data), words)],
        figures=twin_figures(data),
    )


def twin_figures(data: xr.Dataset) -> Iterator[Captioned]:
    """Each figure with its caption."""
    burn_in = int(data.attrs["burn_in"])
    words = " The first cycles, shaded, do not count in the averages." if burn_in else ""
    yield "scores", f"RMSE against the truth (line) and spread (dashed) of each estimate in time.{words}", scores(data)
    shown = f"Error of the analysis within two standard deviations, last {min(LAST, data.sizes['time'])} cycles"
    yield "errors", f"{shown}, some variables of the state. A reliable ensemble has 95 % within.", errors(data)
    yield (
        "truth_ranks",
        "Rank of the truth among the members, over all cycles and variables that count, relative to a flat histogram.",
        truth_ranks(data),
    )
    yield (
        "reliability",
        f"RMSE of the values in {GROUPS} groups of the same size, by their spread, against that spread. A reliable "
        "ensemble lies on the diagonal: where it is spread wide, its error is large.",
        reliability(data),
    )
    yield "ranks", RANKS, ranks(data.isel(time=slice(burn_in, None)))


@styled
def scores(data: xr.Dataset) -> Figure:
    """RMSE and spread in time, one panel an estimate, averages after the burn-in as thin lines."""
    kinds, time = _kinds(data), data["time"].values
    figure, stack = stacked_axes(len(kinds), 3.0)
    for ax, kind in zip(stack, kinds, strict=True):
        colour = LIGHT[COLOURS[kind]]
        rmse, spread = data[f"{kind}_rmse"], data[f"{kind}_spread"]
        ax.plot(time, rmse, color=colour, lw=0.7, label="RMSE")
        ax.plot(time, spread, color=LIGHT["centre"], lw=0.7, ls="--", label="spread")
        ax.axhline(float(rmse.attrs[MEAN]), color=colour, lw=0.6)
        if burn_in := int(data.attrs["burn_in"]):
            ax.axvspan(time[0], time[burn_in - 1], color=LIGHT["grid"], alpha=0.5, lw=0)
        ax.set_title(f"{kind}: RMSE {plain_number(float(rmse.attrs[MEAN]), 3)}", loc="left")
        ax.set_ylim(0, _upper(rmse.values, spread.values))
        ax.set_ylabel(with_unit("error", _unit(data)))
    return labelled(figure, stack, str(data["time"].attrs["units"]))


@styled
def errors(data: xr.Dataset) -> Figure:
    """Error of the analysis within ± 2 std, in the last cycles; titles say how often over all that count."""
    burn_in = int(data.attrs["burn_in"])
    error, std = (data["analysis_mean"] - data["truth"]).values, data["analysis_std"].values
    inside = np.mean(np.abs(error[burn_in:]) <= 2 * std[burn_in:], axis=0)
    varied = np.flatnonzero(std.max(axis=0) > 1e-9 * np.abs(data["truth"].values).max(axis=0))  # not what is held fixed
    chosen = np.unique([*varied[: SHOWN - 1], varied[-1]])  # the last is an estimated parameter, if there is one
    figure, stack = stacked_axes(len(chosen), 2.6)
    time = data["time"].values[-LAST:]
    for i, ax in zip(chosen, stack, strict=True):
        width = 2 * std[-LAST:, i]
        ax.fill_between(time, -width, width, color=LIGHT["posterior"], alpha=0.25, lw=0, label="± 2 std")
        ax.axhline(0, color=LIGHT["muted"], lw=0.5)
        ax.plot(time, error[-LAST:, i], color=LIGHT["ink"], lw=0.8, label="analysis − truth")
        name = str(data["state"].values[i])
        ax.set_title(f"{name}: {100 * inside[i]:.0f} % within 2 std", loc="left")
        ax.set_ylabel(with_unit("error", str(data["units"].values[i])))
    return labelled(figure, stack, str(data["time"].attrs["units"]))


@styled
def truth_ranks(data: xr.Dataset) -> Figure:
    """Histogram of the rank of the truth, one panel an estimate; 1 is what a flat one has."""
    kinds = _kinds(data)
    figure, stack = stacked_axes(len(kinds), 2.6)
    size = int(data.attrs["members"]) - int(data.attrs["members_lost"]) + 1
    edges = np.round(np.linspace(0, size, min(size, MOST_BARS) + 1)) / size  # whole ranks in a bar
    for ax, kind in zip(stack, kinds, strict=True):
        found = _counted(data, data[f"{kind}_rank"].values)
        count, _ = np.histogram(found, edges)
        relative = count / (np.diff(edges) * max(1, len(found)))
        ax.stairs(relative, edges, fill=True, color=LIGHT[COLOURS[kind]], alpha=0.6)
        ax.axhline(1, color=LIGHT["ink"], lw=0.8, ls="--")
        ax.set_title(kind, loc="left")
        ax.set_ylabel("frequency")
        ax.set_xlim(0, 1)
    stack[-1].set_xlabel("share of the members below the truth")
    return figure


@styled
def reliability(data: xr.Dataset) -> Figure:
    """RMSE against spread, in groups of the same size, one line an estimate."""
    figure = Figure(figsize=(COLUMN, COLUMN), layout="constrained")
    ax = figure.subplots()
    largest = 0.0
    for kind in _kinds(data):
        spread = _counted(data, data[f"{kind}_std"].values)
        error = _counted(data, (data[f"{kind}_mean"] - data["truth"]).values)
        groups = np.array_split(np.argsort(spread, kind="stable"), min(GROUPS, max(1, len(spread))))
        x, y = (np.array([np.sqrt(np.mean(v[g] ** 2)) for g in groups]) for v in (spread, error))
        ax.plot(x, y, color=LIGHT[COLOURS[kind]], lw=1, marker="o", ms=3, label=kind)
        largest = max(largest, float(x.max(initial=0)), float(y.max(initial=0)))
    ax.plot([0, largest], [0, largest], color=LIGHT["ink"], lw=0.8, ls="--")
    ax.set_xlabel(with_unit("spread", _unit(data)))
    ax.set_ylabel(with_unit("RMSE", _unit(data)))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def _counted(data: xr.Dataset, values: np.ndarray) -> np.ndarray:
    """Values (K, n) that are there, after the burn-in, of the variables that scores count, as one row."""
    wanted = values[int(data.attrs["burn_in"]) :, data["dynamic"].values.astype(bool)].ravel()
    return np.asarray(wanted[np.isfinite(wanted)])


def _kinds(data: xr.Dataset) -> list[str]:
    return [kind for kind in COLOURS if f"{kind}_rmse" in data]


def _unit(data: xr.Dataset) -> str:
    return pretty_unit(str(data["analysis_rmse"].attrs["units"]))


def _upper(*series: Any) -> float:
    """A limit that one bad beginning does not set: twice the 98 % quantile, no more than the maximum."""
    values = np.concatenate([s[np.isfinite(s)] for s in series])
    return float(min(1.05 * values.max(), 2 * np.quantile(values, 0.98))) if len(values) else 1.0


def _scores(data: xr.Dataset) -> list[tuple[str, str, str, str]]:
    """(estimate, RMSE, spread, spread over RMSE) after the burn-in."""
    rows = []
    for kind in _kinds(data):
        rmse, spread = (float(data[f"{kind}_{what}"].attrs[MEAN]) for what in ("rmse", "spread"))
        rows.append((kind, plain_number(rmse, 4), plain_number(spread, 4), plain_number(spread / rmse, 3)))
    return rows


def _facts(data: xr.Dataset) -> list[tuple[str, str, str]]:
    """(quantity, value, in words) for the tiles on top."""
    a = data.attrs
    cycles, burn_in, members, lost = data.sizes["time"], int(a["burn_in"]), int(a["members"]), int(a["members_lost"])
    iterations = float(data["iterations"].values[burn_in:].mean())
    return [
        ("Scheme", str(a["scheme"]), f"forecasts of the window a cycle: {plain_number(iterations, 3)}"),
        ("Members alive", f"{members - lost} of {members}", "at the end of the run"),
        ("Cycles", str(cycles), f"{burn_in} of them do not count in the averages"),
        ("Observations", str(data.sizes["observation"]), "a cycle"),
        ("Forward runs", str(int(a["forward_runs"])), "of one member over a window"),
    ]
