"""Who called: somebody who types commands, and can add an option, or a script, which can give an argument."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_TYPED = ContextVar("_TYPED", default=False)
ELSEWHERE = ("another --out", "another directory")
CONTINUED = ("'en4dvar run' with --resume", "the run with resume=True")


@contextmanager
def typed() -> Iterator[None]:
    """What is called in the block was typed as a command."""
    before = _TYPED.set(True)
    try:
        yield
    finally:
        _TYPED.reset(before)


def advised(option: str, argument: str = "") -> str:
    """What a message advises: of who typed a command an ``option``, of a script an ``argument`` in its place; unless
    told, that of the option's name.

    >>> advised("--force"), advised(*ELSEWHERE)
    ('force=True', 'another directory')
    """
    return option if _TYPED.get() else argument or f"{option.removeprefix('--')}=True"
