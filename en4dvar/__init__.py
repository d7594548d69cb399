"""En4D-Var: ensemble data assimilation for models that you can run but not differentiate.

    import en4dvar
    result = en4dvar.estimate(model, data, priors, error=0.1)  # a function and arrays
    result = en4dvar.run("configs/quickstart.yaml")  # or a file
    print(result)

Names are imported when first used, so that ``import en4dvar`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from en4dvar.plumbing import moved

if TYPE_CHECKING:
    from en4dvar.config import Config as Config
    from en4dvar.config import SequenceConfig as SequenceConfig
    from en4dvar.config import TwinConfig as TwinConfig
    from en4dvar.config import load_config as load_config
    from en4dvar.config import load_sequence as load_sequence
    from en4dvar.config import load_twin as load_twin
    from en4dvar.data.noise import noise_of as noise_of
    from en4dvar.data.observations import Observations as Observations
    from en4dvar.data.series import Places as Places
    from en4dvar.data.series import Series as Series
    from en4dvar.descent.preview import Preview as Preview
    from en4dvar.descent.preview import preview as preview
    from en4dvar.diagnosis.analysis import Analysis as Analysis
    from en4dvar.model.batch import Batch as Batch
    from en4dvar.model.forward import Failure as Failure
    from en4dvar.model.forward import ForwardModel as ForwardModel
    from en4dvar.model.forward import Observable as Observable
    from en4dvar.model.forward import StateField as StateField
    from en4dvar.model.forward import Trajectory as Trajectory
    from en4dvar.model.function_model import FunctionModel as FunctionModel
    from en4dvar.model.programs.control import from_pest as from_pest
    from en4dvar.model.state import Field as Field
    from en4dvar.model.state import Parameter as Parameter
    from en4dvar.model.state import StateLayout as StateLayout
    from en4dvar.plumbing.errors import ConfigError as ConfigError
    from en4dvar.plumbing.errors import DataError as DataError
    from en4dvar.plumbing.errors import En4dvarError as En4dvarError
    from en4dvar.plumbing.errors import OutputError as OutputError
    from en4dvar.plumbing.errors import TooFewMembersError as TooFewMembersError
    from en4dvar.plumbing.units import Quantity as Quantity
    from en4dvar.priors.prior import Prior as Prior
    from en4dvar.priors.prior import PriorTerm as PriorTerm
    from en4dvar.problem import InverseProblem as InverseProblem
    from en4dvar.report.calibration import Calibration as Calibration
    from en4dvar.report.compare import Comparison as Comparison
    from en4dvar.report.compare import compare_runs as compare_runs
    from en4dvar.report.export import export_table as export_table
    from en4dvar.report.populations import PopulationsCompared as PopulationsCompared
    from en4dvar.report.populations import compare_populations as compare_populations
    from en4dvar.report.result import Result as Result
    from en4dvar.report.result import load_result as load_result
    from en4dvar.runs.calibration_run import calibrate as calibrate
    from en4dvar.runs.campaign import Campaign as Campaign
    from en4dvar.runs.checks import validate as validate
    from en4dvar.runs.engine import write_report as write_report
    from en4dvar.runs.estimate import estimate as estimate
    from en4dvar.runs.estimate import estimate_sequence as estimate_sequence
    from en4dvar.runs.runner import run as run
    from en4dvar.runs.runner import run_campaign as run_campaign
    from en4dvar.runs.sequence_run import run_sequence as run_sequence
    from en4dvar.runs.simulation import Simulation as Simulation
    from en4dvar.runs.simulation import simulate as simulate
    from en4dvar.runs.twin_run import run_twin as run_twin
    from en4dvar.runs.twin_sweep import TwinSweep as TwinSweep
    from en4dvar.runs.twin_sweep import sweep_twin as sweep_twin
    from en4dvar.schemes.settings import AssimilationSettings as AssimilationSettings
    from en4dvar.series.model_error import ModelError as ModelError
    from en4dvar.series.problem import SeriesProblem as SeriesProblem
    from en4dvar.series.problem import SeriesResult as SeriesResult
    from en4dvar.series.problem import assimilate_series as assimilate_series
    from en4dvar.series.sequential import SequentialSettings as SequentialSettings
    from en4dvar.series.start import InitialEnsemble as InitialEnsemble

_HOME = {
    "model.batch": ("Batch",),
    "runs.campaign": ("Campaign",),
    "runs.calibration_run": ("calibrate",),
    "report.calibration": ("Calibration",),
    "descent.preview": ("Preview", "preview"),
    "runs.checks": ("validate",),
    "report.compare": ("Comparison", "compare_runs"),
    "config": ("Config", "SequenceConfig", "TwinConfig", "load_config", "load_sequence", "load_twin"),
    "series.problem": ("SeriesProblem", "SeriesResult", "assimilate_series"),
    "series.sequential": ("SequentialSettings",),
    "series.start": ("InitialEnsemble",),
    "series.model_error": ("ModelError",),
    "plumbing.errors": ("ConfigError", "DataError", "En4dvarError", "OutputError", "TooFewMembersError"),
    "report.export": ("export_table",),
    "report.populations": ("PopulationsCompared", "compare_populations"),
    "model.forward": ("Failure", "ForwardModel", "Observable", "StateField", "Trajectory"),
    "model.function_model": ("FunctionModel",),
    "data.noise": ("noise_of",),
    "data.observations": ("Observations",),
    "priors.prior": ("Prior", "PriorTerm"),
    "diagnosis.analysis": ("Analysis",),
    "model.programs.control": ("from_pest",),
    "problem": ("InverseProblem",),
    "schemes.settings": ("AssimilationSettings",),
    "runs.estimate": ("estimate", "estimate_sequence"),
    "runs.engine": ("write_report",),
    "runs.runner": ("run", "run_campaign"),
    "data.series": ("Places", "Series"),
    "runs.simulation": ("Simulation", "simulate"),
    "model.state": ("Field", "Parameter", "StateLayout"),
    "report.result": ("Result", "load_result"),
    "runs.sequence_run": ("run_sequence",),
    "runs.twin_run": ("run_twin",),
    "runs.twin_sweep": ("TwinSweep", "sweep_twin"),
    "plumbing.units": ("Quantity",),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE)

moved.install()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("en4dvar")
    if name not in _MODULE:
        raise AttributeError(f"module 'en4dvar' has no attribute {name!r}")
    value = getattr(import_module(f"en4dvar.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
