"""Round numbers for the axes of a chart, and how they are written."""

import math
from collections.abc import Sequence
from itertools import pairwise

from en4dvar.report.text import plain_number


def ticks(low: float, high: float, wanted: int | Sequence[float], whole: bool = False) -> list[float]:
    """Round numbers between two limits: at most ``wanted`` intervals, or the given ones."""
    if not isinstance(wanted, int):
        return [float(t) for t in wanted]
    rough = (high - low) / max(wanted, 1)
    if not (rough > 0 and math.isfinite(rough)):
        return [low]
    scale = 10.0 ** math.floor(math.log10(rough))
    step = next(s * scale for s in (1, 2, 2.5, 5, 10) if s * scale >= rough * (1 - 1e-9))
    step = max(1.0, float(math.ceil(step))) if whole else step
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def labelled(
    limits: tuple[float, float], wanted: int | Sequence[float], names: Sequence[str] = (), *, logarithmic: bool = False,
    whole: bool = False,
) -> list[tuple[float, str]]:  # fmt: skip
    """The ticks of an axis within its limits, each with its number or its name."""
    low, high = sorted(limits)
    powers_of_ten = logarithmic and isinstance(wanted, int)
    chosen = powers(low, high) if powers_of_ten else ticks(low, high, wanted, whole)
    held = [t for t in chosen if low <= t <= high or math.isclose(t, low) or math.isclose(t, high)]
    texts = names or ([plain_number(t, 3) for t in held] if logarithmic else numbers(held))
    return list(zip(held, texts, strict=True))


def powers(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 3), (1, 2, 5)):
        values = [f * 10.0**k for k in exponents for f in factors if low <= f * 10.0**k <= high]
        if len(values) > 2:
            break
    return values[:: max(1, len(values) // 6)]


def numbers(values: Sequence[float]) -> list[str]:
    """Ticks as text, all with the same decimals."""
    size = max(map(abs, values), default=0.0)
    step = min((abs(b - a) for a, b in pairwise(values)), default=size)
    if (size and not 1e-3 <= size < 1e5) or step <= 0:
        return [plain_number(v, 3) for v in values]
    places = next((n for n in range(7) if all(abs(v - round(v, n)) < 1e-6 * step for v in values)), 7)
    return [f"{v:.{places}f}".replace("-", "−") if round(v, places) else "0" for v in values]
