"""The syntax of source files, for tests of what these contain: read once in a process."""

from __future__ import annotations

import ast
import gc
from functools import cache


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    """All of a file's syntax, the module first. Garbage is not looked for meanwhile: that took half of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        return tuple(ast.walk(ast.parse(source)))
    finally:
        if collecting:
            gc.enable()
