"""Parameters that vary in time: their random walk, the model run piece by piece, and its paths."""

from en4dvar.varying.model import PiecewiseModel as PiecewiseModel
from en4dvar.varying.random_walk import RandomWalk as RandomWalk
