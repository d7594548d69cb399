"""Sequential assimilation of a long series, and the twin experiments that judge it.

The readings of one observable, which 1.0 had under this name, are in :mod:`en4dvar.data.series`.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    from en4dvar.plumbing.moved import former_name

    return former_name(__name__, name)
