"""Constitutive laws, a family a file; a law is one class. A new file of this folder is found by itself."""

from importlib import import_module
from pkgutil import iter_modules

from en4dvar_bubble.laws.base import REGISTRY, ConstitutiveLaw, Liquid
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt, QuadraticKelvinVoigt
from en4dvar_bubble.laws.loading import get_law
from en4dvar_bubble.laws.memory import MemoryVariable

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "REGISTRY", "ConstitutiveLaw", "Liquid", "MemoryVariable", "NeoHookeanKelvinVoigt", "QuadraticKelvinVoigt",
    "get_law",
]  # fmt: skip
