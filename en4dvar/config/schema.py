"""The sections of a configuration file, as frozen pydantic models. What needs the model's units is text here."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, field_validator, model_validator

from en4dvar.executor.limits import Limits, parse_bytes
from en4dvar.problem import AssimilationSettings
from en4dvar.units import Quantity, parse_unit

QuantityText = str | int | float
Name = Annotated[str, Field(pattern=r"^\w[\w.+ -]*$", max_length=100)]


class Section(BaseModel):
    """Base of every section: unknown keys are errors, values cannot change, numbers are finite.

    The text below a key is its description in ``en4dvar schema`` and in the reference of keys.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True, use_attribute_docstrings=True
    )


def _known_unit(unit: str) -> str:
    parse_unit(unit)
    return unit


def _size(text: str) -> str:
    parse_bytes(text)
    return text


class Column(Section):
    """A column of a CSV file or a field of a ``.mat`` file; the unit is required, never guessed."""

    name: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
    unit: str
    """Unit of the numbers in the file, e.g. um; required, never guessed."""

    _unit = field_validator("unit")(_known_unit)


class TimeColumn(Section):
    """Observation times: a column, or a constant step (a scalar of the file, or a quantity such as ``0.63 us``)."""

    model_config = ConfigDict(
        json_schema_extra={
            "dependentRequired": {"name": ["unit"]},
            "oneOf": [{"required": ["name"]}, {"required": ["step"]}],
        }
    )
    name: str | None = None
    """Column of times; give this or ``step``."""
    step: QuantityText | None = None
    """Constant time step: a quantity such as 0.63 us, or the name of a scalar in the file (then with ``unit``)."""
    unit: str | None = None
    """Unit of the times in the file, e.g. us; required with ``name``, never guessed."""

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str | None) -> str | None:
        return unit if unit is None else _known_unit(unit)

    @model_validator(mode="after")
    def _one_of(self) -> TimeColumn:
        if (self.name is None) == (self.step is None):
            raise ValueError("give either 'name' (a column of times) or 'step' (a constant time step)")
        if self.name is not None and self.unit is None:
            raise ValueError(f"the unit of column {self.name!r} is missing; write unit: us")
        return self


class Window(Section):
    """First and last observation used: ``maximum``, ``minimum 2``, a time, or ``start``/``end`` of the file."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    """First observation: start, maximum (for the bubble also R_max), minimum N, or a time on the file's clock."""
    end: Annotated[QuantityText, Field(alias="to")] = "end"
    """Last observation: end, maximum, minimum N (counted from the window's start), or a time on the file's clock."""
    prominence: QuantityText = "10 %"
    """How deep a minimum must be to count, relative to the range of the series."""


class CovarianceFile(Section):
    """A CSV file of the full matrix R, without header; its unit (e.g. ``um^2``) is required, never guessed."""

    path: Annotated[str, Field(min_length=1)]
    """CSV file, relative to the configuration's folder; one row an observation of the window or of the series."""
    unit: str
    """Unit of the covariances, the observable's squared, e.g. um^2."""

    _unit = field_validator("unit")(_known_unit)


