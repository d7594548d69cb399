"""Square tables without header: covariances and correlations."""

from pathlib import Path

import numpy as np

from en4dvar.inputs.asked import Layout, Matrix, opened
from en4dvar.inputs.text_table import cells_of, delimiter_of, number_in, numbered_lines
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.units import convert


def read_covariance(matrix: Matrix) -> Array:
    """The covariance (K, K) of a CSV file: symmetric, positive variances. Raises :class:`DataError`."""
    path, values = matrix.path, read_square(matrix.path, "covariance")
    if not np.all(np.isfinite(values)) or not np.all(np.diag(values) > 0):
        raise DataError(f"{path}: the variances must be positive and every covariance finite")
    scale = np.sqrt(np.outer(np.diag(values), np.diag(values)))
    unequal = np.argwhere(np.abs(values - values.T) > 1e-9 * scale)
    if len(unequal):
        i, j = unequal[0]
        raise DataError(
            f"{path}: not symmetric: {values[i, j]:g} in row {i + 1}, column {j + 1}, {values[j, i]:g} across"
        )
    return np.asarray(convert(0.5 * (values + values.T), matrix.unit, matrix.target))


def read_square(path: Path, what: str = "correlation matrix") -> Array:
    """The numbers (K, K) of a CSV file without header. Raises :class:`DataError`."""
    rows: list[list[float]] = []
    delimiter = None
    with opened(path, Layout("csv")):
        for number, line in numbered_lines(path):
            delimiter = delimiter_of(line, path) if delimiter is None else delimiter
            cells = enumerate(cells_of(line, delimiter), 1)
            rows.append([number_in(cell, str(i), path, number, None) for i, cell in cells])
            if len(rows[-1]) != len(rows[0]):
                raise DataError(f"{path}:{number}: {len(rows[-1])} numbers, but {len(rows[0])} in the first row")
    if not rows or len(rows) != len(rows[0]):
        raise DataError(f"{path}: a {what} is square, but this has {len(rows)} rows of {len(rows[0]) if rows else 0}")
    return np.array(rows)
