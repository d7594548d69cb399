"""When not to trust a posterior: pure functions from the end of an assimilation to warnings with a stable code."""

from en4dvar.diagnosis.honesty.examine import ControlEnsembles, doubts, examine
from en4dvar.plumbing.caution import CATALOGUE, Caution, caution

__all__ = ["CATALOGUE", "Caution", "ControlEnsembles", "caution", "doubts", "examine"]
