"""What a ``.mat`` file of any version holds, under the names MATLAB has for it.

What is in a struct or a cell array is ``film.R``, ``expts(2).R``, ``R{3}``; column and row of a matrix are ``M(:,2)``
and ``M(2,:)``.
"""

import fnmatch
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np

from en4dvar.inputs.text_table import WIDEST
from en4dvar.model.state import Array

T = TypeVar("T")
MOST = 1 << 25  # numbers in all vectors of a file: 256 MiB, whatever a small compressed file may unpack to
MOST_IN_MATRICES = 1 << 22  # in all matrices of a file: what is larger is a film, not a table
SHOWN = 12  # columns of a matrix that are told one by one
_INDEX = re.compile(r"\((\d+)\)|\{(\d+)\}")
_OF_MATRIX = re.compile(r"(.+)\((?::,([1-9]\d{0,8})|([1-9]\d{0,8}),:)\)")


@dataclass(frozen=True)
class Variables:
    """Real ``vectors`` (K,) and ``matrices`` (n, m), finite ``scalars``, and in words what else there is.

    A matrix is among the ``others`` too, and a scalar among the vectors.
    """

    vectors: Mapping[str, Array]
    matrices: Mapping[str, Array]
    scalars: Mapping[str, float]
    others: Mapping[str, str]

    def vector(self, name: str) -> Array | None:
        """A vector by its name, also of a matrix; None where there is none."""
        match = _OF_MATRIX.fullmatch(name)
        if name in self.vectors or match is None or match[1] not in self.matrices:
            return self.vectors.get(name)
        matrix, index = self.matrices[match[1]], int(match[2] or match[3]) - 1
        of = matrix.T if match[2] else matrix
        return of[index] if index < len(of) else None

    def matching(self, pattern: str) -> tuple[str, ...]:
        """The names that a pattern with ``*`` stands for, columns and rows of matrices among them."""
        return tuple(name for name in self._names() if fnmatch.fnmatchcase(name, pattern))

    def _names(self) -> Iterator[str]:
        yield from self.vectors
        for name, matrix in self.matrices.items():
            if max(matrix.shape) <= WIDEST:
                yield from (f"{name}(:,{k + 1})" for k in range(matrix.shape[1]))
                yield from (f"{name}({k + 1},:)" for k in range(matrix.shape[0]))

    def of(self, part: str) -> "Variables":
        """What is not inside an array, and of arrays the element ``part`` under names without the index."""
        return Variables(*(_element(getattr(self, kind.name), part) for kind in fields(self)))

    def of_first(self) -> "Variables":
        """Each array by its first element, under names without the index."""
        return Variables(*(_first(getattr(self, kind.name)) for kind in fields(self)))

    def columns(self) -> dict[str, Array]:
        """Vectors of more than one number, and the columns of narrow matrices."""
        columns = {name: vector for name, vector in self.vectors.items() if vector.size > 1}
        for name, matrix in self.matrices.items():
            if matrix.shape[1] <= SHOWN:
                columns |= {f"{name}(:,{k + 1})": column for k, column in enumerate(matrix.T)}
        return columns


def array_words(shape: Sequence[int]) -> str:
    """What an array that is no vector is called."""
    return f"an array of {' x '.join(map(str, shape))}"


def gathered(elements: Iterable[tuple[str, Array | str]]) -> Variables:
    """Variables of named vectors and matrices, or words in their place; of two with one name the last."""
    every = dict(elements)
    numbers = {name: it for name, it in every.items() if not isinstance(it, str)}
    vectors = {name: it for name, it in numbers.items() if it.ndim == 1}
    matrices = {name: it for name, it in numbers.items() if it.ndim == 2}
    scalars = {name: float(it[0]) for name, it in vectors.items() if it.size == 1 and np.isfinite(it[0])}
    words = {name: it for name, it in every.items() if isinstance(it, str)}
    return Variables(vectors, matrices, scalars, words | {name: array_words(m.shape) for name, m in matrices.items()})


def indexed(name: str) -> tuple[str, str]:
    """``expts(2).R`` as ``expts.R`` and ``2``, ``C{3}`` as ``C`` and ``3``; by the first index, "" without one."""
    match = _INDEX.search(name)
    return (name[: match.start()] + name[match.end() :], match[1] or match[2]) if match else (name, "")


def _element(elements: Mapping[str, T], part: str) -> dict[str, T]:
    inside = {name: value for whole, value in elements.items() for name, i in (indexed(whole),) if i and i == part}
    return {**elements, **inside}


def _first(elements: Mapping[str, T]) -> dict[str, T]:
    kept: dict[str, T] = {}
    for whole, value in elements.items():
        kept.setdefault(indexed(whole)[0], value)
    return kept
