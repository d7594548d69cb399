"""What installed packages declare by entry points. Their files are read once a process, for each reading takes longer
than a configuration."""

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from en4dvar.plumbing.errors import ConfigError


class Contested(EntryPoint):
    """A name under which several packages declare different things, ``rivals``."""

    rivals: tuple[EntryPoint, ...]

    @classmethod
    def of(cls, rivals: tuple[EntryPoint, ...]) -> "Contested":
        """The entry point that stands for all of them."""
        contested = cls(rivals[0].name, rivals[0].value, rivals[0].group)
        vars(contested).update(rivals=rivals)  # its attributes cannot be set
        return contested

    def load(self) -> Any:
        """Raises :class:`ConfigError`, which names the packages."""
        who = " and ".join(f"{entry.dist.name if entry.dist else 'a package'} ({entry.value})" for entry in self.rivals)
        raise ConfigError(
            f"{self.name!r} is declared in {self.group} by {who}; uninstall all but one of them, "
            "or, where package:Class may be given, name the class"
        )


def installed(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in its order; nothing is imported, and no package takes the place of ours.
    A name of several other packages is :class:`Contested`.
    """
    named: dict[str, list[EntryPoint]] = {}
    for entry in sorted(set(_all().select(group=group)), key=lambda e: (not _is_ours(e), e)):
        rivals = named.setdefault(entry.name, [])
        if not (rivals and _is_ours(rivals[0])):
            rivals.append(entry)
    return {n: e[0] if len(e) == 1 else Contested.of(tuple(e)) for n, e in sorted(named.items())}


@cache
def _is_ours(entry: EntryPoint) -> bool:
    return bool(entry.dist and entry.dist.name == "en4dvar")


@cache
def _all() -> Any:
    return entry_points()
