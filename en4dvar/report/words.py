"""Lines of text in a drawing: words as words, symbols slanted, indices small and shifted."""

from __future__ import annotations

import re
from collections.abc import Iterator

from markupsafe import escape

from en4dvar.report.text import math_pieces

FONT, SMALL = 8.0, 7.0
EM = 0.56  # width of a character on average, of its height
WIDEST = 0.64  # the same of digits and small letters in the widest of the usual fonts (DejaVu Sans, Verdana)


def written(
    text: str, x: float, y: float, anchor: str = "middle", size: float = SMALL, colour: str = "ink",
    turned: tuple[float, float] | None = None,
) -> str:  # fmt: skip
    """A line of text; ``turned``: upright, about this point."""
    if not text:
        return ""
    at = f'transform="translate({turned[0]:.1f} {turned[1]:.1f}) rotate(-90)"' if turned else f'x="{x:.1f}" y="{y:.1f}"'
    ink = f' color="var(--{colour})"' if colour != "ink" else ""
    return f'<text {at} text-anchor="{anchor}" font-size="{size:g}"{ink}>{_spans(text, size)}</text>'


def _spans(text: str, size: float) -> str:
    """Text with symbols: letters slanted, indices small and shifted."""
    parts, shift = [], 0.0
    for mark, piece in _pieces(text):
        wanted = {"_": 0.22, "^": -0.4}.get(mark, 0.0) * size
        dy = f' dy="{wanted - shift:.2g}"' if wanted != shift else ""
        small = f' font-size="{0.72 * size:.3g}"' if mark in "_^" and mark else ""
        slant = ' font-style="italic"' if mark == "i" else ""
        parts.append(
            f"<tspan{dy}{small}{slant}>{escape(piece)}</tspan>" if dy or small or slant else str(escape(piece))
        )
        shift = wanted
    return "".join(parts)


def _pieces(text: str) -> Iterator[tuple[str, str]]:
    """("", words), ("i", symbol), ("_", index) or ("^", exponent), in order."""
    for i, part in enumerate(re.split(r"(?<!\\)\$", text)):
        if i % 2:
            yield from ((mark or "i", piece) for mark, piece in math_pieces(part))
        elif part:
            yield "", part.replace(r"\$", "$")


def width_of(text: str) -> float:
    """Points that small text takes, about."""
    return EM * SMALL * sum(len(piece) for _, piece in _pieces(text))
