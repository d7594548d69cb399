"""Warnings: a stable code, a severity, the finding in plain words, and advice."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Severity = Literal["serious", "caution", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)  # the worst first

# code → (severity, what to do), those of a severity by what they do to the numbers, the worst first. Codes are part of
# the result's format: they may be added, never renamed.
CATALOGUE: dict[str, tuple[Severity, str]] = {
    "not-converged": ("serious", "raise assimilation.max_iterations, or narrow the priors and start again"),
    "chain-not-converged": ("serious", "run again with more data or narrower priors; do not quote these intervals"),
    "prior-conflict": ("serious", "check units and data; if both are right, widen the prior and say so"),
    "implausible-data": (
        "serious",
        "check units, pixel size and frame rate: a fit can look perfect and tell a wrong value; if they are right, "
        "say what you know in the prior",
    ),
    "misfit": ("serious", "look at the residuals: model, window or stated observation error must change"),
    "data-sets-differ": (
        "serious",
        "ask how much they vary and not for one value (en4dvar population), or state errors as large as they are",
    ),
    "residual-structure": (
        "serious",
        "let the data tell what the model misses (data.error.discrepancy: estimated), choose another model, or a "
        "shorter window; a larger error or sigma would hide it and leave the estimates where they are",
    ),
    "model-validity": (
        "serious",
        "end the window before the model leaves its validity, or choose a model that is valid there",
    ),
    "ensemble-collapse": (
        "serious",
        "do not quote the intervals; use more members, a scheme that minimises J, or inflation in a sequential scheme",
    ),
    "rank-deficient": ("serious", "give more members than parameters (assimilation.members), or sampling: exact"),
    "non-gaussian": ("caution", "set assimilation.refine: mcmc, which samples the posterior as it is"),
    "several-modes": (
        "caution",
        "look at the members, not at mean ± std; data or prior knowledge that tell the modes apart are worth most",
    ),
    "starts-disagree": (
        "caution",
        "raise assimilation.starts, or narrow the priors: a lower minimum may not have been found",
    ),
    "members-lost": (
        "caution",
        "the posterior holds only where the model runs: narrow the prior there, or find out why the model fails",
    ),
    "readings-missing": (
        "caution",
        "the posterior holds where readings are missing whatever their value, and are nearly linear in the parameters "
        "among the members; else find out why the model does not give them",
    ),
    "at-bound": ("caution", "widen the bound if physics allows it; else quote a limit, not mean ± std"),
    "missed-knots": (
        "caution",
        "put the knots there, or several about each event: a change within a piece shifts the values beside it",
    ),
    "odd-data-set": (
        "caution",
        "look at its data, scale and frame rate and at its residuals; say in every quotation that it is left out",
    ),
    "trend": (
        "caution",
        "look for a wrong scale, a wall, a drift or a term that the law lacks; what all data sets have alike no number "
        "of them averages out",
    ),
    "odd-residuals": (
        "caution",
        "look at the figure of the residuals and at these readings before quoting the intervals",
    ),
    "discrepancy-found": (
        "caution",
        "before quoting a value look at the what-if table and compare other models (en4dvar compare); only a model "
        "that has what is missing removes this",
    ),
    "not-bayesian": (
        "caution",
        "say in every quotation how readings were weighted; for the Bayesian posterior state the errors as they are "
        "and leave the weights out (assimilation.weights: sum)",
    ),
    "overstated-error": ("caution", "state the observation error as it is (or estimate sigma); intervals are too wide"),
    "not-informed": ("note", "do not quote it as measured: fix it, or add data that depend on it"),
    "down-weighted": (
        "note",
        "no action is needed: these readings count less than the others; look at them before quoting a value",
    ),
    "one-descent": (
        "note",
        "set assimilation.starts: 2 or more, with linearisation: bundle and more members than parameters; or compare "
        "with another seed",
    ),
    "start-moved": ("note", "no action is needed where the iterations converged"),
}
TRIGGERS = {
    "not-converged": (
        "the iterations stopped before their criterion was met, and the next step would have been longer than 0.1 "
        "posterior standard deviations; a note up to 0.5, or if members were drawn from the posterior afterwards"
    ),
    "chain-not-converged": "the Markov chains disagree, or have too few independent samples",
    "prior-conflict": "the minimum of J lies further from the prior mean than one prior in two thousand would",
    "implausible-data": (
        "times, radii or frames contradict each other or the physics, e.g. a collapse faster than any gel allows; a "
        "caution if a gel stiffer or thicker than usual explains it"
    ),
    "misfit": (
        "χ² is larger than the errors explain, except once in two thousand times; K − DFS is expected for K readings"
    ),
    "data-sets-differ": (
        "the values that data sets give for what they share differ by more than their errors explain, except once in a "
        "thousand times"
    ),
    "residual-structure": (
        "neighbouring residuals resemble each other, as they would once in a thousand times by chance; a caution "
        "if that cannot move any estimate by its standard deviation, or a discrepancy is estimated beside them"
    ),
    "model-validity": (
        "more than a tenth of the posterior members leave the range in which the equations hold; a note if the "
        "readings from then on contribute at most 0.1 DFS, a caution if a discrepancy is estimated"
    ),
    "ensemble-collapse": "the spread of the members is below a third of what J allows, or zero in a parameter",
    "rank-deficient": (
        "the prior members differ in fewer directions than there are parameters, or too few members are left"
    ),
    "non-gaussian": (
        "mean or spread of the members differ from those that an emulator of the model finds for the posterior, by "
        "more than 0.5 standard deviations or 30 %; serious beyond one standard deviation or a factor of two; without "
        "an emulator, the members' own J do not look like those of a Gaussian"
    ),
    "several-modes": (
        "J has several minima that hold some of the probability; serious if they were not sampled, a note if they were "
        "and overlap in every parameter"
    ),
    "starts-disagree": (
        "only one of several descents ended in the lowest minimum and the posterior was not sampled, or a draw of the "
        "posterior has a J lower than any minimum found"
    ),
    "members-lost": "members failed in a forecast; serious if more than a tenth did",
    "readings-missing": "the model gives NaN for some readings of some members of the posterior forecast",
    "at-bound": (
        "at least a fifth of the posterior members lie within 5 % of the interval's width from a bound, and more than "
        "three times the prior's share"
    ),
    "missed-knots": (
        "the evidence speaks (ratio above 20) for all knots earlier, or later, by twice the time between readings; not "
        "looked for with what_if: false"
    ),
    "odd-data-set": (
        "the data raise the odds that a data set is not of its population by more than a quarter of the number of data "
        "sets, and at least fivefold, or it could not be sampled; in a joint estimate, where it is serious, one "
        "disagrees with all others as once in a hundred campaigns by chance"
    ),
    "trend": (
        "values of single data sets rise or fall with their order, largest reading or frame rate, as once in a hundred "
        "campaigns by chance"
    ),
    "odd-residuals": (
        "residuals are larger where the observable changes fast, or one is an outlier; by chance this would happen "
        "once in a thousand times"
    ),
    "discrepancy-found": (
        "95 % of the members have a discrepancy (discrepancy: estimated) of more than a quarter of the readings' error"
    ),
    "not-bayesian": "readings count with weights other than 0 and 1",
    "overstated-error": "χ² is smaller than the errors explain, except once in two thousand times",
    "not-informed": "a parameter's DFS is below 0.1 and its mean within 0.3 prior standard deviations of the prior's; "
    "of a model that names the parameters of its path, these alone are asked",
    "down-weighted": "readings lie beyond the threshold of a robust cost",
    "one-descent": "only one descent was made, so that another minimum is not excluded",
    "start-moved": "the prior mean could not be used as the start of the iterations",
}
"""When each is given, for the reference."""
SPOILS = {"non-gaussian", "at-bound"}  # mean ± std, though they are not serious; what is serious does in any case
_LINE = re.compile(r"(serious|caution|note) \[([a-z-]+)(?:: ([\w ]+))?\] (.*?)(?: — ([^—]*))?")


@dataclass(frozen=True)
class Caution:
    """One warning. ``severity``: *serious* (do not trust the posterior before this is settled), *caution* (read it
    with care), *note* (worth knowing). ``words`` say what was found, ``advice`` what to do. ``parameters`` are the
    names of those it is about, () for all of them.
    """

    code: str
    severity: str
    words: str
    advice: str
    parameters: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.words}; {self.advice} [{self.code}]" if self.advice else f"{self.words} [{self.code}]"

    @property
    def kind(self) -> str:
        """The word for it on a terminal: ``note``, or ``warning``."""
        return "note" if self.severity == "note" else "warning"

    @property
    def line(self) -> str:
        """One line of text that :meth:`parse` reads, the form kept in netCDF."""
        about = f": {' '.join(self.parameters)}" if self.parameters else ""
        return f"{self.severity} [{self.code}{about}] {' '.join(self.words.split())} — {self.advice}"

    @classmethod
    def parse(cls, line: str) -> Caution:
        """The inverse of :attr:`line`; a line of another form is kept as words of code ``other``."""
        match = _LINE.fullmatch(line)
        if match is None:
            return cls("other", "caution", line, "")
        return cls(match[2], match[1], match[4], match[5] or "", tuple((match[3] or "").split()))

    @property
    def spoils(self) -> bool:
        """True if mean ± std of what it is about are not to be quoted."""
        return self.severity == "serious" or (self.severity == "caution" and self.code in SPOILS)

    @property
    def rank(self) -> int:
        """Place among all warnings by what they do to the numbers; the worst has the lowest."""
        known, severities = list(CATALOGUE), list(SEVERITIES)
        severity = severities.index(self.severity) if self.severity in severities else len(severities)
        return severity * (len(known) + 1) + (known.index(self.code) if self.code in known else len(known))


def caution(code: str, words: str, severity: Severity | None = None, parameters: tuple[str, ...] = ()) -> Caution:
    """A warning of the catalogue; ``severity`` replaces the catalogue's where the finding is graver or milder.

    Raises
    ------
    KeyError: the code is not in :data:`CATALOGUE`.
    """
    usual, advice = CATALOGUE[code]
    return Caution(code, severity or usual, words, advice, parameters)


def worst_first(cautions: Iterable[Caution]) -> tuple[Caution, ...]:
    """By :attr:`Caution.rank`, otherwise in the order given: the order of every output."""
    return tuple(sorted(cautions, key=lambda c: c.rank))


def gravity(cautions: Sequence[Caution]) -> float:
    """Sorts data sets by their warnings: 0 without any; the worst of them counts most, then how many there are."""
    lowest = len(SEVERITIES) * (len(CATALOGUE) + 1) + 1
    return lowest - min(c.rank for c in cautions) + min(0.99, 0.01 * len(cautions)) if cautions else 0.0


def codes(cautions: Iterable[Caution]) -> tuple[str, ...]:
    """The codes, each once."""
    return tuple(dict.fromkeys(c.code for c in cautions))


def of_several_modes(cautions: Iterable[Caution], parameter: str) -> bool:
    """True if members of a parameter are drawn from modes apart: mean ± std describe none, quantiles all of them.

    Where members were drawn from one mode alone the warning is serious, and nothing of them is to be quoted.
    """
    return any(c.code == "several-modes" and not c.spoils and parameter in c.parameters for c in cautions)


def untrusted(cautions: Iterable[Caution], parameter: str) -> tuple[str, ...]:
    """Codes of the warnings for which no interval of a parameter is to be quoted, the worst first; () where one is.

    The one place that decides it: page, tables, CSV and LaTeX follow.
    """
    of_it = (c for c in worst_first(cautions) if c.spoils and (not c.parameters or parameter in c.parameters))
    return codes(of_it)
