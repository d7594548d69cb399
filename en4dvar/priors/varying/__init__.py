"""Parameters that vary in time: their random walk; model error; the model run piece by piece, and its paths."""

from en4dvar.priors.varying.model import PiecewiseModel as PiecewiseModel
from en4dvar.priors.varying.model import RandomWalk as RandomWalk
from en4dvar.priors.varying.model import StateChanges as StateChanges
from en4dvar.priors.varying.model import Varying as Varying
