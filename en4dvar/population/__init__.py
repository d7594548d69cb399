"""Many data sets of one material: shared parameters, the spread between the sets, pooled evidence.

runs = ForwardRuns(problems)                                          # en4dvar.sampling.forward_runs
estimate_population(runs, start, prior, ["a"], seed)                  # parameters that vary from set to set
fit_shared(runs, starts, prior, ["a"])                                # parameters with one value in all sets
"""

from en4dvar.population.effort import Effort
from en4dvar.population.estimate import Population, estimate_population
from en4dvar.population.hyper import HyperPrior
from en4dvar.population.shared import SharedFit, fit_shared

__all__ = ["Effort", "HyperPrior", "Population", "SharedFit", "estimate_population", "fit_shared"]
