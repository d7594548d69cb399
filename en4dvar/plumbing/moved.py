"""Former names of modules: an import by one gives the module at its new place, the same object, and says so."""

import sys
import warnings
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from itertools import accumulate
from types import ModuleType
from typing import Any

# new package → the modules and packages of ``en4dvar`` that moved into it with 1.1
HOMES = {
    "plumbing": "errors hints units files tables caution compiled user_code user_file",
    "model": "state forward function_model programs",
    "priors": "prior parameter_map dependence field_prior varying",
    "data": "observations noise",
    "diagnosis": "analysis residuals influence diagnostics response honesty",
    "estimation": "assimilate stages localised conclusions summary joint population design",
}
MOVED = {f"en4dvar.{name}": f"en4dvar.{home}.{name}" for home, names in HOMES.items() for name in names.split()}
MOVED |= {f"en4dvar.config.{n}": f"en4dvar.assembly.{n}" for n in ("build", "reading")}
MOVED |= {f"en4dvar.{old}": f"en4dvar.{new}" for new, several in {
    "config.data": "config.window config.columns config.series", "config.varies": "config.initial_state",
    "config.dependence": "config.population config.sharing", "plumbing.compiled": "kernel_cache",
    "config.kinds": "config.sequence config.synthetic config.twin", "config.models": "config.symbols commands.listing",
    "data.noise.make": "data.noise.joint data.noise.blocks", "descent.step_control": "descent.settling",
    "executor.base": "executor.chunks executor.futures executor.local", "executor.limits": "executor.blas",
    "model.forward": "batch", "model.programs.model": "model.programs.process model.programs.outputs",
    "model.programs.languages": "model.programs.errors model.programs.pest model.programs.template",
    "series.moments": "series.outcome", "config.design": "config.times", "assembly.build": "config.build_sequence",
    "config.of_readings": "config.weights config.places config.error config.discrepancy",
    "assembly.reading": "config.find_files",
    "commands.synthetic": "commands.design commands.sweep_twin commands.simulate",
    "commands.results": "commands.joint commands.population commands.together", "commands.run": "commands.validate",
    "commands.plugins": "commands.forms commands.installation commands.listings commands.plugin_commands",
    "series.sequential": "series.rotation", "series.settings": "schemes.inflation series.smoothers",
    "series.window": "series.moving", "runs.worklist": "runs.jobs",
    "schemes.filters": "schemes.etkf schemes.denkf schemes.enkf schemes.esrf schemes.baselines",
    "data.noise.discrepancy": "data.noise.kernel",
    "data.noise.gaussian": "data.noise.predicted", "data.noise.losses": "data.noise.huber",
    "series.series": "series.aligned", "series.start": "series.coordinates", "config.context": "config.validate",
    "config.quantities": "config.error_std", "inputs.readers": "inputs.order",
    "results.store": "results.groups results.beside results.complete results.record",
    "report.result": "report.notebook", "report.svg": "report.words report.drawing report.paths",
    "report.chart": "report.ticks report.palette", "report.history": "report.predictive",
    "report.figures": "report.fields report.varying", "report.sequence": "report.cycles report.twin",
    "report.page": "report.overview",
    "report.responses": "report.readings", "report.together": "report.joint report.population",
    "runs.finished": "runs.evidence_run", "estimation.joint.members": "estimation.joint.challenge",
    "estimation.stages": "loop_state", "results.declared": "results.axes",
    "inputs.parts": "inputs.contents inputs.opened inputs.asked", "inputs.matfile": "inputs.variables",
    "inputs.members": "inputs.square", "inputs.text_table": "inputs.sheets", "inputs.implausible": "inputs.steps",
    "estimation.population.hierarchy": "estimation.population.effort estimation.population.hyper",
    "estimation.population.own": "estimation.population.mixtures",
    "estimation.joint.descent": "estimation.joint.arrow estimation.joint.tangent",
    "estimation.design.nested": "estimation.design.laws", "estimation.design.planned": "estimation.design.laplace",
    "estimation.design.evaluate": "estimation.design.readings", "estimation.conclusions": "descent.variance",
    "descent.beyond_gaussian": "descent.marginal descent.noise_scale", "descent.field_data": "descent.field_gain",
    "ensemble.linalg": "ensemble.near_prior", "ensemble.members": "ensemble.readout",
    "priors.varying.model": "priors.varying.paths priors.varying.random_walk priors.varying.state_changes",
    "sampling.sweep": "sampling.nearest", "sampling.refine": "sampling.shape",
    "sampling.emulated_cost": "sampling.emulator", "diagnosis.honesty.checks": "diagnosis.honesty.lost",
    "diagnosis.response.what_if": "diagnosis.response.linear", "runs.rundir": "runs.replacement",
    "runs.cycles": "runs.twin_run runs.sequence_run", "runs.engine": "runs.session",
    "runs.together": "runs.joint_run runs.population_run", "runs.simulation": "runs.synthetic",
    "runs.design_run": "runs.design_plan", "runs.estimate": "runs.given",
    "results.checkpoint": "results.codec results.journal",
}.items() for old in several.split()}  # fmt: skip
MOVED |= {"en4dvar.cycling": "en4dvar.series", "en4dvar.storage": "en4dvar.results"}
MOVED |= {"en4dvar_lorenz.logarithm": "en4dvar_lorenz.autonomous"}
MOVED |= {f"en4dvar_agarose.{old}": f"en4dvar_agarose.{new}" for old, new in {
    "summary": "tables", "evidence": "fits", "store": "report", "checkpoints": "run",
}.items()}  # fmt: skip
MOVED |= {f"en4dvar_movie.{old}": f"en4dvar_movie.{new}" for old, new in {
    "corrections": "choice", "locate": "outline", "outlined": "page", "writing": "frames",
}.items()}  # fmt: skip
MOVED |= {f"en4dvar_bubble.{old}": f"en4dvar_bubble.{new}" for old, new in {
    "laws.zener": "laws.maxwell", "laws.response": "battery", "emission": "events", "packing": "paths",
    "alternatives": "model", "starter.page": "starter.config", "driving.tabulated": "driving.pulses",
    "driving.settings": "settings", "solver.lookup": "solver.lanes", "solver.arrow": "solver.general", "gas": "medium",
}.items()}  # fmt: skip

