"""Quantities of the state on which R depends: predictions, their rates, and the parameters of the errors; and how they
change.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array


@dataclass(frozen=True)
class Predicted:
    """Predictions with all that R takes from the state, of one run or of many (leading dimensions …).

    ``values`` m (…, K), ``rates`` ṁ (…, K) of the observable or None where R needs none, ``noise_scale`` σ (…,) or
    None where it is neither estimated nor fixed, ``discrepancy`` (…, 2) amplitude and length of the model's discrepancy
    or None where there is none.
    """

    values: Array
    rates: Array | None = None
    noise_scale: Array | None = None
    discrepancy: Array | None = None

    def __getitem__(self, runs: int | slice) -> "Predicted":
        """The same of some of the runs."""
        return self.each(lambda part: part[runs])

    def each(self, of: Callable[[Array], Array]) -> "Predicted":
        """What ``of`` makes of each of the arrays."""
        others = (self.rates, self.noise_scale, self.discrepancy)
        return Predicted(of(self.values), *(None if part is None else of(part) for part in others))

    @property
    def stacked(self) -> Array:
        """(B, Ky) of B runs side by side: m, and as far as they are there ṁ, ln σ, ln of amplitude and length."""
        parts = [self.values]
        if self.rates is not None:
            parts.append(self.rates)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.noise_scale is not None:
                parts.append(np.log(self.noise_scale)[:, None])
            if self.discrepancy is not None:
                parts.append(np.log(self.discrepancy))
        return np.hstack(parts) if len(parts) > 1 else parts[0]

    def unstacked(self, columns: Array) -> "Predicted":
        """The inverse of :attr:`stacked` for columns (…, Ky) of the same make, such as those of an emulator."""
        values, rates, *logs = self.parts(columns)
        return Predicted(values, rates, *(None if log is None else np.exp(log) for log in logs))

    def parts(self, columns: Array) -> tuple[Array, Array | None, Array | None, Array | None]:
        """Which of the columns (…, Ky) of :attr:`stacked` belong to m, ṁ, ln σ (…,), and ln of the discrepancy."""
        k, end = self.values.shape[-1], columns.shape[-1]
        discrepancy = None if self.discrepancy is None else columns[..., end - 2 :]
        end -= 0 if discrepancy is None else 2
        scale = None if self.noise_scale is None else columns[..., end - 1]
        return columns[..., :k], None if self.rates is None else columns[..., k : 2 * k], scale, discrepancy


@dataclass(frozen=True)
class Linearisation:
    """Predictions about one point, ``prediction``, and their anomalies per unit of some N coordinates.

    ``anomalies`` ∂m (N, K), ``rate_anomalies`` ∂ṁ (N, K), ``log_scale_anomalies`` ∂ln σ (N,) and
    ``log_discrepancy_anomalies`` (N, 2) of ln amplitude and ln length, the latter three None where the prediction has
    none. Of weights, row i is the change of the prediction when the control vector moves by the prior anomaly of
    member i.
    """

    prediction: Predicted
    anomalies: Array
    rate_anomalies: Array | None = None
    log_scale_anomalies: Array | None = None
    log_discrepancy_anomalies: Array | None = None

    @classmethod
    def of_stacked(cls, like: Predicted, reference: Array, anomalies: Array) -> "Linearisation":
        """From reference (Ky,) and anomalies (N, Ky) of what :attr:`Predicted.stacked` of ``like`` holds."""
        return cls(like.unstacked(reference), *like.parts(anomalies))
