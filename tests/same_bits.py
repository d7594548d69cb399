"""Equality of analyses to the last bit."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from en4dvar.results.netcdf import Group


def assert_same_bits(a: Any, b: Any) -> None:
    """Every field of two analyses (or records) agrees exactly; NaN equals NaN."""
    for field in fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            assert np.array_equal(left, right, equal_nan=True), field.name
        elif is_dataclass(left) and field.name == "ledger":
            assert_same_bits(left, right)
        elif field.name in ("iterations", "what_if", "modes"):
            assert len(left) == len(right)
            for x, y in zip(left, right, strict=True):
                assert_same_bits(x, y)
        elif is_dataclass(left) and field.name in ("residuals", "discrepancy", "influence", "withheld"):
            assert_same_bits(left, right)
        elif field.name in ("shape", "log_evidence"):
            assert repr(left) == repr(right)  # numbers that are not known are NaN
        elif field.name not in ("problem", "observations", "observable"):
            assert left == right, field.name


def assert_same_groups(a: Mapping[str, Group], b: Mapping[str, Group], path: str) -> None:
    """The variables of one group of two result files agree exactly; NaN equals NaN."""
    assert a[path].variables.keys() == b[path].variables.keys()
    for name, variable in a[path].variables.items():
        np.testing.assert_array_equal(variable.values, b[path][name].values, name)
