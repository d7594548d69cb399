"""What installed packages declare by entry points. Their files are read once a process, for each reading takes longer
than a configuration."""

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def installed(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in its order; nothing is imported, and no package takes the place of ours."""
    ours_last = sorted(_all().select(group=group), key=lambda e: (_is_ours(e), e))
    return dict(sorted({entry.name: entry for entry in ours_last}.items()))


@cache
def _is_ours(entry: EntryPoint) -> bool:
    return bool(entry.dist and entry.dist.name == "en4dvar")


@cache
def _all() -> Any:
    return entry_points()
