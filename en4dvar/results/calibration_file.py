"""``calibration.csv``: what came of each synthetic data set of a calibration, a line a quantity."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import read_text
from en4dvar.plumbing.tables import write_csv

FIT, ERRORS = "fit", "errors"  # J_o, half the sum of squares of the readings: at the truth, among that at members, and
# among that of readings which are drawn at each member
LEVELS = (0.05, 0.25, 0.75, 0.95)
LONGEST = 1_000_000_000  # bytes of the table
NUMBERS = ("truth", "q05", "q25", "q75", "q95", "z", "rank")
COLUMNS = ("set", "data_set", "quantity", "unit", *NUMBERS, "members", "cautions", "failure")


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


def write_sets(path: Path, quantities: Sequence[tuple[str, str]], sets: Sequence[Judged]) -> Path:
    """Write the table of quantities (name, unit). Raises :class:`OutputError`."""
    lines: list[Sequence[object]] = [COLUMNS]
    for judged in sets:
        head, tail = (judged.number, judged.data_set), (judged.members, " ".join(judged.cautions), "")
        if judged.failure:
            lines.append([*head, *[""] * (len(COLUMNS) - 3), judged.failure])
        of_each = zip(quantities, judged.numbers.tolist(), strict=not judged.failure)
        lines += [[*head, *quantity, *numbers, *tail] for quantity, numbers in of_each]
    return write_csv(path, lines)


def read_sets(path: Path) -> tuple[tuple[tuple[str, str], ...], tuple[Judged, ...]]:
    """The quantities (name, unit) and the sets of a table. Raises :class:`OutputError` where it is none."""
    try:
        by_set: dict[int, list[dict[str, str]]] = {}
        for line in csv.DictReader(io.StringIO(read_text(path, LONGEST))):
            by_set.setdefault(int(line["set"]), []).append(line)
        sets = tuple(_set(number, lines) for number, lines in by_set.items())
        known = next((lines for lines in by_set.values() if not lines[0]["failure"]), [])
        quantities = tuple((line["quantity"], line["unit"]) for line in known)
        if not sets or any(not s.failure and len(s.numbers) != len(quantities) for s in sets):
            raise ValueError
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise OutputError(f"{path}: not a table of 'en4dvar calibrate', or damaged; conduct it again") from None
    return quantities, sets


def _set(number: int, lines: Sequence[dict[str, str]]) -> Judged:
    first = lines[0]
    if first["failure"]:
        return Judged(number, first["data_set"], failure=first["failure"])
    numbers = np.array([[float(line[name]) for name in NUMBERS] for line in lines])
    return Judged(number, first["data_set"], numbers, int(first["members"]), tuple(first["cautions"].split()))
