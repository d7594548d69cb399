"""Tables with a row a bubble, R_max, R_max/R_eq and collapse time: one gel is estimated from the times of all.

The collapse time of one bubble tells G or μ, never both; those of bubbles of several sizes do. What is known of each
bubble enters with an error of its own. Density, pressure and the size of a pixel err alike for all of them, so that no
number of bubbles averages their errors out: they are estimated with the gel. Times go with radii, so that the scale of
the readings, which are times, stands for that of the camera.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.inputs.parts import ANY
from en4dvar.model.state import Array
from en4dvar.plumbing.tables import csv_text
from en4dvar_bubble.collapse import RAYLEIGH
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.starter.config import Source
from en4dvar_bubble.starter.elsewhere import Entry, known
from en4dvar_bubble.starter.physics import WHY
from en4dvar_bubble.starter.proposal import Proposal, built, example

RADII = (1e-6, 0.1)  # m
STRETCHES = (1.5, 50.0)  # R_max/R_eq
RATIOS = (0.3, 3.0)  # of the collapse time to Rayleigh's
COLUMNS = ("bubble", "R_max_um", "R_eq_um", "collapse_us")
TIME_STD, RADIUS_STD = "20 ns", 0.005
SHARED = ", shared: all"


@dataclass(frozen=True)
class Summaries:
    """A row a bubble, SI: ``R_max`` (n,), ``stretch`` R_max/R_eq (n,), ``t_c`` (n,); ``names`` of the columns."""

    names: tuple[str, ...]
    R_max: Array
    stretch: Array
    t_c: Array

    @property
    def table(self) -> str:
        """The rows as CSV, in the units that the names of :data:`COLUMNS` say."""
        values = np.column_stack([1e6 * self.R_max, 1e6 * self.R_max / self.stretch, 1e6 * self.t_c])
        digits = len(str(len(values)))
        rows = [(f"{i:0{digits}d}", *(f"{value:.9g}" for value in row)) for i, row in enumerate(values.tolist(), 1)]
        return csv_text([COLUMNS, *rows])


def summaries(columns: Mapping[str, Array]) -> Summaries | None:
    """Three neighbouring columns whose numbers leave no doubt about what they are; None where there are none."""
    names = list(columns)
    for trio in zip(names, names[1:], names[2:], strict=False):
        radius, stretch, time = (columns[name] for name in trio)
        if not len(radius) == len(stretch) == len(time) > 1:
            continue
        medium = Medium()
        with np.errstate(all="ignore"):
            ratio = time / (RAYLEIGH * radius * np.sqrt(medium.rho / medium.p_inf))
        spans = zip((radius, stretch, ratio), (RADII, STRETCHES, RATIOS), strict=True)
        if all(np.all((values > low) & (values < high)) for values, (low, high) in spans):
            return Summaries(trio, radius, stretch, time)
    return None


def source_of(table: str) -> Source:
    """How the table is read: each row is a data set of one reading."""
    time = (COLUMNS[3], "us")
    return Source(table, time, None, time, replace(ANY, by=COLUMNS[0]), observable="collapse_time")


def propose_from_times(rows: Summaries, law: str | None, medium: str) -> Proposal:
    """A gel, with the constants of ``medium``, common to all bubbles, and each bubble's own radii. Raises
    :class:`ConfigError`: unknown law.
    """
    model, law_name = built("laser", law)
    told = f"{', '.join(rows.names)} are {len(rows.t_c)} rows of R_max, R_max/R_eq and collapse time in SI units"
    lines = [example(p, model) for p in model.law.parameters]
    of_gel = [replace(line, value=f"{line.value[:-1]}{SHARED}}}") for line in lines]
    radii = [
        Entry(name, f"{{prior: lognormal, median: {{from_file: {column}, unit: um}}, log_std: {RADIUS_STD}}}", words)
        for name, column, words in (
            ("R_max", COLUMNS[1], "each bubble's own, read to 0.5 %: enter what you know of your camera"),
            ("R_eq", COLUMNS[2], "the same"),
        )
    ]
    return Proposal(
        (Entry("error", f"{{collapse_time_std: {TIME_STD}}}", "how well a time is known: enter what you know"),),
        (
            Entry("name", "bubble"),
            Entry("law", law_name, "others: en4dvar laws"),
            Entry("start", "laser", "the clock starts at R_max"),
            *(Entry(key, value, WHY[value]) for key, value in {"gas": "heat", "vapour": "transport"}.items()),
        ),
        (*of_gel, *radii, *(it.prior(SHARED) for it in known(medium))),
        {},
        (f"{told}, one a bubble; the gel is common to all",),
        assimilation=(
            Entry("members", "200", "cheap here; 5 and 95 % are known to 0.15 std, of 48 members to 0.3"),
            Entry("refine", "none", "a bubble by itself tells little and only begins the estimate of all together"),
            Entry("emulator", '"off"'),
            Entry("what_if", "false"),
        ),
    )
