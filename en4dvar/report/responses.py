"""How a posterior responds to its assumptions and to each reading: rows of tables, sentences of the page, a figure."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from en4dvar.diagnosis.honesty.checks import CLOCK
from en4dvar.diagnosis.influence import UNKNOWN
from en4dvar.diagnosis.response.what_if import exclusion, is_manifold
from en4dvar.model.state import Array
from en4dvar.report.chart import POINTS, Chart, Panel, Row
from en4dvar.report.text import fixed, plain_number, quantity, shown, signed, symbol_html, time_axis, unit_behind
from en4dvar.results.declared import zero_of
from en4dvar.results.netcdf import Variable
from en4dvar.results.store import StoredResult

SHIFT_COLUMNS = (
    "alternative", "if", "parameter", "unit", "change", "relative_change", "change_in_std", "cost_change", "reason",
)  # fmt: skip
ENTRY_COLUMNS = ("parameter", "quantity", "unit", "q05", "q50", "q95")


class StoredShift(NamedTuple):
    """What one parameter would do under an alternative, in its display unit; ``relative``: of the value, NaN where that
    may be negative; ``reason``: why linear response does not tell, or "". Cells of :data:`SHIFT_COLUMNS`, a symbol, and
    ``excluded``: words where the readings exclude the alternative, or "".
    """

    alternative: str
    words: str
    parameter: str
    unit: str
    change: float
    relative: float
    in_std: float
    cost_change: float
    reason: str
    symbol: str
    excluded: str = ""

    @property
    def exceeds(self) -> bool:
        """Whether it is more than the parameter's standard deviation."""
        return abs(self.in_std) > 1


class StoredEntry(NamedTuple):
    """Where a parameter was informed in a quantity of the path: :data:`ENTRY_COLUMNS`, its symbol, and the label."""

    parameter: str
    quantity: str
    unit: str
    low: float
    median: float
    high: float
    symbol: str
    label: str


def stored_ledger(result: StoredResult) -> tuple[tuple[StoredEntry, ...], ...]:
    """A row a parameter that acts along the path, in it one entry a quantity of the path; display units."""
    stats = result.groups["/sample_stats"]
    if "ledger_weight" not in stats.variables:
        return ()

    def entry(i: int, parameter: str, key: str) -> StoredEntry:
        v, quantity = stats.variables[key], key.removeprefix("ledger_").removesuffix("_quantiles")
        (low, median, high), unit = shown(v)[i].tolist(), v.attrs["display_units"]
        symbol, label = result.parameters[parameter].attrs["symbol"], v.attrs["long_name"]
        return StoredEntry(parameter, quantity, unit, low, median, high, symbol, label)

    keys = [key for key in stats.variables if key.endswith("_quantiles")]
    names = map(str, stats.coords["path_parameter"].values)
    return tuple(tuple(entry(i, name, key) for key in keys) for i, name in enumerate(names))


def stored_shifts(result: StoredResult) -> tuple[tuple[StoredShift, ...], ...]:
    """A row an alternative, in it one shift a parameter; the largest first, then those unknown, then small ones."""
    stats = result.groups["/sample_stats"]
    if "what_if_change" not in stats.variables:
        return ()
    keys = "words", "cost_change", "reason", "change", "relative_change", "change_in_std"
    words, cost, reason, change, relative, in_std = (stats.variables[f"what_if_{key}"].values for key in keys)
    of_before = stats.variables["what_if_cost_change"]  # of files of earlier versions, which do not know its parts
    misfit = stats.variables.get("what_if_misfit_change", of_before).values
    chi2, readings = float(stats.attrs["chi2_per_observation"]), int(stats.attrs["n_weighted"])

    def shift(i: int, j: int, name: str, v: Variable) -> StoredShift:
        known = str(stats.coords["alternative"].values[i]), str(words[i]), name, v.attrs["display_units"]
        numbers = float(shown(v, change[i, j])), float(relative[i, j]), float(in_std[i, j]), float(cost[i])
        excluded = exclusion(chi2, readings, float(misfit[i]))
        return StoredShift(*known, *numbers, str(reason[i]), v.attrs["symbol"], excluded)

    order = np.argsort(-np.where(reason == "", np.abs(in_std).max(axis=1), 1.0), kind="stable").tolist()
    return tuple(tuple(shift(i, j, *p) for j, p in enumerate(result.parameters.items())) for i in order)


