"""A positive parameter that readings limit only from above is said to have an upper limit."""

from __future__ import annotations

import re

import numpy as np
import pytest
from diagnosis.provoked import near_zero, run

from en4dvar.diagnosis.analysis import Analysis

STD = 0.1


def told(a: Analysis) -> tuple[float, float] | None:
    """The ratio of the evidences and the limit that the warning names; None without a warning."""
    found = [c for c in a.cautions if c.code == "upper-limit"]
    if not found:
        return None
    (one,) = found
    assert one.parameters == ("a",)
    words = re.search(r"evidence ratio ([\d.e+-]+)\).* below ([\d.e+-]+) m with", one.words)
    assert words
    return float(words[1]), float(words[2])


def ratio(read: float, log_std: float = 2.0) -> tuple[float, float]:
    """p(y | a = 0)/p(y) and the 95 % point of a, by quadrature over ln a."""
    x = np.linspace(-8, 8, 20001) * log_std
    density = np.exp(-0.5 * (x / log_std) ** 2) * np.exp(-0.5 * ((read - np.exp(x)) / STD) ** 2)
    share = np.cumsum(density) / density.sum()
    prior = np.exp(-0.5 * (x / log_std) ** 2).sum()
    return float(np.exp(-0.5 * (read / STD) ** 2) * prior / density.sum()), float(
        np.exp(x[np.searchsorted(share, 0.95)])
    )


@pytest.mark.parametrize("read", [0.0, 0.05, 0.1])
def test_ratio_and_limit_are_those_of_quadrature(read):
    found, (exact, most) = told(run(near_zero(read, STD), refine="mcmc", members=96)), ratio(read)
    assert exact > 1
    assert found
    np.testing.assert_allclose(found, (exact, most), rtol=0.35)


@pytest.mark.parametrize(
    ("read", "std", "log_std"),
    [(0.25, STD, 2.0), (0.5, STD, 2.0), (1.0, STD, 2.0), (0.02, 0.004, 2.0), (0.004, 0.0004, 2.0), (1.0, 1.0, 0.3)],
    ids=[
        "two and a half standard deviations",
        "five",
        "ten",
        "small and known",
        "far below the prior and known",
        "a narrow prior",
    ],
)
def test_silent_where_the_value_is_known_or_its_prior_ends_far_from_zero(read, std, log_std):
    assert told(run(near_zero(read, std, log_std), refine="mcmc")) is None
