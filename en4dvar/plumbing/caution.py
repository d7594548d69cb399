"""Warnings: a stable code, a severity, the finding in plain words, and advice."""

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Severity = Literal["serious", "caution", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)  # the worst first

_SAID = tomllib.loads(Path(__file__).with_name("cautions.toml").read_text(encoding="utf-8"))
CATALOGUE: dict[str, tuple[Severity, str]] = {code: (of["severity"], of["advice"]) for code, of in _SAID.items()}
"""Code → severity and what to do, those of a severity by what they do to the numbers, the worst first."""
ABOUT = {code: of["about"] for code, of in _SAID.items()}
"""What each is about in a few words, where there is no place for its finding."""
TRIGGERS = {code: of["trigger"] for code, of in _SAID.items()}
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
    def name(self) -> str:
        """Its code and what it is about, of several data sets."""
        return f"{self.code} ({ABOUT[self.code]})" if self.code in ABOUT else self.code

    @property
    def line(self) -> str:
        """One line of text that :meth:`parse` reads, the form kept in netCDF."""
        about = f": {' '.join(self.parameters)}" if self.parameters else ""
        return f"{self.severity} [{self.code}{about}] {' '.join(self.words.split())} — {self.advice}"

    @classmethod
    def parse(cls, line: str) -> "Caution":
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
    """A warning of the catalogue; ``severity`` replaces the catalogue's where the finding is graver or milder. Raises
    KeyError: the code is not in :data:`CATALOGUE`.
    """
    usual, advice = CATALOGUE[code]
    return Caution(code, severity or usual, words, advice, parameters)


def worst_first(cautions: Iterable[Caution]) -> tuple[Caution, ...]:
    """By :attr:`Caution.rank`, otherwise in the order given: the order of every output."""
    return tuple(sorted(cautions, key=lambda c: c.rank))


def parsed(lines: object) -> tuple[Caution, ...]:
    """The warnings that a file holds, one a line, the worst first."""
    return worst_first(map(Caution.parse, str(lines).splitlines()))


def gravity(cautions: Sequence[Caution]) -> float:
    """Sorts data sets by their warnings: 0 without any; the worst of them counts most, then how many there are."""
    lowest = len(SEVERITIES) * (len(CATALOGUE) + 1) + 1
    return lowest - min(c.rank for c in cautions) + min(0.99, 0.01 * len(cautions)) if cautions else 0.0


def codes(cautions: Iterable[Caution]) -> tuple[str, ...]:
    """The codes, each once."""
    return tuple(dict.fromkeys(c.code for c in cautions))


def of_several_modes(cautions: Iterable[Caution], parameter: str) -> bool:
    """True if members of a parameter are drawn from modes apart: mean ± std describe none, quantiles all of them. Where
    members were drawn from one mode alone the warning is serious, and nothing of them is to be quoted.
    """
    return any(c.code == "several-modes" and not c.spoils and parameter in c.parameters for c in cautions)


def untrusted(cautions: Iterable[Caution], parameter: str) -> tuple[str, ...]:
    """Codes of the warnings for which no interval of a parameter is to be quoted, the worst first; () where one is. The
    one place that decides it: page, tables, CSV and LaTeX follow.
    """
    of_it = (c for c in worst_first(cautions) if c.spoils and (not c.parameters or parameter in c.parameters))
    return codes(of_it)
