"""The page of a joint estimate: what the experiments share, what each says alone, and how each is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED, member_quantiles
from en4dvar.diagnosis.honesty.checks import MOVED
from en4dvar.estimation.summary import ParameterSummary, estimate_cells
from en4dvar.plumbing.caution import Caution, untrusted
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.report.chart import COLUMN, PAGE, POINTS, Chart, Panel, in_columns
from en4dvar.report.html import write_page
from en4dvar.report.svg import svg
from en4dvar.report.text import axis_label, figure_text, number_like, range_words, shown, unit_behind, with_unit
from en4dvar.results.declared import parameter_of
from en4dvar.results.joint_file import FILE, QUANTILES, StoredGroups, StoredJoint, load_joint

MOST_FITS = 12  # panels of the figure
NOTHING = np.full(1, np.nan)
NINETY = 3.2897073  # std of a normal distribution between its 5 and 95 %
CAPTION = "Median and 5–95 % of what is shared, as each data set has it alone (grey) and as all have it together."
FITS = "Observations and 5–95 % of the joint posterior's predictions."


@dataclass(frozen=True)
class JointRow(ParameterSummary):
    """One number of the joint estimate; ``dataset`` "" for what is shared, ``without`` the names of the odd data sets
    where they are left out. ``stated``: the data have neither narrowed nor moved what is shared.
    """

    dataset: str = ""
    without: str = ""
    stated: bool = False


def estimates(joint: StoredJoint) -> tuple[JointRow, ...]:
    """What is shared, without the odd data sets too, then what is each data set's own."""
    posterior, odd, rows = joint.group("posterior"), ", ".join(joint.odd), []
    for name, values in posterior.data_vars.items():
        if "dataset" not in values.dims:
            row = _estimate(joint.cautions, str(name), values)
            rows.append(replace(row, stated=not row.untrusted and _as_stated(joint, str(name))))
            continue
        for dataset in joint.datasets:
            own = values.sel(dataset=dataset)
            if np.isfinite(own.values).any():
                rows.append(_estimate(joint.cautions, str(name), own, dataset))
    if odd:
        rest = joint.group("without").data_vars.items()
        rows += [_estimate(joint.cautions_without, str(name), values, without=odd) for name, values in rest]
    shared = list(joint.shared)
    return tuple(sorted(rows, key=lambda row: (1,) if row.dataset else (0, row.stated, shared.index(row.name))))


def _as_stated(joint: StoredJoint, name: str) -> bool:
    """Whether the posterior of what is shared has the mean and the width of its prior."""
    draws, (low, middle, high) = joint.group("posterior")[name].values, joint.group("prior")[name].values
    std = (high - low) / NINETY
    return bool(draws.std() > np.sqrt(1 - HARDLY_INFORMED) * std and abs(np.median(draws) - middle) < MOVED * std)


def _estimate(
    cautions: Sequence[Caution], name: str, values: xr.DataArray, dataset: str = "", without: str = ""
) -> JointRow:
    row = ParameterSummary.of(
        parameter_of(name, values.attrs), NOTHING, shown(values).ravel(), np.nan, np.nan, cautions
    )
    return JointRow(**vars(row), dataset=dataset, without=without)


def joint_lines(joint: StoredJoint) -> list[str]:
    """What is shared, a line each, for the page of the campaign; one line for what the data leave as it was stated."""
    lines, shared = [], [e for e in estimates(joint) if not e.dataset]
    for e in (e for e in shared if not e.stated):
        without = f" without {e.without}" if e.without else f", one value in {len(joint.datasets)} data sets"
        interval = f"5–95 %: {range_words(e.q05, e.q95, e.std, e.unit)}"
        doubt = f"not to be trusted: {', '.join(e.untrusted)}" if e.untrusted else interval
        lines.append(f"{e.label} {e.name} = {number_like(e.q50, e.std)}{unit_behind(e.unit)} ({doubt}){without}")
    if stated := [e.label for e in shared if e.stated]:
        lines.append(f"left as stated beforehand, for the data say nothing new of them: {', '.join(stated)}")
    return lines


def figure(joint: StoredJoint) -> str:
    """All data sets over what they share, as SVG; without what the data leave as it was stated, where there is more."""
    names = [name for name in joint.shared if not _as_stated(joint, name)] or joint.shared
    shared = {name: joint.group("posterior")[name] for name in names}
    return svg(forest(joint, joint.datasets, shared), "forest", CAPTION)


