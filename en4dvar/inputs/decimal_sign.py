"""The decimal sign of a column of text: ``1,201`` is 1201 beside ``998.2``, and 1.201 beside ``0,5``.

Most numbers tell their decimal sign by their form: ``998.2``, ``1,600.5`` and ``1,003,200`` have or allow a point only.
Those of a column speak for it, else those of the whole table. Where none of the column does, numbers without a sign
may: after ``998`` and ``999``, ``1,000`` follows evenly only as 1000. Blanks and apostrophes, as in ``2'000``, can be
nothing else than signs between thousands.
"""

import math
import re
from collections.abc import Sequence
from typing import Literal

import numpy as np

from en4dvar.plumbing.tables import is_number

Decimal = Literal[".", ","]
OTHER: dict[str, Decimal] = {".": ",", ",": "."}
_OPEN = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")
_GROUPED: dict[str, re.Pattern[str]] = {
    ".": re.compile(r"[-+]?[1-9]\d{0,2}(\.\d{3})+(,\d+)?"), ",": re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+(\.\d+)?")
}  # fmt: skip
_SET_APART = re.compile(r"[-+]?[1-9]\d{0,2}(['’´` \u00a0\u2009\u202f])\d{3}(\1\d{3})*([.,]\d+)?")
_FORTRAN = re.compile(r"^([-+]?(?:\d+[.,]\d*|[.,]\d+))[dD]([-+]?\d{1,3})$")  # double precision, with a decimal sign
UNEVEN = math.log(1000) / 2  # of the sum of all steps of ln: one wrong reading among right ones is a step of ln 1000
AGAINST_FORM = 4  # as many times as uneven: then numbers contradict the form of others
SEVERAL = 2  # other numbers that are needed: a single one, again and again, may stand for missing readings


def closed_up(cell: str) -> str:
    """A number without the blanks or apostrophes between its thousands, its minus and exponent as Python writes them.

    >>> closed_up("2 000"), closed_up("1.5D-03"), closed_up("3D1")
    ('2000', '1.5e-03', '3D1')
    """
    cell = cell.replace("\u2212", "-")
    if "d" in cell or "D" in cell:  # cells are many
        cell = _FORTRAN.sub(r"\1e\2", cell)
    match = _SET_APART.fullmatch(cell)
    return cell.replace(match[1], "") if match else cell


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
    if (first := next(told, None)) == "." and not has_comma(cells):
        return {first}
    by_form = {*told, first} if first else set[Decimal]()
    return by_form | _evenly(cells, AGAINST_FORM if by_form else 1)


def has_comma(cells: Sequence[str]) -> bool:
    """Whether there is a comma in a column; without one nothing contradicts a decimal point."""
    return any("," in cell for cell in cells)


def _evenly(cells: Sequence[str], steps: int) -> set[Decimal]:
    """The decimal sign by which numbers follow each other evenly, by at least so many ``steps``, if any."""
    numbers = [cell for cell in cells if is_open(cell) or decimal_by(cell) or cell.isdecimal()]
    signs = [sign for sign in OTHER.values() if any(sign in cell for cell in numbers if is_open(cell))]
    if len(signs) != 1 or len({cell for cell in numbers if not is_open(cell) and float(_plain(cell))}) < SEVERAL:
        return set()
    own = [abs(float(_plain(cell))) for cell in numbers]
    thousands = [1000.0 if is_open(cell) else 1.0 for cell in numbers]
    readings = np.array([np.multiply(own, thousands), own])[:, np.array(own) > 0]
    apart, decimal = np.abs(np.diff(np.log(readings))).sum(axis=1)
    return set() if abs(apart - decimal) < steps * UNEVEN else {OTHER[signs[0]] if apart < decimal else signs[0]}


def _plain(cell: str) -> str:
    """A number as Python writes it, the sign of an open one as that of decimals."""
    return without_thousands(cell, decimal_by(cell)).replace(",", ".")


def without_thousands(cell: str, decimal: Decimal | None) -> str:
    """A number without what separates its thousands, where the decimal sign is known."""
    sign = OTHER[decimal] if decimal else ""
    return cell.replace(sign, "") if sign and _GROUPED[sign].fullmatch(cell) else cell
