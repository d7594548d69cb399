"""The decimal sign of a column of text: ``1,201`` is 1201 beside ``998.2``, and 1.201 beside ``0,5``.

Most numbers tell their decimal sign by their form: ``998.2``, ``1,600.5`` and ``1,003,200`` have or allow a point only.
Those of a column speak for it, else those of the whole table. Where none does, numbers without a sign may: about
``998``, ``999``, ``1,000`` only commas between thousands let the numbers follow each other evenly.
"""

import math
import re
from collections.abc import Sequence
from itertools import islice
from typing import Literal

import numpy as np

from en4dvar.plumbing.tables import is_number

Decimal = Literal[".", ","]
OTHER: dict[str, Decimal] = {".": ",", ",": "."}
_OPEN = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")
_GROUPED: dict[str, re.Pattern[str]] = {
    ".": re.compile(r"[-+]?[1-9]\d{0,2}(\.\d{3})+(,\d+)?"), ",": re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+(\.\d+)?")
}  # fmt: skip
UNEVEN = math.log(1000) / 2  # of the sum of all steps of ln: one wrong reading among right ones is a step of ln 1000
SEVERAL = 2  # numbers without a sign: a single one, again and again, may stand for missing readings


def is_open(cell: str) -> bool:
    """Whether a number has one sign, which may as well be the decimal sign as separate thousands."""
    return _OPEN.fullmatch(cell) is not None


def decimal_by(cell: str) -> Decimal | None:
    """The decimal sign that a number tells by its form."""
    if is_open(cell):
        return None
    for sign, grouped in _GROUPED.items():
        if grouped.fullmatch(cell):
            return OTHER[sign]
    signs = [sign for sign in OTHER.values() if sign in cell]
    return signs[0] if len(signs) == 1 and is_number(cell.replace(",", ".")) else None


def signs_of(cells: Sequence[str]) -> set[Decimal]:
    """The decimal signs that the numbers of a column tell: none, one, or both where they contradict each other."""
    told = (sign for cell in cells if (sign := decimal_by(cell)))
    return ({*told} if has_comma(cells) else {*islice(told, 1)}) or _evenly(cells)


def has_comma(cells: Sequence[str]) -> bool:
    """Whether a number has a comma; where none has, the first that tells the decimal sign tells that of all."""
    return any("," in cell for cell in cells)


def _evenly(cells: Sequence[str]) -> set[Decimal]:
    """The decimal sign by which numbers follow each other evenly; none where both do, or neither."""
    numbers = [cell for cell in cells if is_open(cell) or (cell.isdecimal() and int(cell))]
    signs = [sign for sign in OTHER.values() if any(sign in cell for cell in numbers)]
    if len(signs) != 1 or len({cell for cell in numbers if cell.isdecimal()}) < SEVERAL:
        return set()
    readings = [[abs(float(cell.replace(signs[0], by))) for cell in numbers] for by in ("", ".")]
    apart, decimal = (float(np.abs(np.diff(np.log(it))).sum()) for it in readings)
    return set() if abs(apart - decimal) < UNEVEN else {OTHER[signs[0]] if apart < decimal else signs[0]}


def without_thousands(cell: str, decimal: Decimal | None) -> str:
    """A number without what separates its thousands, where the decimal sign is known."""
    sign = OTHER[decimal] if decimal else ""
    return cell.replace(sign, "") if sign and _GROUPED[sign].fullmatch(cell) else cell
