"""Constitutive laws: one class in one file each."""

from en4dvar_bubble.laws.base import REGISTRY, ConstitutiveLaw, Liquid, MemoryVariable
from en4dvar_bubble.laws.loading import get_law
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.quadratic import QuadraticKelvinVoigt

__all__ = [
    "REGISTRY",
    "ConstitutiveLaw",
    "Liquid",
    "MemoryVariable",
    "NeoHookeanKelvinVoigt",
    "QuadraticKelvinVoigt",
    "get_law",
]
