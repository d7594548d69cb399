"""Many data sets of one material: how much its parameters vary between the sets, pooled evidence.

runs = ForwardRuns(problems)                                          # en4dvar.sampling.forward_runs
estimate_population(runs, start, prior, ["a"], seed)                  # parameters that vary from set to set
population_of(problems, start, ["a"], seed)                           # the same of problems, in units of their priors

Parameters with one value in all sets are for :mod:`en4dvar.estimation.joint`.
"""

from en4dvar.estimation.population.campaign import CampaignPopulation, population_of
from en4dvar.estimation.population.effort import Effort
from en4dvar.estimation.population.estimate import Population, estimate_population
from en4dvar.estimation.population.hyper import HyperPrior

__all__ = ["CampaignPopulation", "Effort", "HyperPrior", "Population", "estimate_population", "population_of"]
