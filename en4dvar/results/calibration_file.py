"""``calibration.csv``: what came of each synthetic data set of a calibration, a line a quantity."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
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
NUMBERS = ("truth", "q05", "q25", "q75", "q95", "z")
COLUMNS = ("set", "data_set", "quantity", "unit", *NUMBERS, "rank", "members", "cautions", "failure")


@dataclass(frozen=True)
class Judged:
    """What came of one set, of Q quantities: the parameters, and the fit of the readings.

    ``truth`` (Q,) and ``quantiles`` (4, Q) of :data:`LEVELS` in display units; ``z`` (Q,) distance of the truth from
    the mean in standard deviations, in the prior's own transform; ``rank`` (Q,) of the truth among the ``members``, all
    NaN where there is no truth. ``cautions``: codes of the serious ones. ``failure``: why there is no posterior.
    """

    number: int
    data_set: str
    truth: Array
    quantiles: Array
    z: Array
    rank: Array
    members: int
    cautions: tuple[str, ...] = ()
    failure: str = ""

    @classmethod
    def failed(cls, number: int, data_set: str, failure: str) -> "Judged":
        """One without a posterior."""
        nothing = np.empty(0)
        return cls(number, data_set, nothing, np.empty((4, 0)), nothing, nothing, 0, failure=failure)


def write_sets(path: Path, quantities: Sequence[tuple[str, str]], sets: Sequence[Judged]) -> Path:
    """Write the table of quantities (name, unit). Raises :class:`OutputError`."""
    lines: list[Sequence[object]] = [COLUMNS]
    for judged in sets:
        if judged.failure:
            lines.append([judged.number, judged.data_set, "", "", *[""] * len(NUMBERS), "", "", "", judged.failure])
            continue
        for j, (name, unit) in enumerate(quantities):
            numbers = (judged.truth[j], *judged.quantiles[:, j], judged.z[j], judged.rank[j])
            codes = " ".join(judged.cautions)
            lines.append([judged.number, judged.data_set, name, unit, *numbers, judged.members, codes, ""])
    return write_csv(path, lines)


def read_sets(path: Path) -> tuple[tuple[tuple[str, str], ...], tuple[Judged, ...]]:
    """The quantities (name, unit) and the sets of a table. Raises :class:`OutputError` where it is none."""
    try:
        text = read_text(path, LONGEST)
        by_set: dict[int, list[dict[str, str]]] = {}
        for line in csv.DictReader(io.StringIO(text)):
            by_set.setdefault(int(line["set"]), []).append(line)
        sets = tuple(_set(number, lines) for number, lines in by_set.items())
        known = next((lines for lines in by_set.values() if not lines[0]["failure"]), [])
        quantities = tuple((line["quantity"], line["unit"]) for line in known)
        if not sets or any(not s.failure and len(s.truth) != len(quantities) for s in sets):
            raise ValueError
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        raise OutputError(f"{path}: not a table of 'en4dvar calibrate', or damaged; conduct it again") from None
    return quantities, sets


def _set(number: int, lines: Sequence[dict[str, str]]) -> Judged:
    first = lines[0]
    if first["failure"]:
        return Judged.failed(number, first["data_set"], first["failure"])
    truth, *quantiles, z = (np.array([float(line[name]) for line in lines]) for name in NUMBERS)
    rank, codes = np.array([float(line["rank"]) for line in lines]), tuple(first["cautions"].split())
    return Judged(number, first["data_set"], truth, np.array(quantiles), z, rank, int(first["members"]), codes)