def shift_text(shift: StoredShift) -> str:
    """``"+15 %"``, ``"× 3.8"`` from a factor of two on, in its unit of what may be negative; "–" of what is unknown."""
    if is_manifold(shift.relative):
        return f"× {plain_number(1 + shift.relative, 2)}"
    value, unit = (100 * shift.relative, "%") if math.isfinite(shift.relative) else (shift.change, shift.unit)
    if not math.isfinite(value):
        return "–"
    bar = abs(value / shift.in_std) if shift.in_std else math.nan
    return f"{'+' * (value > 0)}{quantity(value, bar, unit)}"


def sentence(shifts: Sequence[StoredShift]) -> str:
    """What an alternative would do to the parameters that it moves beyond their error bar."""
    first = shifts[0]
    if first.reason:
        words = "the numbers may change by more than their error bars; only a fit with it shows this"
        return f"if {first.words}, {words} ({first.reason})"
    moved = sorted((s for s in shifts if s.exceeds), key=lambda s: -abs(s.in_std))
    told = Markup("{} would be {} ({} times its error bar)")
    parts = [told.format(symbol_html(s.symbol), _amount(s), fixed(abs(s.in_std), 1)) for s in moved]
    return Markup("if {}, {}").format(first.words, Markup(", ").join(parts))


def _amount(shift: StoredShift) -> str:
    if is_manifold(shift.relative):
        return f"{shift_text(shift).removeprefix('× ')} times as large"
    return f"{shift_text(shift).lstrip('+−')} {'higher' if shift.change > 0 else 'lower'}"


def exceeding(rows: Iterable[Sequence[StoredShift]]) -> list[Sequence[StoredShift]]:
    """The alternatives that move a parameter beyond its error bar, or may, and that the readings do not exclude."""
    return [row for row in rows if row[0].reason or (not row[0].excluded and any(shift.exceeds for shift in row))]


CAPTION = (
    "What each reading does. Above, one panel a parameter: change of the posterior mean, in posterior standard "
    "deviations, if only that reading is left out; nothing is drawn if this needs a new fit. Below: "
    "distance of the reading from the prior's prediction, in the standard deviation of both; beyond 3 they are in "
    "conflict."
)
FAR = 3.0  # std between a reading and the prior that are told
COLOURS = ("ink", "posterior", "centre", "background", "muted")  # of several series, in their order


def has_influence(result: StoredResult) -> bool:
    """Whether the file says what leaving out a reading would change."""
    return result.axes[0].own("influence_in_std") in result.group("sample_stats")


def times(result: StoredResult) -> Array:
    """(K,) of all readings, in the display unit."""
    return np.concatenate([shown(result.group("observed_data")[axis.time]) for axis in result.axes])


def time_label(result: StoredResult) -> str:
    """Of an axis of :func:`times`."""
    return time_axis(*(result.group("observed_data")[axis.time] for axis in result.axes))


def whitened(result: StoredResult) -> Array:
    """(K',) residuals of the readings that count, whitened; none of a result whose readings are few or of a field."""
    if f"{result.observable}_whitened_residual" not in result.group("sample_stats"):
        return np.empty(0)
    white = result.of_readings("sample_stats", "whitened_residual")
    return white[np.isfinite(white)]


def each_series(result: StoredResult, alone: str = "ink") -> list[tuple[npt.NDArray[np.intp], str]]:
    """Places among all readings of each series, and its colour; ``alone``: that of a single one."""
    sizes = [len(result.group("observed_data")[axis.name].values) for axis in result.axes]
    parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    names = [alone] if len(parts) == 1 else [COLOURS[i % len(COLOURS)] for i in range(len(parts))]
    return list(zip(parts, names, strict=True))


