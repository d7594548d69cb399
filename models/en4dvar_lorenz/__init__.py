"""The test-beds of data assimilation: Lorenz-63, Lorenz-96 and a linear model, for twin experiments."""

from en4dvar_lorenz.linear import Linear
from en4dvar_lorenz.lorenz63 import Lorenz63
from en4dvar_lorenz.lorenz96 import Lorenz96

__all__ = ["Linear", "Lorenz63", "Lorenz96"]
