"""What a run at work has told in ``run.log``: where each data set stands, and parameters over the iterations."""

import re
from dataclasses import dataclass, field

import numpy as np

from en4dvar.report.chart import PAGE, POINTS, Chart, Panel, in_columns
from en4dvar.report.text import figure_text, with_unit

TOLD = re.compile(
    r"\S+ (.+?): (iteration +\d+|start, round +\d+|search for another minimum, round +\d+|chain, +\d+ steps"
    r"|continued .*|estimate: .*|failed: .*|converged|not converged)(?:  90 %: (.*))?"
)
BAND = re.compile(r"(\w+) (\S+) \((\S+) to (\S+)\) (.*?)(?=, \w+ \S+ \(|$)")


@dataclass
class Standing:
    """Of one data set: ``at``, how far it has got; ``estimate`` in a line, "" before its end; ``bands``: parameter with
    its unit → iteration → low, middle and high of the middle 90 %.
    """

    at: str = ""
    estimate: str = ""
    bands: dict[tuple[str, str], dict[int, tuple[float, float, float]]] = field(default_factory=dict)


def standings(log: str) -> dict[str, Standing]:
    """Name → where the data set stands, in the order in which the log names them; what is told twice counts once."""
    sets: dict[str, Standing] = {}
    for line in log.splitlines():
        if (parts := TOLD.match(line)) is None:
            continue
        name, words, intervals = parts.groups()
        standing = sets.setdefault(name, Standing())
        kind, _, rest = words.partition(": ")
        if kind == "estimate":
            standing.estimate = rest
        else:
            standing.at, standing.estimate = " ".join(kind.split()), rest or standing.estimate
        for parameter, middle, low, high, unit in BAND.findall(intervals or ""):
            step, band = int(words.split()[1]), standing.bands.get((parameter, unit), {})
            before = {k: told for k, told in band.items() if k < step}  # what follows is of a descent that was given up
            standing.bands[parameter, unit] = {**before, step: (float(low), float(middle), float(high))}
    return sets


def bands(standing: Standing, columns: int = 4) -> Chart | None:
    """Median and middle 90 % of each parameter over the iterations, up to four side by side; None before the first."""
    panels = []
    for (parameter, unit), band in standing.bands.items():
        steps = sorted(band)
        low, middle, high = np.array([band[step] for step in steps]).T
        panel = Panel("iteration", title=with_unit(figure_text(parameter), unit), whole=True, xticks=4, yticks=4)
        panel.band(steps, low, high, "posterior", 0.3)
        panel.line(steps, middle, "posterior")
        panel.dots(steps, middle, "posterior")
        panels.append(panel)
    return in_columns(panels, 3.2 * POINTS, columns, columns / 4 * PAGE) if panels else None
