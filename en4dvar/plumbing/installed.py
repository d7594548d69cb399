"""What installed packages declare by entry points. Their files are read once a process, for each reading takes longer
than a configuration."""

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def installed(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in its order; nothing is imported."""
    return {entry.name: entry for entry in sorted(_all().select(group=group))}


@cache
def _all() -> Any:
    return entry_points()