# names that moved by themselves, with what they are called today
NAMES = {
    "en4dvar.problem.AssimilationSettings": "en4dvar.schemes.settings.AssimilationSettings",
    "en4dvar.problem.Localising": "en4dvar.schemes.settings.Localisation",
    "en4dvar.series.moments.SequentialResult": "en4dvar.series.moments.SequentialState",
} | {f"en4dvar.series.{name}": f"en4dvar.data.series.{name}" for name in ("Places", "Part", "Series", "balanced")}


def former_name(module: str, name: str) -> Any:
    """What a module had under a name of version 1.0, for its ``__getattr__``. Raises :class:`AttributeError`."""
    old = f"{module}.{name}"
    if old not in NAMES:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warn(old, NAMES[old], 3)
    home, _, new = NAMES[old].rpartition(".")
    return getattr(import_module(home), new)


def warn(old: str, new: str, level: int) -> None:
    """Tell the caller ``level`` frames up, frames of the import system left out, where a name went."""
    warnings.warn(f"{old} is now {new}; the old name goes with 2.0", DeprecationWarning, stacklevel=level + 1)


class FormerNames(Loader):
    """Finds modules by their former names, and loads them from where they are."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        for old in accumulate(name.split("."), "{}.{}".format):
            if old in MOVED:
                today = MOVED[old] + name[len(old) :]
                warn(name, today, 2)
                return ModuleSpec(name, self, origin=today)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(spec.origin or "")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is executed a second time; the import system has set a specification that is not the module's own."""
        module.__spec__ = module.__spec__.loader_state if module.__spec__ else None


def install() -> None:
    """Make former names importable; a second call does nothing."""
    if not any(isinstance(finder, FormerNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, FormerNames())
