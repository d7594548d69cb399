"""Labels and symbols of a model, tried before any work: matplotlib reads them when everything else is done."""

from __future__ import annotations

import re
from collections.abc import Iterable

from en4dvar.errors import ConfigError
from en4dvar.forward import Observable
from en4dvar.hints import shown
from en4dvar.state import Parameter

GREEK = (
    "alpha|beta|gamma|delta|epsilon|varepsilon|zeta|eta|theta|vartheta|iota|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|"
    "upsilon|phi|varphi|chi|psi|omega|Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Phi|Psi|Omega|infty|ell"
)
FUNCTIONS = "exp|ln|log|max|min"
_LETTER = rf"(?:[A-Za-z0-9]|\\(?:{GREEK})(?![A-Za-z]))"
_ROMAN = r"\\mathrm\{[A-Za-z0-9]+\}"
_GROUP = rf"\{{(?:[A-Za-z0-9](?:[, ]*[A-Za-z0-9])*|{_ROMAN}|\\(?:{FUNCTIONS}))\}}"
_BESIDE = rf"[_^](?:{_LETTER}|{_ROMAN}|{_GROUP})"
_ATOM = rf"(?:{_LETTER}(?:{_BESIDE})?|\\dot\{{[A-Za-z]\}}|\\(?:{FUNCTIONS})(?![A-Za-z])|[|/()+=,-])"
FORMULA = rf"\$(?:{_ATOM} ?)+\$"
_SIMPLE = re.compile(rf"[^$\\]*|{FORMULA}", re.ASCII)


def check_symbols(things: Iterable[Parameter | Observable]) -> None:
    """Raises :class:`ConfigError`: a label or symbol that cannot be written in a figure."""
    for thing in things:
        for what, text in (("symbol", thing.symbol), ("label", thing.label)):
            if reason := symbol_fault(text):
                raise ConfigError(f"the {what} {shown(text)} of {thing.name} cannot be written in a figure: {reason}")


def symbol_fault(text: str) -> str:
    """What keeps ``text`` from being written in a figure, "" where nothing does."""
    if not text.isprintable():
        return "it holds characters that are not printed"
    if _SIMPLE.fullmatch(text):  # matplotlib takes time to import
        return ""
    if len(re.findall(r"(?<!\\)\$", text)) % 2:
        return r"a $ is left over; write \$ for the sign itself"
    from matplotlib.mathtext import MathTextParser

    try:
        MathTextParser("path").parse(text)
    except (ValueError, RuntimeError) as error:  # Unknown symbol: \x, found '\'  (at char 0), (line:1, col:1)
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return re.sub(r"\s+\(at char.*", "", lines[-1]) if lines else "matplotlib cannot read it"
    return ""
