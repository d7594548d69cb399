"""An observation operator for what is positive."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Logarithm:
    """H that reads the natural logarithm of a positive field: errors that are a share of it have one std there."""

    name: str
    batched: ClassVar[bool] = True

    def __call__(self, trajectory: Any) -> npt.NDArray[np.float64]:
        logarithm: npt.NDArray[np.float64] = np.log(trajectory[self.name])
        return logarithm
