"""The far-field pressure p_f(t) that drives an acoustic bubble."""

from en4dvar_bubble.driving.base import Driving, Reading, with_knots
from en4dvar_bubble.driving.pulses import from_file, gaussian, histotripsy, silence, sine_burst, step, tabulated

__all__ = [
    "Driving", "Reading", "from_file", "gaussian", "histotripsy", "silence", "sine_burst", "step",
    "tabulated", "with_knots",
]  # fmt: skip
