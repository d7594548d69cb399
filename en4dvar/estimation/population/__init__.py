"""Many data sets of one material: how much its parameters vary between the sets, pooled evidence.

    population_of(problems, start, ["a"], seed)       # parameters that vary from set to set

Parameters with one value in all sets are for :mod:`en4dvar.estimation.joint`.
"""

from en4dvar.estimation.population.campaign import Population, population_of
from en4dvar.estimation.population.hierarchy import Effort, HyperPrior

__all__ = ["Effort", "HyperPrior", "Population", "population_of"]
