r"""Problems of several experiments: quantities that experiments share, and quantities of their own.

    J(s, v_1 … v_E) = ½ ‖s‖² + Σ_e [ ½ ‖v_e‖² + J_o,e(s, v_e) ]

in units of the prior, which enters once for what is shared. From the bottom up: ``problem`` (who
shares what), ``descent`` (the linear algebra, an experiment's runs, and J), ``members`` (the posterior ensemble),
``agreement`` (is one odd?), ``estimate``.
"""

from en4dvar.estimation.joint.estimate import JointEstimate, estimate_jointly
from en4dvar.estimation.joint.problem import JointProblem, Single, sharing, with_common

__all__ = ["JointEstimate", "JointProblem", "Single", "estimate_jointly", "sharing", "with_common"]