def joint_table(joint: StoredJoint) -> str:
    """What is shared, for the terminal."""
    rows = [
        (f"{e.name} without {e.without}" if e.without else e.name, e.unit, *estimate_cells(e))
        for e in estimates(joint)
        if not e.dataset
    ]
    return table([("shared", "unit", "mean", "std", "5 %", "50 %", "95 %"), *rows])


def forest(
    groups: StoredGroups, datasets: Sequence[str], common: Mapping[str, xr.DataArray],
    reference: Mapping[str, tuple[float, float]] | None = None,
) -> Chart:  # fmt: skip
    """Each data set alone, and the draws of what is ``common``, one panel each; of some a ``reference`` of others.

    Where the posterior has the parameter for each data set too, that is drawn below what the data set says alone.
    """
    alone, posterior, count = groups.group("alone"), groups.group("posterior"), len(datasets)
    named = count <= 60
    panels = []
    for name, draws in common.items():
        low, middle, high = shown(draws, member_quantiles(draws.values, QUANTILES))
        panel = Panel(axis_label(draws), ylim=(-float(count), 1.0))
        panel.yticks, panel.y_names = (range(0, -count, -1), [figure_text(d) for d in datasets]) if named else ((), ())
        if not untrusted(groups.cautions, name):
            panel.band([low, high], np.full(2, -count), np.ones(2), "posterior", 0.2)
        panel.line([middle, middle], [-count, 1], "posterior")
        if reference and name in reference:
            value = float(shown(draws, reference[name][0]))
            panel.line([value, value], [-count, 1], "ink", dash=":")
        rows = shown(draws, alone[name].values)
        has = np.flatnonzero(np.isfinite(rows[:, 1]))
        panel.intervals(rows[has, 0], rows[has, 2], -has, "prior")
        panel.dots(rows[has, 1], -has, "prior", 3.0)
        if "dataset" in posterior.get(name, draws).dims:
            low, middle, high = shown(draws, member_quantiles(posterior[name].values[0], QUANTILES, axis=0))
            panel.intervals(low[has], high[has], -has - 0.3, "posterior")
            panel.dots(middle[has], -has - 0.3, "posterior", 2.0)
        panel.x_logarithmic = bool(np.all(rows[has] > 0) and rows[has].max() > 20 * rows[has].min())
        panels.append(panel)
    height = (2.0 + 0.36 * min(count, 60)) * POINTS
    return in_columns(panels, height, width=COLUMN * (2 if len(common) > 1 else 1))


def fits(joint: StoredJoint) -> Chart | None:
    """Observations and bands of the first data sets that have several; no panel where a set is one number."""
    fit, panels = joint.group("fit"), []
    followed = [name for name in joint.datasets if np.isfinite(fit["time"].sel(dataset=name).values).sum() > 1]
    for name in followed[:MOST_FITS]:
        curve = fit.sel(dataset=name)
        times, low, middle, high = curve["band"].values.T
        label = with_unit(str(curve["observable"].item()), str(curve["unit"].item()))
        panel = Panel(with_unit("time", str(curve["time_unit"].item())), label, title=figure_text(name))
        panel.band(times, low, high, "posterior", 0.25)
        panel.line(times, middle, "posterior")
        panel.dots(curve["time"].values, curve["value"].values, "ink", 1.8)
        panels.append(panel)
    return in_columns(panels, 3.6 * POINTS, width=PAGE) if panels else None


def write_joint(folder: Path) -> Path:
    """Write ``joint.html`` and ``joint.csv`` from ``joint.nc``; returns the path of the page.

    Raises :class:`OutputError`.
    """
    joint = load_joint(folder / FILE)
    rows, fit, absent = estimates(joint), joint.group("fit"), np.full(len(joint.datasets), np.nan)
    # of each data set under the shared values the misfit per reading, and how far it is from all others alone
    fitted = [fit[c].values if c in fit else absent for c in ("chi2_per_observation", "distance", "chance")]
    columns = ("name", "dataset", "without", "mean", "std", "q05", "q50", "q95", "unit")
    cells = [[getattr(e, c) for c in columns] + [" ".join(e.untrusted)] for e in rows]
    write_csv(folder / "joint.csv", [[*columns, "warnings"], *cells])
    return write_page(
        folder / "joint.html",
        "joint.html.j2",
        joint=joint,
        shared=[e for e in rows if not e.dataset],
        own=[e for e in rows if e.dataset],
        forest=figure(joint),
        caption=CAPTION,
        fits=svg(drawn, "fits", FITS) if (drawn := fits(joint)) else "",
        fits_caption=FITS + (f" The first {MOST_FITS}." if len(joint.datasets) > MOST_FITS else ""),
        sets=[*zip(joint.datasets, *fitted, strict=True)],
    )
