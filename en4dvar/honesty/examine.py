"""The checks: what an assimilation ended with → warnings, the worst first. Nothing is run and nothing recomputed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from en4dvar.diagnostics import shape_warnings
from en4dvar.forward import ValidityLimit
from en4dvar.honesty import checks
from en4dvar.honesty.caution import Caution, caution, worst_first
from en4dvar.honesty.lost import loss
from en4dvar.prior import Prior
from en4dvar.state import Array

COLLAPSED = 1 / 9  # of the mean of 2 (J − J_min) per parameter: a spread below a third of what J allows
SHORT_STEP = 0.5  # posterior standard deviations
NO_SPREAD = 1e-8  # of the prior's: members that agree to rounding


@dataclass(frozen=True)
class Ending:
    """What the checks look at. N members, n parameters; ensembles are in transformed space.

    ``costs`` (N,) are J of the posterior members, +inf where one failed, ``cost`` is J at the ``mode`` (n,).
    ``step_norm`` is the length of the next step in posterior standard deviations, had there been one. ``chi2`` is the
    sum of squared standardised residuals of ``n_weighted`` observations. ``failures`` are the reasons, "" for a member
    alive, in the prior forecast, in the iteration that lost most, and in the posterior forecast. ``extremes`` (N, V)
    are what the posterior members reached of the model's ``limits``. ``found`` are warnings met on the way.
    """

    prior: Prior
    members: Array
    posterior: Array
    mode: Array
    costs: Array
    cost: float
    converged: bool
    stop_reason: str
    step_norm: float
    chi2: float
    n_weighted: int
    dfs: float
    dfs_per_parameter: Array
    prior_failures: Sequence[str]
    worst_loss: Sequence[str]
    posterior_failures: Sequence[str]
    shape: Mapping[str, float] = field(default_factory=dict)
    limits: tuple[ValidityLimit, ...] = ()
    extremes: Array = field(default_factory=lambda: np.empty((0, 0)))
    found: tuple[Caution, ...] = ()

    @cached_property
    def alive(self) -> Array:
        """(N,) bool, of the posterior forecast."""
        return np.array([not reason for reason in self.posterior_failures], dtype=bool)


def examine(end: Ending) -> tuple[Caution, ...]:
    """Everything that should keep a reader from trusting the posterior, or that they should know, worst first."""
    return worst_first(
        (
            *end.found,
            *unfinished(end),
            *checks.rank(end.prior, end.members, end.posterior[end.alive]),
            *collapse(end),
            *loss("prior forecast", end.prior_failures, end.prior, end.members),
            *loss("iterations", end.worst_loss, end.prior),
            *loss("posterior forecast", end.posterior_failures, end.prior, end.posterior),
            *checks.fit(end.chi2, end.n_weighted, end.dfs),
            *checks.conflict(end.prior, end.mode),
            *checks.at_bound(end.prior, end.members, end.posterior, end.posterior_failures),
            *(checks.validity(end.limits, end.extremes[end.alive]) if end.limits else ()),
            *(caution("non-gaussian", words) for words in shape_warnings(end.shape)),
            *checks.information(end.prior.names, end.dfs_per_parameter),
        )
    )


def unfinished(end: Ending) -> tuple[Caution, ...]:
    """Iterations that stopped before their own criterion; a note where the next step would have been short.

    A gradient regressed over the ensemble need not vanish where J is smallest, so that variant often ends like this.
    """
    if end.converged:
        return ()
    words = f"not converged: {end.stop_reason}"
    if not end.step_norm <= SHORT_STEP:
        return (caution("not-converged", words),)
    words = f"{words}; the next step would be {end.step_norm:.2g} posterior standard deviations"
    advice = "no action is needed where this is little to you; else start again from another seed"
    return (replace(caution("not-converged", words, "note"), advice=advice),)


def collapse(end: Ending) -> tuple[Caution, ...]:
    """A spread far below what J allows: for a Gaussian posterior 2 (J − J_min) of its members is χ²_n, with mean n.

    The lowest J met, of a member or of the mode, stands for the minimum.
    """
    alive, n = end.alive & np.isfinite(end.costs), len(end.mode)
    if alive.sum() < 2:
        return ()
    narrow = end.posterior[alive].std(axis=0) <= NO_SPREAD * end.prior.std
    if narrow.any():
        names = ", ".join(name for name, no_spread in zip(end.prior.names, narrow, strict=True) if no_spread)
        return (caution("ensemble-collapse", f"the ensemble has collapsed: all members have the same {names}"),)
    lowest = min(end.cost, float(end.costs[alive].min()))
    allowed = float(np.mean(2 * (end.costs[alive] - lowest))) / n
    if allowed >= COLLAPSED:
        return ()
    return (
        caution(
            "ensemble-collapse",
            f"the ensemble has collapsed: its spread is about {math.sqrt(allowed):.2g} of what the data and the prior "
            "allow",
        ),
    )
