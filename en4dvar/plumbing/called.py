"""Who called: somebody who types commands, can add an option and reads what is told, or a script with arguments."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_TELL = ContextVar[Callable[[str], None] | None]("_TELL", default=None)
ELSEWHERE = ("another --out", "another directory")
CONTINUED = ("'en4dvar run' with --resume", "the run with resume=True")


@contextmanager
def typed(tell: Callable[[str], None]) -> Iterator[None]:
    """What is called in the block was typed as a command, by whom ``tell`` reaches with a line."""
    before = _TELL.set(tell)
    try:
        yield
    finally:
        _TELL.reset(before)


def note(words: str) -> None:
    """Tell who typed a command; a script is told nothing."""
    if tell := _TELL.get():
        tell(f"note: {words}")


def advised(option: str, argument: str = "") -> str:
    """What a message advises: of who typed a command an ``option``, of a script an ``argument`` in its place; unless
    told, that of the option's name.

    >>> advised("--force"), advised(*ELSEWHERE)
    ('force=True', 'another directory')
    """
    return option if _TELL.get() else argument or f"{option.removeprefix('--')}=True"
