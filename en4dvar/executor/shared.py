"""What many calls have in common."""

from __future__ import annotations

import functools
import pickle
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class CommonValue(Generic[T]):
    """A value that is pickled once for all calls, and made again once in each worker process."""

    def __init__(self, value: T):
        self.value = value

    @functools.cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps(self.value)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._pickled,)


@functools.lru_cache(maxsize=2)
def _made_again(pickled: bytes) -> CommonValue[Any]:
    return CommonValue(pickle.loads(pickled))
