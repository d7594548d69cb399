"""The test-beds of data assimilation: Lorenz-63, Lorenz-96, linear models, and Lotka–Volterra for series of data."""

from en4dvar_lorenz.linear import Linear, Trend
from en4dvar_lorenz.lorenz63 import Lorenz63
from en4dvar_lorenz.lorenz96 import Lorenz96
from en4dvar_lorenz.lotka_volterra import LotkaVolterra

__all__ = ["Linear", "Lorenz63", "Lorenz96", "LotkaVolterra", "Trend"]
