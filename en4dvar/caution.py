"""What a warning is: a stable code, a severity, what was found in plain words, and what to do about it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

Severity = Literal["serious", "caution", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)  # the worst first

# code → (severity, what to do). Codes are part of the result's format: they may be added, never renamed.
CATALOGUE: dict[str, tuple[Severity, str]] = {
    "not-converged": ("serious", "raise assimilation.max_iterations, or narrow the priors and start again"),
    "chain-not-converged": ("serious", "run again with more data or narrower priors; do not quote these intervals"),
    "ensemble-collapse": (
        "serious",
        "do not quote the intervals; use more members, scheme: en4dvar, or inflation in a sequential scheme",
    ),
    "rank-deficient": ("serious", "give more members than parameters (assimilation.members), or sampling: exact"),
    "misfit": ("serious", "look at the residuals: model, window or stated observation error must change"),
    "residual-structure": (
        "serious",
        "let the data tell what the model misses (data.error.discrepancy: estimated), choose another model, or a "
        "shorter window; a larger error or sigma would hide it and leave the estimates where they are",
    ),
    "prior-conflict": ("serious", "check units and data; if both are right, widen the prior and say so"),
    "implausible-data": (
        "serious",
        "check units, pixel size and frame rate: a fit can look perfect and tell a wrong value; if they are right, "
        "say what you know in the prior",
    ),
    "model-validity": (
        "serious",
        "end the window before the model leaves its validity, or choose a model that is valid there",
    ),
    "members-lost": (
        "caution",
        "the posterior holds only where the model runs: narrow the prior there, or find out why the model fails",
    ),
    "at-bound": ("caution", "widen the bound if physics allows it; else quote a limit, not mean ± std"),
    "non-gaussian": ("caution", "set assimilation.refine: mcmc, which samples the posterior as it is"),
    "several-modes": (
        "caution",
        "look at the members, not at mean ± std; data or prior knowledge that tell the modes apart are worth most",
    ),
    "starts-disagree": (
        "caution",
        "raise assimilation.starts, or narrow the priors: a lower minimum may not have been found",
    ),
    "overstated-error": ("caution", "state the observation error as it is (or estimate sigma); intervals are too wide"),
    "odd-residuals": (
        "caution",
        "look at the figure of the residuals and at these readings before quoting the intervals",
    ),
    "start-moved": ("note", "no action is needed where the iterations converged"),
    "down-weighted": ("note", "look at these observations; they count less than the others"),
    "not-informed": ("note", "do not quote it as measured: fix it, or add data that depend on it"),
}
_LINE = re.compile(r"(serious|caution|note) \[([a-z-]+)\] (.*?)(?: — ([^—]*))?")


@dataclass(frozen=True)
class Caution:
    """One warning. ``severity``: *serious* (do not trust the posterior before this is settled), *caution* (read it
    with care), *note* (worth knowing). ``words`` say what was found, ``advice`` what to do.
    """

    code: str
    severity: str
    words: str
    advice: str

    def __str__(self) -> str:
        return f"{self.words}; {self.advice} [{self.code}]" if self.advice else f"{self.words} [{self.code}]"

    @property
    def kind(self) -> str:
        """What a terminal calls it: ``note``, or ``warning``."""
        return "note" if self.severity == "note" else "warning"

    @property
    def line(self) -> str:
        """One line of text that :meth:`parse` reads, the form kept in netCDF."""
        words = " ".join(self.words.split())
        return f"{self.severity} [{self.code}] {words} — {self.advice}"

    @classmethod
    def parse(cls, line: str) -> Caution:
        """The inverse of :attr:`line`; a line of another form is kept as words of code ``other``."""
        match = _LINE.fullmatch(line)
        if match is None:
            return cls("other", "caution", line, "")
        return cls(match[2], match[1], match[3], match[4] or "")


def caution(code: str, words: str, severity: Severity | None = None) -> Caution:
    """A warning of the catalogue; ``severity`` replaces the catalogue's where the finding is graver or milder.

    Raises
    ------
    KeyError: the code is not in :data:`CATALOGUE`.
    """
    usual, advice = CATALOGUE[code]
    return Caution(code, severity or usual, words, advice)


def worst_first(cautions: tuple[Caution, ...]) -> tuple[Caution, ...]:
    """Sorted by severity, otherwise in the order given."""
    order: dict[str, int] = {severity: i for i, severity in enumerate(SEVERITIES)}
    return tuple(sorted(cautions, key=lambda c: order.get(c.severity, len(order))))


def codes(cautions: Iterable[Caution]) -> tuple[str, ...]:
    """The codes, each once."""
    return tuple(dict.fromkeys(c.code for c in cautions))
