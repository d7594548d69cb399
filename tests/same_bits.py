"""Equality of analyses to the last bit."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


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
