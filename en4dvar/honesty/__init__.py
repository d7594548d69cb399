"""When not to trust a posterior: pure functions from the end of an assimilation to warnings with a stable code."""

from en4dvar.caution import CATALOGUE, Caution, caution
from en4dvar.honesty.examine import ControlEnsembles, doubts, examine

__all__ = ["CATALOGUE", "Caution", "ControlEnsembles", "caution", "doubts", "examine"]
