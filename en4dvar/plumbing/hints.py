"""Suggestions for misspelt names and missing files."""

import functools
import itertools
import math
import re
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path
from reprlib import Repr

_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 80, 80
LONGEST = 2000  # characters of one message
FEW = 8  # names that are suggested at most


def shown(value: object) -> str:
    """``value`` as Python writes it, on one line and short however long it is."""
    return _SHORT.repr(value)


def brief(text: str, longest: int = LONGEST) -> str:
    """``text``, its middle left out where it is long.

    >>> brief("a" * 50 + "z" * 50, longest=20)
    'aaaaaaaaaa … (80 characters) … zzzzzzzzzz'
    """
    half = longest // 2
    return text if len(text) <= longest else f"{text[:half]} … ({len(text) - 2 * half} characters) … {text[-half:]}"


def suggest(word: object, known: Iterable[str] | Mapping[str, object]) -> str:
    """``"; did you mean 'x'?"``, or else the list of what is known, or nothing.

    ``known``: the names, or each with what it means in words. A part of a name counts before a misspelt name.

    >>> suggest("neohookean", ["zener-neo-hookean", "neo-hookean-kelvin-voigt"])
    "; did you mean 'neo-hookean-kelvin-voigt'?"
    >>> suggest("viscosity", {"G": "shear modulus", "mu": "viscosity"}), suggest("mue", {"G": "", "mu": ""})
    ("; did you mean 'mu'?", "; did you mean 'mu'?")
    """
    names, text = list(known), str(word)
    words = known if isinstance(known, Mapping) else {}
    meant = _meant(_letters(text), {n: w if isinstance(w := words.get(n), str) else "" for n in names})
    close = get_close_matches(text, names, 1, 0.6) if len(text) < LONGEST else []  # quadratic in the length
    if nearest := meant or close:
        return f"; did you mean {' or '.join(map(repr, nearest))}?"
    return f"; known: {', '.join(names)}" if names else ""


def counted(number: float, thing: str) -> str:
    """How many of a thing there are.

    >>> counted(1, "data set"), counted(0, "iteration"), counted(12.0, "reading")
    ('1 data set', '0 iterations', '12 readings')
    """
    return f"{number:.0f} {thing}{'s' * (round(number) != 1)}"


def rounded(*counts: float) -> str:
    """Counts to two digits, from the least to the most.

    >>> rounded(2600), rounded(83140, 1923000), rounded(2601, 2602)
    ('2600', '83000 to 1900000', '2600')
    """
    return " to ".join(dict.fromkeys(f"{float(f'{count:.2g}'):.0f}" for count in counts))


def duration(seconds: float) -> str:
    """A time as people say it, to two digits.

    >>> duration(0.05), duration(150), duration(7e5)
    ('50 ms', '2.5 min', '190 h')
    """
    sizes = (1e-3, "us", 1e-6), (1.0, "ms", 1e-3), (120.0, "s", 1.0), (7200.0, "min", 60.0)
    unit, size = next(((unit, size) for limit, unit, size in sizes if seconds < limit), ("h", 3600.0))
    return f"{float(f'{seconds / size:.2g}'):g} {unit}"


def percent(share: float) -> str:
    """``0.123`` → ``"12 %"``, ``-0.001`` → ``"0 %"``; an en dash for NaN."""
    return f"{100 * share:z.0f} %".replace("-", "−") if math.isfinite(share) else "–"


def _meant(letters: str, known: Mapping[str, str]) -> list[str]:
    """The few names that begin with ``letters``, else those that hold them, else those whose meaning does."""
    if not 2 < len(letters) < LONGEST:
        return []
    begin = [name for name in known if _letters(name).startswith(letters)]
    within = [name for name in known if letters in _letters(name)]
    of_meaning = [name for name, words in known.items() if letters in _letters(words)]
    matches = begin or within or of_meaning
    return matches if len(matches) <= FEW else []


def _letters(text: str) -> str:
    return "".join(filter(str.isalnum, text.lower()))


def natural(path: Path) -> tuple[list[list[str | int]], Path]:
    """Key to sort files by: as :func:`numbered`, part by part, whatever their suffixes."""
    return [numbered(part) for part in path.with_suffix("").parts], path


@functools.lru_cache(maxsize=1024)  # the folders of many files are the same
def numbered(name: str) -> list[str | int]:
    """Key to sort by: numbers in a name by their size, so that ``bubble10`` comes after ``bubble2``.

    >>> sorted(["bubble10", "bubble2"], key=numbered)
    ['bubble2', 'bubble10']
    """
    return [int(s) if i % 2 else s for i, s in enumerate(re.split(r"([0-9]{1,40})", name))]


def free_name(name: str, others: Collection[str]) -> str:
    """The name, with a number behind it where one of ``others`` is the same.

    >>> free_name("gel", []), free_name("gel", ["gel", "gel_2"])
    ('gel', 'gel_3')
    """
    same = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    return next(it for it in same if it not in others)


def nearest(name: str, others: Collection[str]) -> str:
    """The same name, else the one before it in the order of :func:`numbered`, else the first.

    >>> nearest("bubble12", ["bubble2", "bubble10", "bubble30"])
    'bubble10'
    """
    return max((n for n in others if numbered(n) <= numbered(name)), key=numbered, default=min(others, key=numbered))


def matches(name: str, pattern: str) -> bool:
    """Whether a pattern, as a shell has it, stands for a name; brackets and ``?`` may stand for themselves.

    >>> matches("R_1 [um]", "R_* [um]"), matches("a_1", "[ab]_?"), matches("a_1", "b_*")
    (True, True, False)
    """
    literal = pattern.replace("[", "[[]").replace("?", "[?]")
    return fnmatchcase(name, pattern) or fnmatchcase(name, literal)


def short(text: str, most: int = 60) -> str:
    """A name or value as a message can quote it."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def listed(names: Iterable[str], most: int = 30, longest: int = 60) -> str:
    """Names with commas between; of many the first, and how many more there are."""
    known = [short(name, longest) for name in names]
    more = f" and {len(known) - most} more" if len(known) > most else ""
    return f"{', '.join(known[:most])}{more}"


def beside(path: Path) -> str:
    """``"no such file"`` and what lies in its place: similar names, else files of the same kind."""
    try:
        names = sorted(p.name for p in path.parent.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError:
        return brief(f"no such file; the folder {path.parent} cannot be read")
    close = get_close_matches(path.name, names, 3, 0.6) or [b for b in names if Path(b).suffix == path.suffix][:5]
    return f"no such file; the folder holds {', '.join(close)}" if close else "no such file"
