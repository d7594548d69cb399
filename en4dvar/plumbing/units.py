"""Units: the few dozen symbols that data files and settings need, SI prefixes, products, quotients and powers.

A unit is a factor to SI and a vector of exponents of the base dimensions. Factors are exact rationals: ``"1.4 um"`` is
the same double as ``1.4e-6``. A power may be a decimal, as in ``"Pa s^0.6"`` of a consistency index. Temperatures in °C
are not units of this kind (they have an offset) and are refused.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, overload

from annotated_types import GroupedMetadata

from en4dvar.plumbing.errors import En4dvarError, retold
from en4dvar.plumbing.hints import shown

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[np.float64]

BASE = ("m", "kg", "s", "K", "A", "mol")


class UnitError(En4dvarError, ValueError):
    """A unit is missing, unknown, or of the wrong dimension. A ``ValueError`` too, so that pydantic collects it."""

    exit_code = 2


@dataclass(frozen=True)
class Unit:
    """``factor`` converts to SI; ``powers`` are the exponents of m, kg, s, K, A, mol."""

    factor: Fraction
    powers: tuple[int | Fraction, ...]

    def __mul__(self, other: "Unit") -> "Unit":
        return Unit(self.factor * other.factor, tuple(a + b for a, b in zip(self.powers, other.powers, strict=True)))

    def __pow__(self, exponent: int | Fraction) -> "Unit":
        return Unit(Fraction(self.factor**exponent), tuple(p * exponent for p in self.powers))


ONE = Unit(Fraction(1), (0,) * len(BASE))


def _unit(factor: str, **powers: int) -> Unit:
    return Unit(Fraction(factor), tuple(powers.get(b, 0) for b in BASE))


PREFIXED = {name: _unit("1", **{name: 1}) for name in BASE if name != "kg"} | {
    "g": _unit("1e-3", kg=1),
    "Hz": _unit("1", s=-1),
    "fps": _unit("1", s=-1),
    "N": _unit("1", m=1, kg=1, s=-2),
    "Pa": _unit("1", m=-1, kg=1, s=-2),
    "J": _unit("1", m=2, kg=1, s=-2),
    "W": _unit("1", m=2, kg=1, s=-3),
    "V": _unit("1", m=2, kg=1, s=-3, A=-1),
    "bar": _unit("1e5", m=-1, kg=1, s=-2),
    "L": _unit("1e-3", m=3),
    "P": _unit("0.1", m=-1, kg=1, s=-1),  # poise, so that cP is read
}
UNPREFIXED = {
    "1": ONE,
    "%": _unit("1e-2"),
    "ppm": _unit("1e-6"),
    "rad": ONE,
    "min": _unit("60", s=1),
    "h": _unit("3600", s=1),
    **dict.fromkeys(("d", "day"), _unit("86400", s=1)),
    "week": _unit("604800", s=1),
    **dict.fromkeys(("yr", "year"), _unit("31557600", s=1)),  # Julian, 365.25 d
    "atm": _unit("101325", m=-1, kg=1, s=-2),
    "psi": _unit("6894.757293168361", m=-1, kg=1, s=-2),
}
PREFIXES = {"T": 12, "G": 9, "M": 6, "k": 3, "h": 2, "d": -1, "c": -2, "m": -3, "u": -6, "n": -9, "p": -12, "f": -15}

LARGEST_POWER, LONGEST = 12, 100  # of a symbol; characters of a unit
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?(?![\d.])")
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)(?=\s*\*\s*[A-Za-z%(])|"
    r"(?P<symbol>[A-Za-z%]+|1(?![\d.]))(?:(?:\^|\*\*)?(?P<power>(?<=[\^*])[+-]?\d+\.\d+|[+-]?\d+))?|(?P<op>[*/()]))\s*"
)
_SUPERSCRIPT = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")


def _symbol(token: re.Match[str], like: str) -> Unit:
    name = token["symbol"]
    if name in UNPREFIXED:
        return UNPREFIXED[name]
    if name in PREFIXED:
        return PREFIXED[name]
    if name[:1] in PREFIXES and name[1:] in PREFIXED:
        scale = Unit(Fraction(10) ** PREFIXES[name[0]], ONE.powers)
        return scale * PREFIXED[name[1:]]
    raise UnitError(f"unknown unit {name!r}{_did_you_mean(token, like)}")


def _did_you_mean(token: re.Match[str], like: str) -> str:
    """The units that differ in capitals alone, which may be 10⁹ apart, else the nearest; none with which the whole
    would have another dimension than ``like``, or the two nearest where this is not known.
    """
    name, text = token["symbol"], token.string
    words = {"micron": "um", "sec": "s", "usec": "us", "msec": "ms", "hz": "Hz", "degC": "K", "C": "K", "percent": "%",
             "hour": "h", "hr": "h", "minute": "min", "second": "s", "a": "yr", "month": "d"}  # fmt: skip
    single = name.removesuffix("s")
    every = [*UNPREFIXED, *PREFIXED, *(p + u for p in PREFIXES for u in PREFIXED)]
    wholes = {k: f"{text[: token.start('symbol')]}{k}{text[token.end('symbol') :]}" for k in every}
    known = [k for k in every if not like or _powers(wholes[k]) == parse_unit(like).powers]
    same_letters = [k for k in known if k.lower() == name.lower()]
    word = [words[single]] if words.get(single) in known else []
    close = word or same_letters or get_close_matches(name, known, 1 if like else 2, 0.6)
    if not close:
        return f"; it has to be one such as {like!r}" if like not in ("", "1") else ""
    return f"; did you mean {' or '.join(map(repr, close))}?"


@lru_cache(maxsize=1024)
def parse_unit(text: str, like: str = "") -> Unit:
    """The unit written as ``text``: ``"Pa s"``, ``"W/(m K^2)"``, ``"1/us"``, ``"m s-1"``, ``"s^0.6"``, ``"%"``.

    ``"2.76*um"`` is a unit as well, such as a pixel, and ``"1/(270*kHz)"``, the time between two frames.

    A product after a quotient (``"W/m K"``) is refused as ambiguous. Raises :class:`UnitError`, which proposes nothing
    of another dimension than the unit ``like``.
    """
    if not isinstance(text, str):
        raise UnitError(f"a unit is a text such as 'm/s', not {text!r}")
    if len(text) > LONGEST:
        raise UnitError(f"cannot read unit {text[:20]!r}…: {len(text)} characters")
    clean = text.replace("µ", "u").replace("μ", "u").replace("·", "*").translate(_SUPERSCRIPT)
    tokens, end = list[re.Match[str]](), 0
    while match := _TOKEN.match(clean, end):
        tokens.append(match)
        end = match.end()
    if end < len(clean):
        multiple = re.fullmatch(r"\s*([\d.]+(?:[eE][+-]?\d+)?)\s*([A-Za-z%(].*)", clean)
        hint = f"; a multiple of a unit has a star: '{multiple[1]}*{multiple[2]}'" if multiple else ""
        raise UnitError(f"cannot read unit {text!r} at {clean[end:]!r}{hint}")
    unit = _product(iter(tokens), text, like)
    if not 1e-90 < unit.factor < 1e90:
        raise UnitError(f"cannot read unit {text!r}: a unit is a positive multiple of another")
    return unit


def is_unit(text: str) -> bool:
    """Whether :func:`parse_unit` reads it."""
    return _powers(text) is not None


def _powers(text: str) -> tuple[int | Fraction, ...] | None:
    """The dimension of a unit; None of what is none."""
    try:
        return parse_unit(text).powers
    except UnitError:
        return None


def unit_after(unit: str) -> str:
    """``" kPa"``, to stand after a number of a message; nothing for a dimensionless quantity."""
    return "" if unit == "1" else f" {unit}"


def as_unit(quantity: str, unit: str) -> str:
    """A positive quantity in whatever has the dimension of ``unit``, the usual one, as a unit itself.

    Raises :class:`UnitError`.

    >>> as_unit("2.76 um", "m"), as_unit("2.7e5 1/s", "Hz")
    ('2.76*um', '2.7e5*(1/s)')
    """
    if not parse_quantity(quantity, unit) > 0:
        raise UnitError(f"{shown(quantity)} is not positive")
    number, symbol = split_quantity(quantity)
    return f"{number.lstrip('+')}*{symbol if symbol.isalpha() else f'({symbol})'}"


def _product(tokens: Iterator[re.Match[str]], text: str, like: str, closing: str = "") -> Unit:
    """Factors up to the ``closing`` bracket, or else the end; the whole ``text`` should be ``like`` another."""
    unit, operator, divided = ONE, "", False
    expects_factor, end = True, ""
    for token in tokens:
        op = token["op"]
        if op == ")":
            end = op
            break
        if op in ("*", "/"):
            if expects_factor:
                raise UnitError(f"cannot read unit {text!r}: {op!r} without a unit before it")
            operator, expects_factor = op, True
            continue
        if token["number"]:
            factor = Unit(Fraction(token["number"]), ONE.powers)
            if not expects_factor:
                raise UnitError(f"cannot read unit {text!r}: a number stands before a unit")
        elif op == "(":
            factor = _product(tokens, text, like, ")")
        else:
            power = token["power"] or "1"
            if len(power) > (7 if "." in power else 3) or abs(Fraction(power)) > LARGEST_POWER:
                raise UnitError(f"cannot read unit {text!r}: no unit has the power {power}")
            factor = _symbol(token, like) ** Fraction(power)
        if divided and operator != "/":
            raise UnitError(f"ambiguous unit {text!r}: write brackets, as in 'W/(m K)'")
        divided = divided or operator == "/"
        unit = unit * factor ** (-1 if operator == "/" else 1)
        operator, expects_factor = "", False
    if expects_factor:
        raise UnitError(f"cannot read unit {text!r}: a unit is missing")
    if end != closing:
        raise UnitError(f"cannot read unit {text!r}: unbalanced {end or '('!r}")
    return unit


@lru_cache(maxsize=1024)
def _factor(from_unit: str, to_unit: str) -> Fraction:
    source, target = parse_unit(from_unit, to_unit), parse_unit(to_unit)
    if source.powers != target.powers:
        raise UnitError(f"unit {from_unit!r} cannot be converted to {to_unit!r}")
    return source.factor / target.factor


@overload
def convert(value: float, from_unit: str, to_unit: str) -> float: ...
@overload
def convert(value: "Array", from_unit: str, to_unit: str) -> "Array": ...
def convert(value: "float | Array", from_unit: str, to_unit: str) -> "float | Array":
    """``value`` (a number or an array) of ``from_unit``, expressed in ``to_unit``. Raises :class:`UnitError`."""
    factor = _factor(from_unit, to_unit)
    # Dividing by 1e6 rounds once, multiplying by 1e-6 twice.
    return value * float(factor) if factor >= 1 else value / float(1 / factor)


def split_quantity(text: str) -> tuple[str, str]:
    """Number and unit as they are written, each "" where there is none; the unit of a length per pixel is a length.

    >>> split_quantity("2.76 um"), split_quantity("2.7e5/s"), split_quantity("4 um/px")
    (('2.76', 'um'), ('2.7e5', '1/s'), ('4', 'um'))
    """
    number = _NUMBER.match(text.strip())
    if not number:
        return "", ""
    unit = text.strip()[number.end() :].strip()
    per_pixel = re.fullmatch(r"(.+?)\s*/\s*(px|pixel)", unit)
    if per_pixel and is_unit(per_pixel[1]) and parse_unit(per_pixel[1]).powers == parse_unit("m").powers:
        unit = per_pixel[1]
    return number[0], f"1{unit}" if re.match(r"/\s*[a-zµμ]", unit, re.IGNORECASE) else unit


def parse_quantity(value: str | float, unit: str, usual: str = "") -> float:
    """A quantity such as ``"0.42 kPa"`` or ``"2.5 µs"``, expressed in ``unit``.

    A number without unit is accepted only where ``unit`` is dimensionless. Raises :class:`UnitError`, which proposes
    the ``usual`` unit for numbers from 0.001 to 1000, and else ``unit``.

    >>> parse_quantity("0.42 kPa", "Pa"), parse_quantity("1 %", "1"), parse_quantity(3, "1")
    (420.0, 0.01, 3.0)
    """
    text = str(value).strip()
    number, symbol = split_quantity(text)
    if not number:
        wanted = "" if unit == "1" else f" and a unit such as '1 {usual or unit}'"
        raise UnitError(f"{shown(value)} is not a quantity; write a number{wanted}")
    if len(number) > LONGEST:
        raise UnitError(f"{shown(value)}: a number of {len(number)} characters")
    if not symbol and parse_unit(unit).powers != ONE.powers:
        # beyond, a number is one of the unit without a prefix
        small = usual if 1e-3 <= abs(float(number)) < 1e3 else ""
        raise UnitError(f"{text} has no unit; write e.g. '{text} {small or unit}'")
    with retold(UnitError, UnitError, f"{shown(text)}: "):
        factor = _factor(symbol or "1", unit)
    try:
        return float(Fraction(number) * factor)
    except OverflowError:
        raise UnitError(f"{shown(text)}: larger than any number of the computer") from None


@dataclass(frozen=True)
class Quantity(GroupedMetadata):
    """Pydantic annotation: ``Annotated[float, Quantity("Pa")]`` reads ``"0.42 kPa"`` as 420.0, dumps JSON with unit."""

    unit: str

    def __iter__(self) -> Iterator[object]:
        from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema

        parse_unit(self.unit)
        plain = self.unit == "1"
        yield BeforeValidator(lambda text: parse_quantity(text, self.unit))
        yield PlainSerializer(lambda value: value if plain else f"{value!r} {self.unit}", when_used="json")
        # a number with a unit is text in YAML; without one it is accepted only where there is no unit
        text = {"type": "string", "pattern": r"^\s*[+-]?[\d.]", "x-unit": self.unit}
        yield WithJsonSchema({"type": ["number", "string"]} if plain else text)
