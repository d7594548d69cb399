"""Sequential assimilation of a long series, and the twin experiments that judge it.

The readings of one observable, which 1.0 had under this name, are in :mod:`en4dvar.data.series`.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    from en4dvar.plumbing.moved import warn

    if name in ("Places", "Part", "Series", "balanced"):
        from en4dvar.data import series

        warn(f"en4dvar.series.{name}", f"en4dvar.data.series.{name}", 2)
        return getattr(series, name)
    raise AttributeError(f"module 'en4dvar.series' has no attribute {name!r}")
