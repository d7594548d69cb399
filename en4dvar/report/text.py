"""Numbers, units and symbols as people read them. Pure functions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from markupsafe import Markup, escape

from en4dvar.estimation.summary import ParameterSummary
from en4dvar.model.state import Array
from en4dvar.plumbing.units import convert, is_unit
from en4dvar.results.declared import zero_of

if TYPE_CHECKING:
    from en4dvar.results.netcdf import Variable

VALUES = ("prior_mean", "prior_std", "mean", "std", "q05", "q50", "q95", "centre")  # of a parameter, in its unit
_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_NAMES = (
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi rho sigma tau phi chi psi omega pi infty ell "
    "Gamma Delta Theta Lambda Sigma Phi Psi Omega"
)
GREEK = dict(zip(_NAMES.split(), "αβγδεζηθκλμνξρστφχψωπ∞ℓΓΔΘΛΣΦΨΩ", strict=True))


def upper_first(words: str) -> str:
    """A sentence with a capital to begin with; its other letters, such as those of names, stay as they are."""
    return words[:1].upper() + words[1:]


def pretty_unit(unit: str) -> str:
    """``"um"`` → ``"µm"``, ``"Pa s"`` → ``"Pa·s"``, ``"J/m^2"`` → ``"J/m²"``, ``"1"`` → ``""``.

    >>> pretty_unit("um"), pretty_unit("Pa s^0.6"), pretty_unit("J/m^2"), pretty_unit("1"), pretty_unit("m s-1")
    ('µm', 'Pa·s^0.6', 'J/m²', '', 'm·s⁻¹')
    """
    if unit == "1":
        return ""
    text = re.sub(r"(?<![A-Za-z])u(?=[A-Za-z])", "µ", unit.strip())
    text = re.sub(r"(?<=[A-Za-zµ])(?:\^|\*\*)?(-?\d+)(?![\d.])", lambda m: m[1].translate(_SUPERSCRIPT), text)
    return re.sub(r"\s*\*\s*|\s+", "·", text)


def typeset(words: object) -> Markup:
    """``"at 18.2 us"`` → ``"at 18.2 µs"``, as the tables of a page write it, and powers of e with their exponent above;
    everything else is escaped text.

    >>> print(typeset("1.4 um in 2 uses, 5 us, e^12.4 times < 1"))
    1.4 µm in 2 uses, 5 µs, e<sup>12.4</sup> times &lt; 1
    """
    text = re.sub(r"(?<=\d )u\w+\b", lambda m: pretty_unit(m[0]) if is_unit(m[0]) else m[0], str(words))
    return Markup(re.sub(r"\be\^([\d.]*\d)", r"e<sup>\1</sup>", str(escape(text))))


def unit_behind(unit: str) -> str:
    """``" kPa"``, to stand behind a number; nothing for a dimensionless quantity."""
    return f" {pretty_unit(unit)}".rstrip()


def with_unit(label: str, unit: str) -> str:
    """``"shear modulus (kPa)"``; the bare label for a dimensionless quantity."""
    shown = pretty_unit(unit)
    return f"{label} ({shown})" if shown else label


def plain_number(value: float, digits: int = 4) -> str:
    """``digits`` significant digits; powers of ten only where the number would be long; an en dash for NaN."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return text.replace("-", "−")


def rough_number(value: float) -> str:
    """Two significant digits, as people write them; an en dash for NaN.

    >>> rough_number(287.4), rough_number(1.333), rough_number(6.18e6)
    ('290', '1.3', '6.2×10⁶')
    """
    if not math.isfinite(value) or not 1 <= abs(value) < 1e4:
        return plain_number(value, 2)
    return plain_number(float(f"{value:.2g}"))


def number_like(value: float, std: float) -> str:
    """``value`` rounded to the precision that ``std`` allows.

    >>> number_like(2.80123, 0.104), number_like(-0.0, 0.1), number_like(float("nan"), 1.0)
    ('2.80', '0.00', '–')
    >>> number_like(6.041e-9, 1.239e-10), number_like(1.239e-10, 1.239e-10)
    ('6.04×10⁻⁹', '1.2×10⁻¹⁰')
    """
    places = max(0, 1 - math.floor(math.log10(std))) if std > 0 and math.isfinite(std) else 3  # two digits of the std
    if not math.isfinite(value):
        return "–"
    if places > 6 or max(abs(value), abs(std) if math.isfinite(std) else 0.0) >= 1e6:
        known = value != 0 and std > 0 and math.isfinite(std)
        digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(std)) + 2 if known else 4
        return plain_number(value, max(1, digits))
    text = f"{value:.{places}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


