r"""Expected information by linearisation, averaged over the prior.

At a draw u of the prior with the whitened sensitivities S of the readings the posterior is about N(·, M⁻¹),
M = I + SᵀS, and what it says of what is asked is the Schur complement M_a = M_aa − M_ab M_bb⁻¹ M_ba,

    I ≈ E_u[½ ln det M_a(u)],

exact where F and H are linear (Long, Scavino, Tempone & Wang 2013, Comput. Methods Appl. Mech. Eng. 259, 24). n
experiments alike share s, what is asked and what is common to them, such as a scale: each adds M_s − I, and what is
common is left out at the end, I ≈ E[½ ln det (I + n (M_s − I))_a].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from en4dvar.estimation.design.planned import Planned, Tangents
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import TooFewMembersError

FEWEST = 0.5  # of the draws must be alive


@dataclass(frozen=True)
class Gains:
    """``gains`` (R,) of the draws, nats."""

    gains: Array

    @property
    def gain(self) -> float:
        """Expected information, nats."""
        return float(self.gains.mean())

    @property
    def error(self) -> float:
        """Monte Carlo standard error of :attr:`gain`."""
        return standard_error(self.gains)


@dataclass(frozen=True)
class Expected(Gains):
    """By linearisation; posterior ``std`` (R, a) of what is asked, in transformed space, relative to the prior's;
    ``lost``: share of the draws at which the model fails.
    """

    std: Array
    lost: float


def standard_error(values: Array) -> float:
    """Standard error of the mean of independent values (R,)."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def expected(planned: Planned, tangents: Tangents, count: int, alike: int = 1) -> Expected:
    """Expected information of ``alike`` experiments, from tangents at those of ``count`` draws that can be run."""
    require_alive(len(tangents.at), count)
    _, rows = tangents.whitened(planned)
    asked, ratio = shared_spread(planned, np.einsum("rki,rkj->rij", rows, rows), alike)
    return Expected(0.5 * np.linalg.slogdet(asked)[1], ratio, 1 - len(tangents.at) / count)


def shared_spread(
    planned: Planned, information: Array, alike: int, precision: Array | None = None
) -> tuple[Array, Array]:
    """What ``alike`` experiments of information SᵀS (R, n, n) each leave: the precision (R, a, a) of what is asked, and
    its std (R, a) in transformed space, relative to the prior's; with another prior ``precision`` (n, n) than I.
    """
    prior = np.eye(information.shape[2])[None] if precision is None else precision[None]
    before, after = (about(each, planned.shared) for each in (prior, prior + information))
    asked, a = about(before + alike * (after - before), planned.asked), planned.asked
    root = planned.root[planned.order][:a, :a]
    spread = np.sqrt(np.einsum("ij,rjk,ik->ri", root, np.linalg.inv(asked), root))
    return asked, spread / np.sqrt(np.einsum("ij,ij->i", root, root))


def precision(rows: Array) -> Array:
    """I + SᵀS (R, n, n) of sensitivities (R, K', n)."""
    return np.asarray(np.eye(rows.shape[2]) + np.einsum("rki,rkj->rij", rows, rows))


def about(matrices: Array, asked: int) -> Array:
    """Schur complements (R, a, a) of precision matrices (R, n, n): the precision of the first a coordinates."""
    if asked == matrices.shape[2]:
        return matrices
    mixed = matrices[:, :asked, asked:]
    return np.asarray(
        matrices[:, :asked, :asked] - mixed @ np.linalg.solve(matrices[:, asked:, asked:], mixed.transpose(0, 2, 1))
    )


def require_alive(alive: int, count: int) -> None:
    """Raise :class:`TooFewMembersError` unless half of the draws are alive."""
    if alive < FEWEST * count or not alive:
        raise TooFewMembersError(f"the model fails at {count - alive} of {count} draws of the prior")
