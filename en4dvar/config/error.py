"""``data.error``: how well the observations are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from en4dvar.config.context import PLACEHOLDER, Context, Made, Spread, observable_unit, quantity, time_unit, unit_of
from en4dvar.config.discrepancy import DiscrepancySection, estimated
from en4dvar.config.error_std import QUANTITY_OR_COLUMN, read_error_std, read_spread, read_time_std
from en4dvar.config.schema import Section
from en4dvar.config.validate import Faults
from en4dvar.files import expanded
from en4dvar.inputs.asked import Column, Matrix

HUBER = 1.345  # 95 % efficiency where the errors are Gaussian after all: Huber (1981), Robust Statistics


def _square(context: Context) -> str:
    unit = observable_unit(context)
    return "1" if unit == "1" else f"({unit})*({unit})"


class CovarianceFile(Section):
    """A CSV file with the full matrix R, without header; its unit (e.g. ``um^2``) is required, never guessed."""

    path: Annotated[str, Field(min_length=1)]
    """CSV file, relative to the configuration's folder; one row per observation of the window or of the series."""
    unit: Annotated[str, unit_of(_square)]
    """Unit of the covariances, the observable's squared, e.g. um^2."""


def _matrix(given: CovarianceFile, context: Context) -> Matrix:
    return Matrix(context.base / expanded(given.path), given.unit, _square(context))


class Error(Section):
    """Observation errors: a std or a covariance, of the times, correlation, a robust cost, what the model misses."""

    model_config = ConfigDict(populate_by_name=False)
    std: Annotated[Spread | Column | None, Made(read_error_std, json=QUANTITY_OR_COLUMN)] = Field(
        None, alias=f"{PLACEHOLDER}_std"
    )
    """Std of the observation error: a quantity, e.g. '1 % of maximum', or ``{column: NAME}``, one per reading."""
    time_std: Annotated[float | Column, Made(read_time_std, json=QUANTITY_OR_COLUMN)] = 0.0
    """Std of the observation times, a quantity or ``{column: NAME}``: adds (rate × time_std)²."""
    model_std: Annotated[Spread | None, Made(read_spread)] = None
    """Std of what the model misses from reading to reading, e.g. '1 % of maximum'; its square is added."""
    correlation_time: Annotated[float | None, quantity(time_unit, "positive")] = None
    """Errors are correlated as exp(−|Δt|/τ)."""
    covariance: Annotated[Matrix | None, Made(_matrix, CovarianceFile)] = None
    """File of the whole R."""
    robust: Literal["huber"] | None = None
    """Robust cost: readings far off count less."""
    threshold: Annotated[float, quantity(lambda c: "1", "positive")] = HUBER
    """Threshold of the robust cost in std."""
    discrepancy: Annotated[
        DiscrepancySection | None,
        BeforeValidator(estimated, json_schema_input_type=Literal["estimated"] | DiscrepancySection | None),
    ] = None
    """What the model misses: ``estimated``, or priors. Adds ``discrepancy_amplitude`` and ``discrepancy_length``."""

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        std = f"{PLACEHOLDER}_std"
        for name, other, reason in (
            ("covariance", std, "the file holds the variances"),
            ("covariance", "model_std", "the file holds the variances"),
            ("covariance", "correlation_time", "the file holds the correlations"),
            ("robust", "correlation_time", "a robust cost needs independent observation errors"),
            ("robust", "covariance", "a robust cost needs independent observation errors"),
        ):
            if name in given and other in given:
                faults.add((name,), f"not together with {other}: {reason}", at_key=True)
        if "threshold" in given and "robust" not in given:
            faults.add(("threshold",), "is that of the robust cost; write robust: huber as well", at_key=True)
        if context.observed and not given.keys() & {std, "covariance"}:
            faults.add((std,), "required: the standard deviation of the observation error")

    def column(self, which: Literal["std", "time_std"], readings: str) -> Column | None:
        """The column of errors, in the unit ``readings`` where it has none of its own; None: no column."""
        chosen = getattr(self, which)
        return replace(chosen, unit=chosen.unit or readings) if isinstance(chosen, Column) else None

    @property
    def huber(self) -> float | None:
        """The threshold of the robust cost, None where the cost is quadratic."""
        return self.threshold if self.robust else None