class Data(Section):
    """Where the observations are, what they mean and how well they are known."""

    path: str | tuple[str, ...]
    """A data file, a folder, a pattern such as data/*.csv, or a list of them; relative to this file's folder."""
    format: Literal["csv", "mat"] | None = None
    """Format of the files; default: by their suffix."""
    decimal: Literal[".", ","] = "."
    """Decimal sign of the numbers in a CSV file."""
    columns: dict[str, Any]
    """Which columns hold the time and the observable, each with its unit: ``time: {name: t, unit: us}``."""
    window: Window = Window()
    """Which observations are used (the assimilation window); default: all."""
    time_zero: QuantityText = "file"
    """Where the model's clock starts: file (the file's own zero), window (the first observation used), or a time."""
    error: dict[str, QuantityText | dict[str, QuantityText]]
    """Observation errors: ``<observable>_std``, ``time_std``, ``correlation_time``, ``covariance`` or ``robust``."""

    @field_validator("path")
    @classmethod
    def _not_empty(cls, path: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if not path or not all(path):
            raise ValueError("no file is named")
        return path


class Prior(Section):
    """A prior by name; locations and spreads carry the parameter's unit, a ``%`` spread is relative to the location."""

    prior: Literal["normal", "lognormal", "logit"]
    """Shape: normal (mean, std), lognormal (median and log_std, or mean and std), logit (lower, upper, median, …)."""
    mean: QuantityText | None = None
    """Mean with its unit, or ``maximum``: the largest observation of the window."""
    median: QuantityText | None = None
    """Median with its unit, or ``maximum``: the largest observation of the window."""
    std: QuantityText | None = None
    """Standard deviation with its unit, or in % of the mean."""
    log_std: Annotated[float, Field(gt=0)] | None = None
    """Standard deviation of the natural logarithm: 0.3 is about 30 %, 0.7 a factor of two."""
    logit_std: Annotated[float, Field(gt=0)] | None = None
    """Standard deviation of the logit between ``lower`` and ``upper``."""
    lower: QuantityText | None = None
    """Lower bound with its unit; never reached."""
    upper: QuantityText | None = None
    """Upper bound with its unit; never reached."""


class InitialSpread(Section):
    """Spread of the initial value of a state field: in its unit (added), or in ``%`` (a factor)."""

    std: QuantityText
    """Standard deviation: in the field's unit (added to it), or in % (a factor)."""


class FromFile(Section):
    """A value fixed at a scalar that the data file holds."""

    from_file: Annotated[str, Field(min_length=1)]
    """Name of a scalar in the data file, e.g. Req."""
    unit: str
    """Unit of that scalar in the file."""

    _unit = field_validator("unit")(_known_unit)


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
    def _limits_are_of_processes(self) -> Execution:
        if self.limits and self.executor in ("serial", "threads"):
            raise ValueError(
                f"a time or memory limit can end a process only; write executor: processes, not {self.executor}"
            )
        return self

    @model_validator(mode="after")
    def _address_is_of_dask(self) -> Execution:
        if self.address is not None and self.executor not in (None, "dask"):
            raise ValueError(f"address is that of a dask scheduler; write executor: dask, not {self.executor}")
        return self


class Output(Section):
    """Where results go."""

    directory: Path | None = None
    """Run directory; default runs/<name>, relative to the current directory."""
    report: bool = True
    """Write the figures and report.html."""


class Times(Section):
    """A uniform grid of instants, both ends included."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    """First instant with its unit; start is time zero."""
    end: Annotated[QuantityText, Field(alias="to")]
    """Last instant with its unit."""
    step: QuantityText
    """Time step with its unit."""


class Simulate(Section):
    """Settings of ``en4dvar simulate``: when the synthetic observations are taken."""

    times: Times
    """Instants of the synthetic observations."""


def _positive(values: tuple[float, ...]) -> tuple[float, ...]:
    if not values or not all(value > 0 for value in values):
        raise ValueError(f"give one or more positive numbers, not {list(values)}")
    return values


_LIMITS: dict[str, Any] = {
    "members": Field(ge=3),
    "epsilon": Field(gt=0, le=1),
    "max_iterations": Field(ge=1),
    "starts": Field(ge=1),
    "step_tolerance": Field(gt=0),
    "cost_tolerance": Field(gt=0),
    "min_active_fraction": Field(gt=0, le=1),
    "mda_coefficients": AfterValidator(_positive),
}

_WORDS = {
    "scheme": "en4dvar (iterative ensemble smoother) or es-mda (multiple data assimilation).",
    "members": "Ensemble size N.",
    "sampling": "Prior ensemble: second-order exact (mean and covariance are the prior's), or random.",
    "linearisation": "Tangent from runs close to the iterate (bundle), or regression over the ensemble (transform).",
    "epsilon": "Size of the bundle, in prior standard deviations.",
    "step_control": "What keeps J from rising along the iterations.",
    "start": "Where the iterations start: the prior members of lowest J, or the prior mean.",
    "starts": "How many prior members of lowest J start a descent; others follow while none explains the data.",
    "max_iterations": "Iteration limit.",
    "step_tolerance": "Converged where the step is shorter than this, in posterior standard deviations.",
    "cost_tolerance": "Converged where J falls by less than this, relative to J (absolute below J = 1).",
    "min_active_fraction": "Fewer surviving members than this share of the ensemble end the run (exit code 3).",
    "refine": "mcmc: replace the posterior ensemble by draws of a Markov chain (extra 'mcmc').",
    "emulator": "A few hundred more runs to tell how Gaussian the posterior is: auto (compiled models), on, or off.",
    "mda_coefficients": "Inflation of R in each assimilation of es-mda, scaled so that the inverses sum to one.",
    "mda_form": "Analysis of es-mda: perturbed observations, or a square root.",
    "weights": "sum: every observation counts (the Bayesian posterior); mean: β = 1/K, as in the published code.",
}


def _assimilation_section() -> type[Section]:
    """Fields, types and defaults come from :class:`AssimilationSettings`, the single declaration."""
    hints = get_type_hints(AssimilationSettings)
    fields: dict[str, Any] = {
        f.name: (
            Annotated[hints[f.name], _LIMITS[f.name]] if f.name in _LIMITS else hints[f.name],
            Field(f.default, description=_WORDS.get(f.name)),
        )
        for f in dataclasses.fields(AssimilationSettings)
    }
    fields["weights"] = (Literal["sum", "mean"], Field("sum", description=_WORDS["weights"]))
    return create_model("Assimilation", __base__=Section, **fields)


Assimilation = _assimilation_section()


class Schema(Section):
    """The whole file. ``data``, ``model``, ``parameters`` and ``assimilation`` are validated by themselves."""

    name: Name
    """Name of the run; its results go to runs/<name>."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of every random number; the same seed gives the same bits on any machine and number of workers."""
    data: dict[str, Any] | None = None
    """Where the observations are, what they mean and how well they are known."""
    model: dict[str, Any]
    """The forward model: its ``name`` (see ``en4dvar models``) and its settings."""
    parameters: dict[str, Any]
    """For each parameter a prior (estimated), a quantity (fixed), or a scalar of the data file (fixed)."""
    initial_state: dict[str, Any] | None = None
    """Fields of the initial state that are uncertain, each with its ``std``."""
    assimilation: dict[str, Any] = {}
    """Scheme, ensemble size and stopping rules; the defaults are the recommended ones."""
    execution: Execution = Execution()
    """Where the work is done; never changes the numbers."""
    output: Output = Output()
    """Where results go."""
    simulate: Simulate | None = None
    """Settings of ``en4dvar simulate``."""
