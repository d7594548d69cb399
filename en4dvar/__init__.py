"""En4D-Var: ensemble data assimilation for models that you can run but not differentiate.

    import en4dvar
    result = en4dvar.estimate(model, data, priors, error=0.1)  # a function and arrays
    result = en4dvar.run("configs/quickstart.yaml")  # or a file
    print(result)

Names are imported when first used, so that ``import en4dvar`` stays light.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from en4dvar.plumbing import moved

_NAMES = re.compile(r"^from (\S+) import (\w+) as", re.MULTILINE)  # as editors and type checkers are told
_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_MODULE = {name: module for module, name in _NAMES.findall(_STUB)}
__all__ = sorted(_MODULE)

moved.install()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("en4dvar")
    if name not in _MODULE:
        raise AttributeError(f"module 'en4dvar' has no attribute {name!r}")
    value = getattr(import_module(_MODULE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
