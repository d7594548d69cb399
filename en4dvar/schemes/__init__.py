"""Assimilation schemes: what is computed, and the keys read. A new one is a class and a line below.

Another package brings schemes of its own by entry points of the group ``en4dvar.schemes``: a name for ``scheme:`` and a
subclass of :class:`Scheme`. One that cannot be loaded is left out, and told by :func:`require_usable` to who asks for
it; a name of ours is not replaced. They are loaded when a registry is first asked for: to write one such a package
imports from here.
"""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.user_code import loading
from en4dvar.schemes.base import Minimiser, Scheme
from en4dvar.schemes.bootstrap_filter import BootstrapFilter
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.filters import ESRF, ETKF, Climatology, DEnKF, EnKF, OptimalInterpolation
from en4dvar.schemes.ienks import IEnKS

DEFAULT = "en4dvar"
_OURS: dict[str, type[Scheme]] = {
    DEFAULT: En4DVar,
    "es-mda": ESMDA,
    "etkf": ETKF,
    "denkf": DEnKF,
    "enkf": EnKF,
    "esrf": ESRF,
    "enkf-n": EnKFN,
    "ienks": IEnKS,
    "particle-filter": BootstrapFilter,
    "optimal-interpolation": OptimalInterpolation,
    "climatology": Climatology,
}


_unusable: dict[str, str] = {}  # why a scheme of another package cannot be loaded


def _installed() -> dict[str, type[Scheme]]:
    kinds = {}
    for name in (entries := installed("en4dvar.schemes")).keys() - _OURS:
        what = f"scheme {name!r} ({entries[name].value}) cannot be loaded"
        try:
            with loading(what):
                kind = entries[name].load()
            require_scheme(kind, name)
        except (ConfigError, ValueError) as error:  # code of another package must not end every command
            _unusable[name] = str(error) if isinstance(error, ConfigError) else f"{what}: {error}"
        else:
            kinds[name] = kind
    return kinds


def require_scheme(kind: Any, name: str) -> None:
    """Raise :class:`ConfigError` where what a ``name`` leads to is no scheme."""
    if not (isinstance(kind, type) and issubclass(kind, Scheme)):
        raise ConfigError(f"{shown(name)} is not a subclass of en4dvar.schemes.Scheme")


def require_usable(name: str) -> None:
    """Raise :class:`ConfigError` where an installed scheme of this name cannot be loaded."""
    if name in _unusable:
        raise ConfigError(_unusable[name])


# name in a configuration → class; its fields are keys of the section ``assimilation:``
SCHEMES: dict[str, type[Scheme]]
ON_A_WINDOW: dict[str, type[Scheme]]
ON_A_SERIES: dict[str, type[Scheme]]
MINIMISERS: tuple[str, ...]
LOCALISED: tuple[str, ...]
_LATER = "SCHEMES", "ON_A_WINDOW", "ON_A_SERIES", "MINIMISERS", "LOCALISED"


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    every = _OURS | dict(sorted(_installed().items()))
    window, series = ({n: kind for n, kind in every.items() if on in kind.on} for on in ("window", "series"))
    minimisers = tuple(n for n, kind in window.items() if issubclass(kind, Minimiser))
    localised = tuple(n for n, kind in window.items() if kind.localised_keys is not None)
    globals().update(zip(_LATER, (every, window, series, minimisers, localised), strict=True))
    return globals()[name]


def keys_of(kind: type[Scheme], localised: bool = False) -> frozenset[str]:
    """The keys that a scheme reads, or that it reads where its gain is localised."""
    keys = frozenset(f.name for f in fields(kind))
    return keys & (kind.localised_keys or frozenset()) if localised else keys


def unread(
    name: str, kinds: Mapping[str, type[Scheme]], keys: Iterable[str], localised: bool = False
) -> dict[str, str]:
    """Those of ``keys`` that schemes of ``kinds`` have and the one of this ``name`` does not read, with a message each.

    ``localised``: where the gain of an ensemble is localised.
    """
    messages = {}
    for key in keys:
        if key in keys_of(kinds[name], localised) or not any(key in keys_of(kind) for kind in kinds.values()):
            continue
        readers = [other for other, kind in kinds.items() if key in keys_of(kind, localised)]
        who = f"; it is a key of {' and '.join(readers)}" if readers else ""
        messages[key] = f"scheme {name} does not read it{' beside a localisation' if localised else ''}{who}"
    return messages