def influence(result: StoredResult) -> Chart:
    """Change of each parameter without each reading, and the distance of the readings from the prior, over time."""
    rows = result.rows if has_influence(result) else ()
    in_std = result.of_readings("sample_stats", "influence_in_std", shared=True) if rows else np.empty(0)
    panels = []
    for row, change in zip(rows, in_std, strict=False):
        reach = 1.15 * max(0.1, float(np.nanmax(np.abs(change), initial=0.0)))
        panel = Panel(ylabel=row.symbol, ylim=(-reach, reach), yticks=3, x_numbers=False)
        _stems(panel, result, change, "posterior")
        panels.append(panel)
    last = Panel(time_label(result), "prior distance", yticks=4)
    last.span(-FAR, FAR, "prior", 0.16)
    _stems(last, result, result.of_readings("sample_stats", "prior_distance"), "ink")
    panels.append(last)
    panels[0].legend = len(result.axes) > 1
    heights = [1.7] * len(rows) + [3.0]
    heights[0] += 0.5 if panels[0].legend else 0.0
    return Chart([Row(height * POINTS, [panel]) for height, panel in zip(heights, panels, strict=True)])


def _stems(panel: Panel, result: StoredResult, values: Array, alone: str) -> None:
    time = times(result)
    many = len(time) > 500
    panel.rule(0)
    for axis, (own, colour) in zip(result.axes, each_series(result, alone), strict=True):
        if not many:
            panel.bars(time[own], 0, values[own], colour, label=axis.name)
        panel.dots(time[own], values[own], colour, 1.2 if many else 2.6, label=axis.name)


def reading_words(result: StoredResult) -> list[Markup]:
    """The reading that moves a parameter most, the one farthest from the prior; or why that is not told."""
    reason = str(result.group("sample_stats").attrs.get("influence_reason", ""))
    not_told = Markup("The effect of leaving out a reading is not known: {}.").format(reason) if reason else Markup()
    sentences = [_most_moving(result) if has_influence(result) else not_told, _farthest(result)]
    return [words for words in sentences if words]


def _most_moving(result: StoredResult) -> Markup:
    keys = "influence_in_std", "influence_change", "influence_how"
    in_std, change, how = (result.of_readings("sample_stats", key, shared=True) for key in keys)
    if not np.isfinite(in_std).any():
        return Markup("Each reading is so influential that only a fit without it shows its effect.")
    j, k = np.unravel_index(int(np.nanargmax(np.abs(in_std))), in_std.shape)
    row = result.rows[int(j)]
    size = float(shown(result.parameters[row.name], change[j, k]))
    by, stds = f"{signed(size)}{unit_behind(row.unit)}", fixed(abs(in_std[j, k]), 1)
    words = Markup("Without the reading at {} {} would change most: by {}, {} posterior standard deviations.").format(
        _time(result, int(k)), symbol_html(row.symbol), by, stds
    )
    blank = int(np.sum(how == UNKNOWN))
    return words + (f" For {blank} of {in_std.shape[1]} readings only a fit without them shows this." if blank else "")


def _farthest(result: StoredResult) -> Markup:
    distance = result.of_readings("sample_stats", "prior_distance")
    if not np.isfinite(distance).any():
        return Markup("")
    k, beyond = int(np.nanargmax(np.abs(distance))), int(np.sum(np.abs(distance) > FAR))
    count = f"{beyond} of {len(distance)} readings lie" if beyond else "No reading lies"
    return Markup("{} more than {} standard deviations from what the prior predicts; the farthest, at {}, {}.").format(
        count, plain_number(FAR), _time(result, k), signed(float(distance[k]))
    )


def _time(result: StoredResult, k: int) -> str:
    """When a reading was taken on the clock of the data, of several series of which, of a field where."""
    observed = result.group("observed_data")
    for axis in result.axes:
        time = observed[axis.time]
        if k < len(time.values):
            break
        k -= len(time.values)
    when = float(shown(time, time.values[k] + zero_of(time)))
    words = f"{plain_number(when, 6)}{unit_behind(time.attrs['display_units'])} {CLOCK}"
    if f"{axis.name}_place" in observed:
        place = observed[f"{axis.name}_place"]
        words += f", place {plain_number(float(place.values[k]))}{unit_behind(str(place.attrs['units']))}"
    return words if axis.alone else f"{words} ({axis.name})"
