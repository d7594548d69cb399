"""The page of a joint estimate: what the experiments share, what each says alone, and how each is fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from en4dvar.caution import untrusted
from en4dvar.files import write_text
from en4dvar.report.html import render
from en4dvar.report.style import COLUMN, LIGHT, PAGE, inline_svg, panels, styled
from en4dvar.report.text import figure_text, with_unit
from en4dvar.storage.joint_file import QUANTILES, StoredGroups, StoredJoint
from en4dvar.tables import csv_text, table
from en4dvar.units import convert

MOST_FITS = 12  # panels of the figure
CAPTION = "Median and 5–95 % of what is shared, as each data set has it alone (grey) and as all have it together."
FITS = "Observations and 5–95 % of the joint posterior's predictions."


@dataclass(frozen=True)
class JointRow:
    """One number of the joint estimate in its display unit; ``dataset`` "" for what is shared."""

    name: str
    label: str
    symbol: str
    dataset: str
    mean: float
    std: float
    q05: float
    q50: float
    q95: float
    unit: str
    untrusted: tuple[str, ...]
    modal: bool = False


def estimates(found: StoredJoint) -> tuple[JointRow, ...]:
    """What is shared, then what is each data set's own."""
    posterior, rows = found.group("posterior"), []
    for name, values in posterior.data_vars.items():
        if "dataset" not in values.dims:
            rows.append(_estimate(found, str(name), values, ""))
            continue
        for dataset in found.datasets:
            own = values.sel(dataset=dataset)
            if np.isfinite(own.values).any():
                rows.append(_estimate(found, str(name), own, dataset))
    return tuple(sorted(rows, key=lambda row: bool(row.dataset)))


def _estimate(found: StoredJoint, name: str, values: xr.DataArray, dataset: str) -> JointRow:
    about = values.attrs
    unit, shown = str(about["units"]), str(about["display_units"])
    members = convert(values.values.ravel(), unit, shown)
    q05, q50, q95 = map(float, np.quantile(members, QUANTILES))
    mean, std = float(members.mean()), float(members.std(ddof=1))
    doubted = untrusted(found.cautions, name)
    label, symbol = str(about["long_name"]), str(about["symbol"])
    return JointRow(name, label, symbol, dataset, mean, std, q05, q50, q95, shown, doubted)


def joint_table(found: StoredJoint) -> str:
    """What is shared, for the terminal."""
    rows = [
        (e.name, e.unit, f"{e.mean:.4g}", *(["–"] * 4 if e.untrusted else _numbers(e)))
        for e in estimates(found)
        if not e.dataset
    ]
    return table([("shared", "unit", "mean", "std", "5 %", "50 %", "95 %"), *rows])


def _numbers(e: JointRow) -> list[str]:
    return [f"{value:.4g}" for value in (e.std, e.q05, e.q50, e.q95)]


@styled
def forest(found: StoredGroups, datasets: Sequence[str], common: Mapping[str, xr.DataArray]) -> Figure:
    """Each data set alone, and the draws of what is ``common``, one panel each.

    Where the posterior has the parameter for each data set too, that is drawn below what the data set says alone.
    """
    count = len(datasets)
    figure, axes = panels(len(common), COLUMN * (2 if len(common) > 1 else 1), 0.8 + 0.14 * min(count, 60))
    alone, posterior = found.group("alone"), found.group("posterior")
    for ax, (name, draws) in zip(axes, common.items(), strict=True):
        about = draws.attrs
        units = str(about["units"]), str(about["display_units"])
        low, middle, high = convert(np.quantile(draws.values, QUANTILES), *units)
        if not untrusted(found.cautions, name):
            ax.axvspan(low, high, color=LIGHT["posterior"], alpha=0.2, lw=0)
        ax.axvline(middle, color=LIGHT["posterior"])
        rows = convert(alone[name].values, *units)
        has = np.flatnonzero(np.isfinite(rows[:, 1]))
        ax.hlines(-has, rows[has, 0], rows[has, 2], color=LIGHT["prior"])
        ax.plot(rows[has, 1], -has, "o", ms=3, color=LIGHT["prior"])
        if "dataset" in posterior.get(name, draws).dims:
            low, middle, high = convert(posterior[name].quantile(QUANTILES, ("chain", "draw")).values, *units)
            ax.hlines(-has - 0.3, low[has], high[has], color=LIGHT["posterior"])
            ax.plot(middle[has], -has - 0.3, "o", ms=2, color=LIGHT["posterior"])
        ax.set(xlabel=with_unit(str(about["symbol"]), units[1]), ylim=(-count, 1))
        ax.set_yticks(-np.arange(count), [figure_text(d) for d in datasets] if count <= 60 else [""] * count)
        ax.tick_params(axis="y", length=0, labelsize=6)
        if np.all(rows[has] > 0) and rows[has].max() > 20 * rows[has].min():
            ax.set_xscale("log")
    return figure


@styled
def fits(found: StoredJoint) -> Figure:
    """Observations and bands of the first data sets."""
    fit = found.group("fit")
    shown = found.datasets[:MOST_FITS]
    figure, axes = panels(len(shown), PAGE, 1.3)
    for ax, name in zip(axes, shown, strict=True):
        one = fit.sel(dataset=name)
        times, low, middle, high = one["band"].values.T
        ax.fill_between(times, low, high, color=LIGHT["posterior"], alpha=0.25, lw=0)
        ax.plot(times, middle, color=LIGHT["posterior"])
        ax.plot(one["time"], one["value"], ".", ms=3, color=LIGHT["ink"])
        label = with_unit(str(one["observable"].item()), str(one["unit"].item()))
        ax.set(title=figure_text(name), xlabel=with_unit("time", str(one["time_unit"].item())), ylabel=label)
    return figure


def write_joint(found: StoredJoint, folder: Path) -> Path:
    """Write ``joint.html`` and ``joint.csv``. Returns the path of the page. Raises :class:`OutputError`."""
    rows = estimates(found)
    columns = ("name", "dataset", "mean", "std", "q05", "q50", "q95", "unit")
    cells = [[getattr(e, c) for c in columns] + [" ".join(e.untrusted)] for e in rows]
    write_text(folder / "joint.csv", csv_text([[*columns, "warnings"], *cells]))
    fit, shared = found.group("fit"), {name: found.group("posterior")[name] for name in found.shared}
    page = render(
        "joint.html.j2",
        title="Joint estimate",
        sortable=True,
        runs=str(found.tree.attrs["runs"]),
        count=len(found.datasets),
        shared=[e for e in rows if not e.dataset],
        own=[e for e in rows if e.dataset],
        forest=inline_svg(forest(found, found.datasets, shared), "forest", CAPTION),
        caption=CAPTION,
        fits=inline_svg(fits(found), "fits", FITS),
        fits_caption=FITS + (f" The first {MOST_FITS}." if len(found.datasets) > MOST_FITS else ""),
        misfits=list(zip(found.datasets, map(float, fit["chi2_per_observation"].values), strict=True)),
        attributes=found.tree.attrs,
        cautions=[(c, "") for c in found.cautions],
    )
    return write_text(folder / "joint.html", page)
