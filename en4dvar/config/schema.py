"""Sections of configuration files as frozen pydantic models: what they have in common, and those of every kind of file.

A key is declared once, as a field: its type, unit, bounds and default; the text below it is its description. Messages,
the JSON schema and the reference of keys follow from that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    WithJsonSchema,
    create_model,
    model_validator,
)
from pydantic_core import from_json, to_json

from en4dvar.config.context import Context
from en4dvar.config.validate import Faults
from en4dvar.executor.limits import Limits, parse_bytes
from en4dvar.problem import AssimilationSettings
from en4dvar.units import Quantity

QuantityText = str | int | float
Name = Annotated[str, Field(pattern=r"^\w[\w.+ -]*$", max_length=100)]
ModelSection = Annotated[dict[str, Any], WithJsonSchema({"x-definition": "model"})]  # read by config.models


class Section(BaseModel):
    """Base of every section: unknown keys are errors, values cannot change, numbers are finite.

    The text below a key is its description in ``en4dvar schema`` and in the reference of keys.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True, use_attribute_docstrings=True
    )

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        """Add what does not go together in a section as given; it is told beside the faults of single keys."""

    @model_validator(mode="wrap")
    @classmethod
    def _with_rules(cls, given: Any, validate: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        faults = Faults()
        with faults.at(schema=cls):
            section = validate(given)
        if isinstance(given, dict):
            cls.rules(given, info.context or {}, faults)
        faults.tell()
        return section

    def as_written(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was given, what was left out filled in with defaults; plain data."""
        fields = {field.alias or name: (name, field) for name, field in type(self).model_fields.items()}
        if not fields.keys() >= given.keys():  # keys named after something of the model
            return _plain(given)
        written: dict[str, Any] = {}
        for key, (name, field) in fields.items():
            value = getattr(self, name)
            text = given[key] if key in given else field.get_default(call_default_factory=True)
            if isinstance(value, Section):
                written[key] = value.as_written(text if isinstance(text, dict) else {})
            elif text is not None:
                written[key] = _plain(text)
        return written


def _plain(value: Any) -> Any:
    """As YAML and JSON have it: no tuples, paths or numbers of other kinds."""
    return from_json(to_json(value))


def fields_of(kind: Any) -> dict[str, Any]:
    """The fields of a dataclass for ``create_model``.

    A field is declared there as ``members: Annotated[int, Ge(3), "Ensemble size N."] = 48``.
    """
    hints = get_type_hints(kind, include_extras=True)
    return {
        field.name: (hints[field.name], Field(field.default, description=_words(hints[field.name])))
        for field in dataclasses.fields(kind)
    }


def _words(hint: Any) -> str | None:
    return next((text for text in getattr(hint, "__metadata__", ()) if isinstance(text, str)), None)


def _size(text: str) -> str:
    parse_bytes(text)
    return text


class Execution(Section):
    """Where the work is done; never changes the numbers."""

    executor: Literal["serial", "threads", "processes", "dask"] | None = None
    """What runs the members; default: threads where the model is compiled, else processes."""
    workers: Annotated[int, Field(ge=1)] | None = None
    """Parallel workers; default: the cores this process may use."""
    address: Annotated[str, Field(pattern=r"^\w+://\S+$")] | None = None
    """Address of a running dask scheduler, e.g. tcp://10.0.0.1:8786."""
    checkpoint_every: Annotated[float, Field(ge=0)] = 0.2
    """Seconds between two checkpoints of a data set; an iteration that follows sooner is not written, 0 writes all.
    Never so often that writing takes more than 5 % of the time."""

    time_limit: Annotated[float, Quantity("s"), Field(gt=0)] | None = None
    """Longest that one batch of members (one member, unless the model batches) may take, e.g. 60 s; past it they have
    failed. Needs executor processes (then the default) or dask."""
    memory_limit: Annotated[str, AfterValidator(_size)] | None = None
    """Most that a worker process may allocate, e.g. 4 GB; members that need more have failed. Linux; needs executor
    processes (then the default) or dask."""

    @property
    def limits(self) -> Limits:
        """What a worker process may take."""
        return Limits(self.time_limit, None if self.memory_limit is None else parse_bytes(self.memory_limit))

    @model_validator(mode="after")
    def _belongs_to_the_executor(self) -> Self:
        if self.limits and self.executor in ("serial", "threads"):
            raise ValueError(
                f"a time or memory limit can end a process only; write executor: processes, not {self.executor}"
            )
        if self.address is not None and self.executor not in (None, "dask"):
            raise ValueError(f"address is that of a dask scheduler; write executor: dask, not {self.executor}")
        return self


class Output(Section):
    """Where results go."""

    directory: Path | None = None
    """Run directory; default runs/<name>, relative to the current directory."""
    report: bool = True
    """Write the figures and report.html."""


Assimilation = create_model(
    "Assimilation",
    __base__=Section,
    **fields_of(AssimilationSettings),
    weights=(
        Literal["sum", "mean"],
        Field("sum", description="sum: every observation counts (the Bayesian posterior); mean: β = 1/K, as in the "
              "published code."),
    ),
)  # fmt: skip
