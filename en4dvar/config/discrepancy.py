"""``data.error.discrepancy``: the priors of what the model misses."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

from pydantic import Field

from en4dvar.config.context import Context, Made, Spread, observable_unit, quantity, require_sign, time_unit
from en4dvar.config.error_std import read_spread
from en4dvar.config.schema import Section
from en4dvar.noise import SMOOTHNESS, Kernel
from en4dvar.prior import PriorTerm
from en4dvar.state import Array, Parameter
from en4dvar.units import parse_quantity

_OF_WINDOW = re.compile(r"(.*%)\s+of\s+(?:the\s+)?window")


def _length(text: Any, context: Context) -> Spread:
    relative = _OF_WINDOW.fullmatch(str(text).strip())
    spread = Spread(
        parse_quantity(relative[1] if relative else text, "1" if relative else time_unit(context)), bool(relative)
    )
    require_sign(spread.value, "positive", text)
    return spread


def _rate_unit(context: Context) -> str:
    return f"({observable_unit(context)})/({time_unit(context)})"


LogStd = Annotated[float, Field(gt=0)]


class AmplitudeSection(Section):
    """Lognormal prior of the discrepancy's standard deviation."""

    median: Annotated[Spread, Made(read_spread)] = Field("0.5 % of maximum", validate_default=True)
    """A quantity in the observable's unit, or e.g. '2 % of maximum'."""
    log_std: LogStd = 1.5
    """Standard deviation of the natural logarithm."""


class LengthSection(Section):
    """Lognormal prior of the time over which the discrepancy forgets itself."""

    median: Annotated[Spread, Made(_length)] = Field("10 % of window", validate_default=True)
    """A time, or e.g. '10 % of window'."""
    log_std: LogStd = 0.7
    """Standard deviation of the natural logarithm."""


class DiscrepancySection(Section):
    """What the model misses: a Gaussian process beside the errors whose amplitude and length are estimated."""

    amplitude: AmplitudeSection = Field({}, validate_default=True)
    """Prior of ``discrepancy_amplitude``, its standard deviation."""
    length: LengthSection = Field({}, validate_default=True)
    """Prior of ``discrepancy_length``, its correlation time."""
    kernel: Literal["exponential", "matern-3/2", "matern-5/2"] = "exponential"
    """Correlation in time: exponential (rough paths), or Matérn's with one or two derivatives."""
    grows_beyond: Annotated[float | None, quantity(_rate_unit, "positive")] = None
    """Rate of the observable beyond which the amplitude grows in proportion to it, e.g. 20 m/s; default: constant."""

    def kernel_at(self, times: Array) -> Kernel:
        """The kernel at observation times (K,)."""
        return Kernel(times, SMOOTHNESS[self.kernel], self.grows_beyond or math.inf)

    def terms(self, parameters: tuple[Parameter, Parameter], maximum: float, window: float) -> tuple[PriorTerm, ...]:
        """Priors of amplitude and length, from the largest observation and the duration of the window."""
        amplitude, length = parameters
        return (
            PriorTerm.lognormal(amplitude, self.amplitude.median.absolute(maximum), self.amplitude.log_std),
            PriorTerm.lognormal(length, self.length.median.absolute(window), self.length.log_std),
        )


def estimated(given: Any) -> Any:
    if given == "estimated":
        return {}
    if given is not None and not isinstance(given, dict):
        raise ValueError("write estimated, or the priors of its amplitude and length")
    return given
