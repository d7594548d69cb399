r"""What an error bar is made of: errors of the readings, what the model misses, how well other numbers are known.

A posterior that is Gaussian, of covariance C beside a prior of covariance B = diag(b_j), follows the prior's mean by
C B⁻¹. So that part of the variance of parameter i which comes from what was known of parameter j before is

    (C B⁻¹)_ij² b_j = C_ij² / b_j,

and the rest of C_ii comes from the readings. Of a number that the readings hardly tell, C_jj ≈ b_j, it is the squared
correlation with it: what would go if that number were known exactly.
"""

from collections.abc import Mapping

import numpy as np

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import active_members
from en4dvar.diagnosis.response.what_if import in_std_as_likely
from en4dvar.model.state import Array
from en4dvar.plumbing.hints import percent

ASSUMED = "the assumptions of the what-if table"
READINGS, MISSED, OWN = "the errors of the readings", "what the model misses", "its own prior"
TOLD = 0.03  # share from which a source is named


def shares_of_priors(covariance: Array, prior_variance: Array) -> Array:
    """(n, n): the share of parameter i's variance that comes from the prior of parameter j. ``covariance`` (n, n) of
    the posterior and ``prior_variance`` (n,), transformed; parameters independent before.
    """
    return np.asarray(covariance**2 / (prior_variance * np.diag(covariance)[:, None]))


def budget(a: Analysis, name: str) -> Mapping[str, float]:
    """Sources of the variance of a parameter, transformed, the largest first, and their shares; they sum to one. Empty
    where parameters were correlated before, or too few members are alive.
    """
    prior, alive = a.problem.prior, active_members(a.posterior_failures)
    if prior.blocks or alive.sum() <= len(prior.names):
        return {}
    i = prior.names.index(name)
    covariance = np.atleast_2d(np.cov(prior.from_physical(a.posterior[alive]).T))
    assumed = 0.0
    if a.settings.what_if == "added":  # s² (1 + t) is the variance with shifts whose squares sum to t
        in_std = in_std_as_likely(a.what_if)
        with_all = np.diag(covariance)
        moved = in_std * np.sqrt(with_all / (1 + np.sum(in_std**2, axis=0)))
        covariance = covariance - moved.T @ moved
        assumed = 1 - float(covariance[i, i] / with_all[i])
    of_priors = shares_of_priors(covariance, prior.std**2)[i]
    of_priors = of_priors * (1 - assumed) / max(1.0, of_priors.sum())  # rounding and sampling may exceed the whole
    shares = {OWN if j == i else other: float(of_priors[j]) for j, other in enumerate(prior.names)}
    rest, missed = 1.0 - assumed - float(of_priors.sum()), 0.0
    if a.discrepancy is not None:
        errors, discrepancy, _ = a.discrepancy.shares[i]
        missed = float(discrepancy / (errors + discrepancy)) if errors + discrepancy > 0 else 0.0
    shares |= {READINGS: rest * (1 - missed), MISSED: rest * missed, ASSUMED: assumed}
    return dict(sorted(shares.items(), key=lambda source: -source[1]))


def largest(shares: Mapping[str, float], members: int) -> list[str]:
    """The largest share, and those that ``members`` do not tell from it. A share is a squared correlation ρ², of
    standard error 2 |ρ| (1 − ρ²) / √N; two errors of a difference are doubt.
    """
    spread = {source: 2 * share**0.5 * (1 - share) / members**0.5 for source, share in shares.items()}
    first = next(iter(shares))
    return [s for s in shares if shares[first] - shares[s] <= 2 * np.hypot(spread[first], spread[s])]


def budget_words(a: Analysis, name: str) -> str:
    """The budget of a parameter in a line, and which number to know better first; "" where there is none."""
    sources = {source: share for source, share in budget(a, name).items() if share >= TOLD}
    if not sources:
        return ""
    line = f"variance of {name}: {', '.join(f'{percent(share)} {source}' for source, share in sources.items())}"
    first = largest(sources, int(active_members(a.posterior_failures).sum()))
    if any(source not in a.problem.prior.names for source in first):
        return line
    return f"{line}; first improve what is known of {' or '.join(first)}"
