"""What each reading does to the posterior and how far it lies from the prior: a figure and two sentences."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from en4dvar.influence import UNKNOWN
from en4dvar.report.style import COLUMN, LIGHT, styled
from en4dvar.report.text import fixed, plain_number, pretty_unit, shown, signed, symbol_html, with_unit
from en4dvar.state import Array
from en4dvar.storage.store import StoredResult
from en4dvar.units import convert

CAPTION = (
    "What each reading does. Above, one panel a parameter: change of the posterior mean, in posterior standard "
    "deviations, if that reading alone is left out; nothing is drawn where only another fit tells. Below: distance of "
    "the reading from what the prior predicts, in the standard deviation of both; beyond 3 they are in conflict."
)
FAR = 3.0  # std between a reading and the prior that are told


def has_influence(result: StoredResult) -> bool:
    """Whether the file says what leaving out a reading would change."""
    return "influence_in_std" in result.sample_stats


@styled
def influence(result: StoredResult) -> Figure:
    """Change of each parameter without each reading, and the distance of the readings from the prior, over time."""
    stats, rows = result.sample_stats, result.summary() if has_influence(result) else ()
    time = shown(result.observed_data["time"])
    figure = Figure(figsize=(COLUMN, (3.6 + 1.7 * len(rows)) / 2.54), layout="constrained")
    axes = figure.subplots(len(rows) + 1, 1, sharex=True, squeeze=False).ravel()
    for ax, row in zip(axes, rows, strict=False):
        change = np.asarray(stats["influence_in_std"].sel(parameter=row.name).values)
        _stems(ax, time, change, "posterior")
        ax.set_ylabel(row.symbol)
        reach = 1.15 * max(0.1, float(np.nanmax(np.abs(change), initial=0.0)))
        ax.set_ylim(-reach, reach)
    distance = np.asarray(stats[f"{result.observable}_prior_distance"].values)
    last = axes[-1]
    last.axhspan(-FAR, FAR, color=LIGHT["prior"], alpha=0.16, lw=0)
    _stems(last, time, distance, "ink")
    last.set(xlabel=with_unit("time", result.observed_data["time"].attrs["display_units"]), ylabel="prior distance")
    return figure


def _stems(ax: Axes, time: Array, values: Array, colour: str) -> None:
    many = len(time) > 500
    ax.axhline(0, color=LIGHT["muted"], lw=0.6)
    if not many:
        ax.vlines(time, 0, values, color=LIGHT[colour], lw=0.8)
    ax.plot(time, values, "o", ms=1.2 if many else 2.6, color=LIGHT[colour], rasterized=many)


def reading_words(result: StoredResult) -> list[Markup]:
    """The reading that moves a parameter most, the one farthest from the prior; or why that is not told."""
    found = [_most_moving(result) if has_influence(result) else _why_not(result), _farthest(result)]
    return [words for words in found if words]


def _most_moving(result: StoredResult) -> Markup:
    in_std, change = (np.asarray(result.sample_stats[f"influence_{key}"].values) for key in ("in_std", "change"))
    if not np.isfinite(in_std).any():
        return Markup("What leaving out a reading would change only another fit tells: each of them decides too much.")
    j, k = np.unravel_index(int(np.nanargmax(np.abs(in_std))), in_std.shape)
    row = result.summary()[int(j)]
    about = result.posterior[row.name].attrs
    size = convert(float(change[j, k]), about["units"], about["display_units"])
    words = Markup(
        "Without the reading at {} {} would change most: by {} {}, {} posterior standard deviations."
    ).format(
        _time(result, int(k)), symbol_html(row.symbol), signed(size), pretty_unit(row.unit), fixed(abs(in_std[j, k]), 1)
    )
    blank = int(np.sum(np.asarray(result.sample_stats["influence_how"].values) == UNKNOWN))
    return words + (f" For {blank} of {in_std.shape[1]} readings only another fit tells." if blank else "")


def _farthest(result: StoredResult) -> Markup:
    distance = np.asarray(result.sample_stats[f"{result.observable}_prior_distance"].values)
    if not np.isfinite(distance).any():
        return Markup("")
    k, beyond = int(np.nanargmax(np.abs(distance))), int(np.sum(np.abs(distance) > FAR))
    count = f"{beyond} of {len(distance)} readings lie" if beyond else "No reading lies"
    return Markup("{} more than {} standard deviations from what the prior predicts; the farthest, at {}, {}.").format(
        count, plain_number(FAR), _time(result, k), signed(float(distance[k]))
    )


def _why_not(result: StoredResult) -> Markup:
    reason = str(result.sample_stats.attrs.get("influence_reason", ""))
    return Markup("What leaving out a reading would change is not told: {}.").format(reason) if reason else Markup("")


def _time(result: StoredResult, k: int) -> str:
    time = result.observed_data["time"]
    return f"{plain_number(float(shown(time)[k]))} {pretty_unit(time.attrs['display_units'])}".strip()
