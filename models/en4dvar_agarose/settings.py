"""The study's YAML file: which configurations make it up, how large the sweep is, where a twin's truth is."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from en4dvar.config import Config, load_config
from en4dvar.config.context import check
from en4dvar.config.document import Document, override, read_document
from en4dvar.config.load import require_kind
from en4dvar.config.schema import Name, Section
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.units import Quantity
from en4dvar.sampling.sweep import SweepSettings
from en4dvar_agarose.paper import Model

MODELS: tuple[Model, ...] = ("nh", "qs", "qlkv")


class Sweep(Section):
    """Size of the sweep of each model and gel; see :class:`~en4dvar.sampling.sweep.SweepSettings`."""

    trajectories: Annotated[int, Field(ge=2, le=10_000_000)] = 50_000
    """Size of the design."""
    shift: Annotated[float, Quantity("s"), Field(ge=0)] = 0.8e-6
    """Largest time shift."""
    step: Annotated[float, Quantity("s"), Field(gt=0)] = 0.025e-6
    """Step of the time grid and of the shifts."""
    width: Annotated[float, Field(gt=0, le=10)] = SweepSettings.width
    """Range searched, in prior standard deviations."""
    rounds: Annotated[int, Field(ge=0, le=50)] = SweepSettings.rounds
    """Rounds of local refinement."""
    local: Annotated[int, Field(ge=1)] = SweepSettings.local
    """Trajectories a data set in each round of refinement."""


class StudySchema(Section):
    """The whole file of ``en4dvar study``."""

    PURPOSE: ClassVar[str] = "a study, for 'en4dvar study'"
    name: Name
    """Name of the study; its results go to runs/<name>."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the sweeps."""
    synthetic: bool
    """Whether the data are a synthetic twin; every page says so."""
    truth: str | None = None
    """CSV file of the twin's true parameters, read for the report only; relative to this file's folder."""
    sweep: Sweep = Sweep()
    """Size of the sweep of each model and gel."""
    population: Annotated[dict[str, Any], Field(default_factory=dict)]
    """How much an estimator of populations computed that is no more; read by no one since 1.1."""
    gels: Annotated[dict[str, dict[str, str]], Field(min_length=1)]
    """Label of the gel → model (nh, qs, qlkv) → configuration file, relative to this file's folder."""


@dataclass(frozen=True)
class StudyPlan:
    """A validated study; ``configs`` gel → model → configuration. ``truth`` is read for the report only."""

    name: str
    seed: int
    synthetic: bool
    truth: Path | None
    sweep: SweepSettings
    configs: dict[str, dict[Model, Config]]
    text: str

    @property
    def named(self) -> dict[str, Config]:
        return {f"{gel}, {model}": config for gel, models in self.configs.items() for model, config in models.items()}


def named(*words: str) -> str:
    """Words as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "_", " ".join(words)).strip("_").lower()


def load_study(path: str | Path, overrides: dict[str, Any] | None = None) -> StudyPlan:
    """Read a study and every configuration it names; paths are relative to its folder. Raises :class:`ConfigError`."""
    path = Path(path)
    document = override(read_document(path), overrides or {})
    require_kind(StudySchema, document)
    faults: list[Fault] = []
    top = check(StudySchema, document.data, (), document, faults)
    if top is None:
        raise ConfigError(faults)
    base = path.resolve().parent
    configs = {gel: _configs(gel, files, base, document, faults) for gel, files in top.gels.items()}
    gels = {named(gel): gel for gel in reversed(top.gels)}
    for gel in top.gels:
        if (other := gels[named(gel)]) != gel:
            words = f"its files would have the names of those of {other!r}; let letters or digits of the labels differ"
            faults.append(document.fault(("gels", gel), words, at_key=True))
    if top.truth and not top.synthetic:
        faults.append(document.fault(("truth",), "only a synthetic campaign has a truth"))
    truth = base / top.truth if top.truth else None
    if truth and not truth.is_file():
        faults.append(document.fault(("truth",), f"{truth}: no such file"))
    if faults:
        raise ConfigError(faults)
    sweep = SweepSettings(**top.sweep.model_dump())
    return StudyPlan(top.name, top.seed, top.synthetic, truth, sweep, configs, document.text)


def _configs(
    gel: str, files: dict[str, str], base: Path, document: Document, faults: list[Fault]
) -> dict[Model, Config]:
    configs: dict[Model, Config] = {}
    for name in files:
        if name not in MODELS:
            faults.append(document.fault(("gels", gel, name), f"write one of {', '.join(MODELS)}", at_key=True))
    for model in MODELS:
        if model not in files:
            continue
        try:
            configs[model] = load_config(base / files[model])
        except ConfigError as error:
            faults += error.problems
    return configs
