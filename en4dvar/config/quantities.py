"""Quantities in the units of the model: numbers, spreads, and the units of numbers that stand elsewhere."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

from en4dvar.config.context import Context, Made, Unknown
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import brief, shown
from en4dvar.plumbing.units import UnitError, convert, parse_quantity, parse_unit, split_quantity

Unit = Callable[[Context], str]
Sign = Literal["positive", "not negative", "any"]
time_unit: Unit = attrgetter("units.time_unit")
observable_unit: Unit = attrgetter("observable.unit")
subject_unit: Unit = attrgetter("subject.unit")


def quantity(unit: Unit, sign: Sign, error: bool = False) -> Made:
    """A number in ``unit``, given with a unit of its own. Of an ``error`` it is no share, where nobody says of what."""

    def read(text: Any, context: Context) -> float:
        if error:
            require_no_share(str(text).strip(), unit(context))
        value = parse_quantity(text, unit(context))
        require_sign(value, sign, text)
        return value

    return Made(read)


def require_sign(value: float, sign: Sign, text: object) -> None:
    """Raises :class:`ConfigError` for a value of another sign."""
    if sign == "positive" and not value > 0:
        raise ConfigError(f"must be positive, not {brief(str(text), 80)}")
    if sign == "not negative" and value < 0:
        raise ConfigError(f"must not be negative, not {brief(str(text), 80)}")


@dataclass(frozen=True)
class Spread:
    """A standard deviation: ``value`` in a unit, or a share of something known later, of readings of a ``whole``."""

    value: float
    relative: bool = False
    unit: str = ""  # as it is written
    whole: str = "maximum"

    def absolute(self, whole: float) -> float:
        """The standard deviation in the unit of ``whole``."""
        return self.value * abs(whole) if self.relative else self.value


def parse_spread(text: Any, unit: str, usual: str = "") -> Spread:
    """``"0.1 kPa"``, or relative, ``"5 %"``; positive. Raises :class:`ConfigError`, :class:`UnitError`."""
    relative = str(text).strip().endswith("%") and unit != "%"
    spread = Spread(parse_quantity(text, "1" if relative else unit, usual), relative)
    require_sign(spread.value, "positive", text)
    return spread


SPREAD = Made(lambda text, context: parse_spread(text, subject_unit(context), context.subject.display_unit))
"""A :class:`Spread` of what the entry of a section is about."""


def unit_of(target: Unit) -> Made:
    """The text of a unit that can be converted to ``target``."""

    def fits(unit: str, context: Context) -> str:
        try:
            wanted = target(context)
        except Unknown:
            parse_unit(unit)  # is a unit, at least
            raise
        convert(1.0, unit, wanted)
        return unit

    return Made(fits, str)


def share_of(text: Any, *wholes: str, sign: Sign = "positive") -> Spread | None:
    """``"1 % of maximum"`` or of another of ``wholes``; None of what says no such thing. Raises :class:`UnitError`,
    :class:`ConfigError`: a share of another sign.
    """
    if not (said := re.fullmatch(r"(.*?)\s*\bof\s+(?:the\s+)?(.*)", str(text).strip())):
        return None
    if not said[1].endswith("%") or said[2] not in wholes:
        example = f"write a number in % of {' or '.join(wholes)}, as '5 % of {wholes[0]}'"
        raise UnitError(f"{shown(str(text))} is no share; {example}")
    value = parse_quantity(said[1], "1")
    require_sign(value, sign, text)
    return Spread(value, relative=True, whole=said[2])


def parse_error_std(text: Any, unit: str, whole: str = "maximum") -> Spread:
    """``"1.4 um"``, or ``"1 % of maximum"`` or of another ``whole``; positive. Raises :class:`ConfigError`,
    :class:`UnitError`.
    """
    if share := share_of(text, whole):
        return share
    word = str(text).strip()
    require_no_share(word, unit, f"'{word} of {whole}' or ")
    value = parse_quantity(text, unit)
    require_sign(value, "positive", text)
    return Spread(value, unit=split_quantity(word)[1])


def require_no_share(text: str, unit: str, rather: str = "") -> None:
    """Raises :class:`UnitError` for a number in % where ``unit`` is another, 1 as well: nobody says a share of what."""
    if text.endswith("%") and unit != "%":
        own = "a plain number" if unit == "1" else f"a quantity in {unit}"
        raise UnitError(f"{shown(text)} is a share, but does not say of what; write {rather}{own}")


def read_spread(text: Any, context: Context, unit: Unit = observable_unit, whole: str = "maximum") -> Spread:
    return parse_error_std(text, unit(context), whole)
