"""Members lost in a forecast: how many, why, and where in the space of the parameters they lay."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from en4dvar.diagnosis.diagnostics import active_members, common_reasons
from en4dvar.diagnosis.honesty.checks import shown
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.units import convert
from en4dvar.priors.prior import Prior

MANY = 0.1  # share of members whose loss is serious
SEPARATED = 3.0  # standard deviations of the rank sum beyond which a parameter tells lost members from others
FAR = 1.5  # prior standard deviations from the prior mean that are worth naming for one or two members
MOST_NAMED = 3
Mask = npt.NDArray[np.bool_]


def loss(stage: str, failures: Sequence[str], prior: Prior, members: Array | None = None) -> Iterator[Caution]:
    """The members (N,) that failed in a forecast; ``failures`` are reasons, "" for members alive.

    ``members`` (N, n), transformed, are where they were run, if that tells anything.
    """
    lost = ~active_members(failures)
    if not lost.any():
        return
    words = f"{lost.sum()} of {len(lost)} members failed in the {stage}: {common_reasons(failures)}"
    if members is not None:
        words = f"{words}; {where_lost(prior, members, lost)}"
    yield caution("members-lost", words, "serious" if lost.mean() > MANY else None)


def where_lost(prior: Prior, members: Array, lost: Mask) -> str:
    """Where the lost members lie, in words and display units: the parameters that tell them from the others.

    A parameter is named where the rank sum of the lost members (Mann & Whitney 1947, Ann. Math. Stat. 18, 50) is
    :data:`SEPARATED` standard deviations from its expectation; one or two members are described one by one.
    """
    n_lost, n_alive = int(lost.sum()), int((~lost).sum())
    if n_lost < 3 or n_alive < 3:
        return _one_by_one(prior, members[lost]) if n_lost < 3 else "no parameter tells them from the few others"
    sides: list[tuple[float, str]] = []
    for j in range(members.shape[1]):
        values = members[:, j]
        score = _rank_score(values, lost)
        if abs(score) < SEPARATED:
            continue
        mirrored = values if score > 0 else -values
        edge, rest = float(np.min(mirrored[lost])), mirrored[~lost]
        if edge <= float(rest.max()):  # not all on one side: most of the lost lie beyond this quantile
            edge = float(np.quantile(mirrored[lost], 0.1))
        beyond = int(np.sum(rest > edge))
        others = f"as {beyond} of" if beyond else "none of"
        side, at = ("above", edge) if score > 0 else ("below", -edge)
        sides.append((abs(score), f"{prior.names[j]} {side} {_shown(prior, j, at)} ({others} the {n_alive} others)"))
    if not sides:
        return "they are spread over the whole ensemble"
    named = [text for _, text in sorted(sides, key=lambda side: -side[0])[:MOST_NAMED]]
    return f"lost members have {', '.join(named)}"


def _one_by_one(prior: Prior, members: Array) -> str:
    described = []
    for row in members:
        z = (row - prior.mean) / prior.std
        far = [j for j in np.argsort(-np.abs(z)) if abs(z[j]) > FAR][:MOST_NAMED]
        places = ", ".join(f"{prior.names[j]} = {_shown(prior, j, row[j])} ({z[j]:+.1f} prior std)" for j in far)
        described.append(f"at {places}" if places else "near the centre of the prior")
    return f"lost {' and '.join(dict.fromkeys(described))}"


def _rank_score(values: Array, lost: Mask) -> float:
    """Standardised rank sum of the lost members: positive where their values are large."""
    ranks = np.empty(len(values))
    ranks[np.argsort(values, kind="stable")] = np.arange(1, len(values) + 1)
    n, m = int(lost.sum()), int((~lost).sum())
    expected, variance = n * (n + m + 1) / 2, n * m * (n + m + 1) / 12
    return float((ranks[lost].sum() - expected) / math.sqrt(variance))


def _shown(prior: Prior, j: int, x: float) -> str:
    """A transformed value as physical, in its display unit."""
    p = prior.parameters[j]
    return shown(convert(float(prior.terms[j].to_physical(np.asarray(x))), p.unit, p.display_unit), p)
