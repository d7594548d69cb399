"""A bubble in a viscoelastic medium, driven by an acoustic pulse or released from its maximum radius.

From the bottom up, each importing only what stands before it: ``tables`` (smooth functions), ``medium`` (constants, gas
and vapour), ``collapse`` (beside Rayleigh's), ``driving``, ``numbers`` (that may be parameters too), ``laws``,
``solver`` (compiled), ``dynamics`` (what is assumed, and the state at the start), ``paths`` (states to the solver's
arrays, and back), ``events`` (collapses, rebounds, what a hydrophone hears), ``settings`` (YAML), ``model`` (the
forward model), ``api`` (``simulate``), ``battery`` (checks of a law), ``starter`` (``en4dvar init``), ``examples``,
commands.
"""

from en4dvar_bubble.api import simulate
from en4dvar_bubble.driving import Driving, histotripsy, silence
from en4dvar_bubble.laws import (
    REGISTRY,
    ConstitutiveLaw,
    Liquid,
    MemoryVariable,
    NeoHookeanKelvinVoigt,
    QuadraticKelvinVoigt,
    get_law,
)
from en4dvar_bubble.medium import WATER_25C, Medium
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import ACCURACIES, Accuracy

__all__ = [
    "ACCURACIES", "REGISTRY", "WATER_25C", "Accuracy", "BubbleModel", "ConstitutiveLaw", "Driving", "Liquid", "Medium",
    "MemoryVariable", "NeoHookeanKelvinVoigt", "QuadraticKelvinVoigt", "get_law", "histotripsy", "silence", "simulate",
]  # fmt: skip
