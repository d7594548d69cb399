"""What was probably meant: suggestions for misspelt names and missing files."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from reprlib import Repr

_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 80, 80
LONGEST = 2000  # characters of one message


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


def suggest(word: object, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"``, or else the list of what is known, or nothing."""
    names = list(known)
    close = get_close_matches(str(word), names, 1, 0.6) if len(str(word)) < LONGEST else []  # quadratic in the length
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(names)}" if names else ""


def short(text: str, most: int = 60) -> str:
    """A name or value as a message can quote it."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def listed(names: Iterable[str], most: int = 30) -> str:
    """Names with commas between; of many the first, and how many more there are."""
    known = [short(name) for name in names]
    more = f" and {len(known) - most} more" if len(known) > most else ""
    return f"{', '.join(known[:most])}{more}"


def no_such_file(path: Path) -> str:
    """``"<path>: no such file"`` and what lies beside it: similar names, else files of the same kind."""
    try:
        beside = sorted(p.name for p in path.parent.iterdir() if p.is_file())
    except OSError:
        return brief(f"{path}: no such file; the folder {path.parent} cannot be read")
    close = get_close_matches(path.name, beside, 3, 0.6) or [b for b in beside if Path(b).suffix == path.suffix][:5]
    if not close:
        return brief(f"{path}: no such file")
    return f"{path}: no such file; the folder holds {', '.join(close)}"
