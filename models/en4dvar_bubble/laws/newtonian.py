"""Newtonian liquid."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Liquid
from en4dvar_bubble.laws.parameters import MU


class Newtonian(Liquid):
    r"""$J = -4\mu\dot R/R$ (Poritsky 1952)."""

    name: ClassVar[str] = "newtonian"
    title: ClassVar[str] = "Newtonian liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU,)
