"""Times that are out of order, or occur twice: where, and what is to be done, which depends on what the rows are.

Rows of one series that are shuffled are sorted. Several series one after another are not: sorted they would be one that
nobody saw. Their times fall back with several increasing readings before and behind, or a column tells them apart.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.inputs.asked import Layout, opened
from en4dvar.inputs.outliers import OUTLYING, scatter_of
from en4dvar.inputs.parts import cell, table_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError

SEVERAL = 4  # readings: a series has as many, and two of them as many each while both go on


@dataclass(frozen=True)
class InFile:
    """The rows ``kept`` (K,) of a file, its ``lines`` if it has them, their times as ``written`` (K,) in ``unit``, and
    the columns ``wanted``."""

    path: Path
    layout: Layout
    kept: npt.NDArray[np.intp]
    lines: Sequence[int]
    written: Array
    unit: str
    wanted: Sequence[str]

    def require_order(self, times: Array, values: Array) -> None:
        """Raise :class:`DataError` where ``times`` (K,) of ``values`` (K,) are not in order, or one occurs again and
        may not."""
        order = np.argsort(times, kind="stable") if self.layout.unsorted == "sort" else np.arange(len(times))
        steps = np.diff(times[order])
        wrong = np.flatnonzero(steps < 0 if self.layout.repeated == "average" else steps <= 0)
        if not len(wrong):
            return
        before, after = order[wrong[0] : wrong[0] + 2]
        apart = (
            "give each a file of its own"
            + bool(self.lines) * ", or a column that says whose each row is, and name it by data.by"
        )
        ends = np.flatnonzero(np.diff(times) < 0)
        if column := self._telling_apart(times):
            name = column if column.isidentifier() else repr(column)
            hint = f"column {column!r} says which of several series a row belongs to (data.by: {name})"
        elif _several(times, ends):
            before, after = ends[0], ends[0] + 1
            hint = f"these look like {len(ends) + 1} series one after another: {apart}"
        elif times[after] != times[before]:
            hint = "correct it, or sort the rows (data.unsorted: sort)"
        elif _differ(times, values):
            hint = f"readings of one time differ by far more than they scatter: keep one; of several series, {apart}"
        else:
            hint = "keep one of the two readings, or their mean (data.repeated: average)"
        unit = "" if "*" in self.unit else f" {self.unit}"
        where = f":{self.lines[self.kept[after]]}" if self.lines else f": sample {self.kept[after] + 1}"
        told = f"times must increase, but {self.written[after]:g}{unit} follows {self.written[before]:g}{unit}"
        raise DataError(f"{self.path}{where}: {told}; {hint}")

    def _telling_apart(self, times: Array) -> str | None:
        """The column of a table that tells several series apart, each with increasing ``times`` (K,)."""
        if self.layout.by is not None or not self.lines:
            return None
        with opened(self.path, self.layout) as kind:
            table = table_of(self.path, kind, self.layout, self.wanted)
        for i, name in enumerate(table.names):
            cells = np.array([cell(table.rows[k][1], i) for k in self.kept])
            each, which, counts = np.unique(cells, return_inverse=True, return_counts=True)
            if name and "" not in each and len(each) > 1 and counts.min() >= SEVERAL:
                sort = self.layout.unsorted == "sort"
                rows = np.lexsort((times, which)) if sort else np.argsort(which, kind="stable")
                increase = np.all((np.diff(times[rows]) > 0) | (np.diff(which[rows]) > 0))
                stacked = np.count_nonzero(np.diff(which)) < len(each)
                beside = np.count_nonzero(np.diff(which[np.lexsort((which, times))])) - len(each) >= SEVERAL
                if increase and beside and (stacked or len(times) - len(np.unique(times)) >= SEVERAL):
                    return name
        return None


def _several(times: Array, ends: npt.NDArray[np.intp]) -> bool:
    """Whether ``times`` (K,), which fall back behind the ``ends``, are those of several series."""
    pairs = itertools.pairwise(np.split(times, ends + 1))
    both = [min(np.sum((c >= max(a[0], b[0])) & (c <= min(a[-1], b[-1]))) for c in (a, b)) for a, b in pairs]
    return bool(both) and min(both) >= SEVERAL


def _differ(times: Array, values: Array) -> bool:
    """Whether readings of one time differ by more than their errors can explain."""
    _, first, which = np.unique(times, return_index=True, return_inverse=True)
    apart = np.delete(np.abs(values - values[first][which]), first)
    return bool(np.median(apart) > OUTLYING * scatter_of(times[first], values[first]))