def quantity(value: float, std: float, unit: str = "1") -> str:
    """``"2.80 kPa"``, with the decimals that the std calls for."""
    return f"{number_like(value, std)}{unit_behind(unit)}"


def range_words(low: float, high: float, std: float, unit: str = "1") -> str:
    """``"2.6 … 3.0 kPa"``, with the decimals that the std calls for; a lower end above zero is not rounded to zero.

    >>> range_words(2.6, 3.0, 0.12, "kPa"), range_words(4e-5, 0.0108, 0.004), range_words(-4e-5, 0.0108, 0.004)
    ('2.60 … 3.00 kPa', '4×10⁻⁵ … 0.0108', '0.0000 … 0.0108')
    """
    least = number_like(low, std)
    return f"{plain_number(low, 1) if low > 0 and not least.strip('0.') else least} … {quantity(high, std, unit)}"


def power_of(mean: float, std: float) -> int:
    """The power of ten, a multiple of three, to write both with where :func:`number_like` needs one: 0 of usual sizes.

    >>> power_of(6.041e-9, 1.239e-10), power_of(2.8, 0.1), power_of(2.8, 1e-7)
    (-9, 0, 0)
    """
    largest = max(abs(mean), std)
    usual = (not 0 < std < 1e-5 and largest < 1e6) or not math.isfinite(largest)
    return 0 if usual else 3 * math.floor(math.log10(largest) / 3)


def plus_minus(mean: float, std: float) -> str:
    """``"2.80 ± 0.10"``: the spread with two significant digits, the mean to the same decimals.

    >>> plus_minus(6.041e-9, 1.239e-10)
    '(6.04 ± 0.12)×10⁻⁹'
    """
    if power := power_of(mean, std):
        return f"({plus_minus(mean / 10.0**power, std / 10.0**power)})×10{str(power).translate(_SUPERSCRIPT)}"
    return f"{number_like(mean, std)} ± {number_like(std, std)}"


def in_powers(row: ParameterSummary) -> ParameterSummary:
    """In its unit times a power of ten, where its numbers are far from 1: columns of them stay narrow."""
    power = power_of(row.mean, row.std if math.isfinite(row.std) else row.prior_std)
    if not power:
        return row
    numbers = {name: getattr(row, name) / 10.0**power for name in VALUES}
    unit = "" if row.unit == "1" else row.unit
    return replace(row, **numbers, unit=f"10{str(power).translate(_SUPERSCRIPT)} {unit}".strip())


def estimate(row: ParameterSummary, mark: str = ", not to be trusted") -> str:
    """Mean and spread; a mean of three digits, marked, where they are not to be trusted; of several modes 5 to 95 %."""
    if row.modal:
        return f"{number_like(row.q05, row.std)} to {number_like(row.q95, row.std)}"
    return f"{plain_number(row.mean, 3)}{mark}" if row.untrusted else plus_minus(row.mean, row.std)


def untrusted_words(row: ParameterSummary) -> str:
    """What it is not to be trusted for, ``"misfit, at bound"``; "" where it is."""
    return ", ".join(code.replace("-", " ") for code in row.untrusted)


def signed(value: float) -> str:
    """Two significant digits with their sign.

    >>> signed(0.234), signed(-4.0)
    ('+0.23', '−4')
    """
    return ("+" if value > 0 else "") + plain_number(value, 2)


def fixed(value: float, places: int) -> str:
    """A number of so many decimals; an en dash for NaN.

    >>> fixed(-1.25, 1), fixed(-0.01, 1)
    ('-1.2', '0.0')
    """
    return f"{value:z.{places}f}" if math.isfinite(value) else "–"


def shown(variable: Variable, values: npt.ArrayLike | None = None) -> Array:
    """The values of a variable of a result file in its display unit, or others that have its unit."""
    held = np.asarray(variable.values if values is None else values, dtype=float)
    return convert(held, str(variable.attrs["units"]), display_unit(variable))


def display_unit(variable: Variable) -> str:
    """The unit in which a variable of a result file is shown."""
    return str(variable.attrs.get("display_units", variable.attrs["units"]))


def axis_label(variable: Variable, words: str = "") -> str:
    """Words, or the symbol of a variable of a result file, and its display unit."""
    return with_unit(words or str(variable.attrs["symbol"]), display_unit(variable))


