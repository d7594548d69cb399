"""Is the posterior calibrated? What the ranks of many truths among posterior members say: table, figure, page; and
``calibration.csv``, what came of each synthetic data set, a line a quantity.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binomtest

from en4dvar.diagnosis.ranks import BAND, Uniform, uniform_ranks
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import read_text
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.report.chart import PAGE, POINTS, Chart, Panel, in_columns
from en4dvar.report.html import write_page
from en4dvar.report.paper import on_paper
from en4dvar.report.text import figure_text, plain_number
from en4dvar.results.declared import Names

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

FIT, ERRORS = "fit", "errors"  # J_o, half the sum of squares of the readings: at the truth, among that at members, and
# among that of other readings drawn at the truth
LEVELS = (0.05, 0.25, 0.75, 0.95)
LONGEST = 1_000_000_000  # bytes of the table
NUMBERS = ("truth", "q05", "q25", "q75", "q95", "z", "rank")
COLUMNS = ("set", "data_set", "quantity", "unit", *NUMBERS, "members", "cautions", "failure", "symbol")


@dataclass(frozen=True)
class Judged:
    """What came of one set: of Q quantities, the parameters and the fit of the readings, ``numbers`` (Q, 7).

    A row holds :data:`NUMBERS`: truth and quantiles of :data:`LEVELS` in display units; the distance z of the truth
    from the mean in standard deviations, in the prior's own transform; its rank among the ``members``. All are
    NaN where there is no truth. ``cautions``: codes of the serious ones. ``failure``: why there is no posterior.
    """

    number: int
    data_set: str
    numbers: Array = field(default_factory=lambda: np.empty((0, len(NUMBERS))))
    members: int = 0
    cautions: tuple[str, ...] = ()
    failure: str = ""


def write_sets(path: Path, quantities: Sequence[tuple[str, str, str]], sets: Sequence[Judged]) -> Path:
    """Write the table of quantities (name, unit, symbol). Raises :class:`OutputError`."""
    lines: list[Sequence[object]] = [COLUMNS]
    for judged in sets:
        head, tail = (judged.number, judged.data_set), (judged.members, " ".join(judged.cautions), "")
        if judged.failure:
            lines.append([*head, *[""] * (len(COLUMNS) - 4), judged.failure, ""])
        of_each = zip(quantities, judged.numbers.tolist(), strict=not judged.failure)
        lines += [[*head, name, unit, *numbers, *tail, symbol] for (name, unit, symbol), numbers in of_each]
    return write_csv(path, lines)


def read_sets(path: Path) -> tuple[tuple[tuple[str, str], ...], tuple[Judged, ...], Names]:
    """The quantities (name, unit), the sets of a table, and how names are written. Raises :class:`OutputError` where it
    is none.
    """
    try:
        by_set: dict[int, list[dict[str, str]]] = {}
        for line in csv.DictReader(io.StringIO(read_text(path, LONGEST))):
            by_set.setdefault(int(line["set"]), []).append(line)
        sets = tuple(_set(number, lines) for number, lines in by_set.items())
        known = next((lines for lines in by_set.values() if not lines[0]["failure"]), [])
        quantities = tuple((line["quantity"], line["unit"]) for line in known)
        written = Names((line["quantity"], symbol) for line in known if (symbol := line.get("symbol")))
        if not sets or any(not s.failure and len(s.numbers) != len(quantities) for s in sets):
            raise ValueError
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise OutputError(f"{path}: not a table of 'en4dvar calibrate', or damaged; conduct it again") from None
    return quantities, sets, written


def _set(number: int, lines: Sequence[dict[str, str]]) -> Judged:
    first = lines[0]
    if first["failure"]:
        return Judged(number, first["data_set"], failure=first["failure"])
    numbers = np.array([[float(line[name]) for name in NUMBERS] for line in lines])
    return Judged(number, first["data_set"], numbers, int(first["members"]), tuple(first["cautions"].split()))


LEVEL = 0.01  # of the tests of all quantities together, by Holm's rule
APART = 0.2  # mean of z by which what is off is told
CURVES = (
    "Share of the sets whose truth has a lower rank among the members, less that of uniform ranks. A calibrated "
    f"posterior stays within the band, {100 * BAND:.0f} of 100 times throughout. A curve that is first below, then "
    "above: its intervals are too wide; first above, then below: too narrow; above: its values are too high; below: "
    "too low."
)
HEAD = ("quantity", "sets", "p of uniform ranks", "mean of z", "std of z", "50 % intervals hold", "90 % intervals hold")


@dataclass(frozen=True)
class Verdict:
    """What the sets say of one quantity: the chance ``p`` of ranks as far from uniform, mean and standard deviation of
    z, and how many of the ``sets`` the central 50 and 90 % intervals hold.
    """

    quantity: str
    unit: str
    sets: int
    p: float
    mean: float
    std: float
    half: int
    most: int
    off: bool
    """Whether that is too far from uniform, of all quantities together."""

    @property
    def words(self) -> str:
        """What is wrong, in a sentence; "" where nothing is seen."""
        if not self.off:
            return ""
        if self.quantity == ERRORS:
            larger = "larger than data.error says, or the model is wrong"
            size = larger if self.mean > 0 else "smaller than data.error says"
            return f"the errors of the readings are {size} (ranks of the errors)"
        if self.quantity == FIT:
            side = "better" if self.mean > 0 else "worse"
            return f"{FIT}: members fit the readings {side}, beside the truth, than those of a right posterior do"
        too = [f"values are too {'low' if self.mean > 0 else 'high'}"] if abs(self.mean) > APART else []
        shares = [(_share(self.half, self.sets), 0.5), (_share(self.most, self.sets), 0.9)]
        if any(high < stated for (_, high), stated in shares):
            too.append("intervals hold the truth too rarely")
        elif any(low > stated for (low, _), stated in shares):
            too.append("intervals hold the truth too often")
        return f"{self.quantity}: {' and '.join(too) or 'the shape of the posterior is off'}"


@dataclass(frozen=True)
class Calibration:
    """``sets`` of synthetic readings, estimated, whose truths are known; ``quantities`` are (name, unit)."""

    name: str
    quantities: tuple[tuple[str, str], ...]
    sets: tuple[Judged, ...]
    directory: Path
    written: Names = field(default_factory=Names)
    """How a page writes a quantity."""

    @property
    def good(self) -> list[Judged]:
        """Those with a posterior."""
        return [judged for judged in self.sets if not judged.failure]

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """One a quantity that has a truth."""
        known = [j for j in range(len(self.quantities)) if len(self.ranks(j))]
        p = {j: self.uniform(j).p_value(self.ranks(j)) for j in known}
        off: set[int] = set()
        for left, j in zip(range(len(known), 0, -1), sorted(known, key=p.__getitem__), strict=True):
            if p[j] * left > LEVEL:
                break
            off.add(j)
        return tuple(self._verdict(j, p[j], j in off) for j in known)

    @property
    def remarks(self) -> list[str]:
        """What is to be known beside the table: what is off, what failed, what was doubted."""
        told = [verdict.words for verdict in self.verdicts if verdict.off]
        if self.good and not told:
            told = [f"{len(self.good)} sets show no sign that the posterior is not calibrated"]
        for reason in dict.fromkeys(judged.failure for judged in self.sets if judged.failure):
            count = sum(judged.failure == reason for judged in self.sets)
            told.append(f"{count} of {len(self.sets)} sets have no posterior: {reason}")
        told_of = {verdict.quantity for verdict in self.verdicts}
        if self.good and (absent := [name for name, _ in self.quantities if name not in told_of]):
            told.append(f"no ranks of {', '.join(absent)}: what made the readings has no such value")
        counts = Counter(code for judged in self.good for code in judged.cautions)
        of = f"of {len(self.good)} sets have the serious warning"
        return told + [f"{count} {of} '{code}'" for code, count in counts.items()]

    def column(self, what: str, j: int) -> np.ndarray:
        """``truth``, ``z`` or another of the numbers (S,) of a quantity over the good sets."""
        return np.array([judged.numbers[j, NUMBERS.index(what)] for judged in self.good])

    def ranks(self, j: int) -> Array:
        """Of the truths of a quantity, over the good sets that have one."""
        return np.array([rank for rank in self.column("rank", j) if np.isfinite(rank)])

    def rows(self) -> list[tuple[str, ...]]:
        """The table, without its head."""
        return [
            (v.quantity, str(v.sets), f"{v.p:.2g}", f"{v.mean:+z.2f}", f"{v.std:.2f}".replace("nan", "–"),
             _held(v.half, v.sets), _held(v.most, v.sets)) for v in self.verdicts
        ]  # fmt: skip

    def summary(self) -> pd.DataFrame:
        """A row a quantity."""
        from en4dvar.plumbing.whole_table import WholeTable

        return WholeTable([vars(verdict) for verdict in self.verdicts])

    def plot(self) -> Figure:
        """The distribution of the ranks of each quantity, less that of uniform ones."""
        return on_paper(curves(self))

    def __str__(self) -> str:
        return table([HEAD, *self.rows()])

    def __repr__(self) -> str:
        return f"<Calibration of {self.name}: {len(self.good)} of {len(self.sets)} sets, in {self.directory}>"

    def uniform(self, j: int) -> Uniform:
        """What the ranks of a quantity of a calibrated posterior look like; there must be some."""
        return uniform_ranks(len(self.ranks(j)), self.good[0].members)

    def _verdict(self, j: int, p: float, off: bool) -> Verdict:
        numbers = np.array([judged.numbers[j] for judged in self.good])
        truth, low, lower, upper, high, z, _ = numbers[np.isfinite(numbers[:, -1])].T
        half, most = int(np.sum((lower <= truth) & (truth <= upper))), int(np.sum((low <= truth) & (truth <= high)))
        std = float(z.std(ddof=1)) if len(z) > 1 and np.isfinite(z).all() else float("nan")
        return Verdict(*self.quantities[j], len(z), p, float(z.mean()), std, half, most, off)


def _share(count: int, sets: int) -> tuple[float, float]:
    """The 95 % interval of a share."""
    interval = binomtest(count, sets).proportion_ci(0.95, "wilson")
    return interval.low, interval.high


def _held(count: int, sets: int) -> str:
    low, high = _share(count, sets)
    return f"{100 * count / sets:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def curves(calibration: Calibration) -> Chart:
    """The distribution of the ranks of each quantity, less that of uniform ones, and the band of these."""
    panels, names = [], [name for name, _ in calibration.quantities]
    for verdict in calibration.verdicts:
        uniform = calibration.uniform(j := names.index(verdict.quantity))
        x, (low, high) = uniform.shares, uniform.band
        name = calibration.written.get(verdict.quantity) or figure_text(verdict.quantity)
        title = f"{name}: p = {plain_number(verdict.p, 2)}"
        panel = Panel("rank of the truth, 0 to 1", "difference of shares", title=title, xlim=(0.0, 1.0))
        panel.band(x, low - x, high - x, "prior", 0.25)
        panel.rule(0.0)
        panel.line(x, uniform.distribution(calibration.ranks(j)) - x, "centre" if verdict.off else "posterior")
        panels.append(panel)
    return in_columns(panels, 4.4 * POINTS, 3, PAGE)


def write_calibration(folder: Path) -> Path:
    """Write ``calibration.html`` from ``calibration.csv``. Raises :class:`OutputError`."""
    calibration = load_calibration(folder)
    figures = [("ranks", CURVES, curves(calibration))] if calibration.verdicts else []
    quantities = tuple((calibration.written[name], unit) for name, unit in calibration.quantities)
    written = replace(calibration, quantities=quantities)
    about = {"calibration": written, "head": HEAD, "level": LEVEL, "configuration": _configuration(folder)}
    return write_page(folder, "calibration", figures, **about)


def load_calibration(folder: Path) -> Calibration:
    """What ``calibration.csv`` of a folder says. Raises :class:`OutputError`."""
    quantities, sets, written = read_sets(folder / "calibration.csv")
    named = re.search(r"^name: *(.+)$", _configuration(folder), re.MULTILINE)
    return Calibration(named[1] if named else folder.resolve().name, quantities, sets, folder, written)


def _configuration(folder: Path) -> str:
    try:
        return read_text(folder / "config.resolved.yaml")
    except OSError:
        return ""
