"""The far-field pressure p_f(t) that drives an acoustic bubble."""

from en4dvar_bubble.driving.base import Driving, Reading, with_knots
from en4dvar_bubble.driving.pulses import Envelope, gaussian, histotripsy, silence, sine_burst, step
from en4dvar_bubble.driving.tabulated import from_file, tabulated

__all__ = [
    "Driving", "Envelope", "Reading", "from_file", "gaussian", "histotripsy", "silence", "sine_burst", "step",
    "tabulated", "with_knots",
]  # fmt: skip