def since(zero: float, unit: str, reach: float) -> str:
    """Of an axis of the model's times up to ``reach``, at whose zero the clock of the data shows ``zero``, all in a
    display unit: to a thousandth of the axis, where nobody sees more.

    >>> since(0.924895, "us", 30.0), since(3.0, "s", 1e-3), since(2500000.0, "1", 6.0)
    ('time since 0.92 µs of the data (µs)', 'time since 3 s of the data (s)', 'time since 2500000 of the data')
    """
    seen = zero and round(zero, 4 - math.ceil(math.log10(abs(reach) or 1)))
    return with_unit(f"time since {plain_number(seen, 9)}{unit_behind(unit)} of the data" if seen else "time", unit)


def time_axis(*times: Variable) -> str:
    """Of an axis of times of readings of a result file; of clocks that begin at other times it is the model's alone."""
    zeros = {float(shown(time, zero_of(time))) for time in times}
    reach = max((float(np.nanmax(shown(time))) for time in times if time.values.size), default=1.0)
    return since(zeros.pop() if len(zeros) == 1 else 0.0, display_unit(times[0]), reach)


def figure_text(name: str) -> str:
    """A name as text of a figure: no mathtext, not longer than a label can be."""
    short = name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"
    return "".join(c if c.isprintable() else " " for c in short).replace("$", r"\$")


def symbol_html(symbol: str) -> Markup:
    r"""A mathtext symbol as HTML: Greek letters, sub- and superscripts; everything else is escaped text.

    >>> str(symbol_html(r"$\mu$")), str(symbol_html(r"$R_{\mathrm{eq}}$")), str(symbol_html("<b>"))
    ('<i>μ</i>', '<i>R</i><sub>eq</sub>', '&lt;b&gt;')
    """
    tags = {"_": "sub", "^": "sup", "i": "i"}
    parts = ((tags.get(mark), piece) for mark, piece in pieces(symbol))
    return Markup("").join(Markup(f"<{tag}>{{}}</{tag}>").format(piece) if tag else piece for tag, piece in parts)


def with_symbols(words: str) -> Markup:
    r"""A sentence with mathtext symbols in it, and their exponents, as HTML; everything else is escaped text.

    >>> str(with_symbols(r"$\mu$ of a < b")), str(with_symbols(r"$G$ · $\alpha$^0.23"))
    ('<i>μ</i> of a &lt; b', '<i>G</i> · <i>α</i><sup>0.23</sup>')
    """
    return symbol_html(re.sub(r"\$\^(−?[\d.]+)", r"^{\1}$", words))


def without_folders(text: object) -> str:
    """A text of a page, which others may see, without the folders of this machine that begin a path.

    >>> without_folders("path: /home/me/data/x.csv"), without_folders("data/x.csv, W/(m K)")
    ('path: …/x.csv', 'data/x.csv, W/(m K)')
    """
    return re.sub(r"(?<![^\s'\"])(?:[A-Za-z]:)?[\\/](?=[^\s\\/])(?:[^\\/\n'\",]+[\\/])+", "…/", str(text))


def pieces(text: str) -> Iterator[tuple[str, str]]:
    r"""Text with symbols between dollar signs: ("", words), ("i", base), ("_", index) and ("^", exponent) in order.

    >>> list(pieces(r"at $R_{\mathrm{eq}}$ for 5 \$"))
    [('', 'at '), ('i', 'R'), ('_', 'eq'), ('', ' for 5 $')]
    """
    for i, part in enumerate(re.split(r"(?<!\\)\$([^$]+)\$", text)):
        if i % 2:
            yield from _of_math(part)
        elif part:
            yield "", part.replace(r"\$", "$")


def _of_math(body: str) -> list[tuple[str, str]]:
    """What stands between two dollar signs."""
    body = re.sub(r"(?<![_^])\\(?:mathrm|text|mathit)\s*\{([^{}]*)\}", r"\1", body)
    body = re.sub(r"\\(?:mathrm|text|rm|mathit)\b\s*", "", body)
    body = re.sub(r"\\([A-Za-z]+)\s?", lambda m: GREEK.get(m[1], f"{m[1]} "), body).rstrip()
    parts = re.findall(r"([_^])(\{[^{}]*\}|.)|([^_^]+)", body)
    return [(mark or "i", index.strip("{} ") or base.strip("{}")) for mark, index, base in parts]
