"""A joint estimate ⇄ ``joint.nc``: members of what is shared and of each data set's own, the fits, and what each data
set said alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.joint.estimate import JointEstimate
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import Caution, parsed, worst_first
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.units import convert
from en4dvar.results.declared import text
from en4dvar.results.netcdf import Group, Variable, read_groups, to_bytes, tree_of, understood, variable

if TYPE_CHECKING:
    import xarray as xr

FILE = "joint.nc"
QUANTILES = (0.05, 0.5, 0.95)
DRAWS = ("chain", "draw")


def save_joint(path: Path, estimate: JointEstimate, alone: Sequence[Array], attributes: Mapping[str, Any]) -> Path:
    """Write the file; it appears complete or not at all. ``alone``: physical members (N_i, n_i) of each data set.

    Raises :class:`OutputError`.
    """
    names = [experiment.observations.name for experiment in estimate.joint.experiments]
    datasets = {"dataset": variable("dataset", text(names), "", "data set")}
    root = {
        **attributes,
        "converged": int(estimate.converged),
        "stop_reason": estimate.stop_reason,
        "log_evidence": estimate.log_evidence,
        "forward_runs": estimate.forward_runs,
        "effective_draws": estimate.members.effective,
        "warnings": _lines(estimate),
    }
    groups = {
        "/": Group(attrs=root),
        "/posterior": Group(_shared(estimate) | _own(estimate, names), datasets),
        "/prior": Group(_prior(estimate)),
        "/alone": Group(_alone(estimate, alone), datasets),
        "/fit": Group(_fit(estimate, names), datasets),
    }
    if estimate.without:
        groups["/without"] = Group(_shared(estimate.rest), attrs={"warnings": _lines(estimate.rest)})
    return to_bytes(groups).write(path)


def _lines(estimate: JointEstimate) -> str:
    return "\n".join(c.line for c in worst_first(estimate.cautions))


def shared_name(key: tuple[str, str]) -> str:
    """Variable of a shared quantity: its name, and its group where that is not everyone."""
    name, group = key
    plain = "".join(c if c.isalnum() else "_" for c in group)
    return f"{name}_{plain}" if plain else name


def of_parameter(p: Parameter, dims: str | tuple[str, ...], values: Any, words: str = "", **more: Any) -> Variable:
    """A variable of a parameter, with how it is shown; ``words``: its meaning, by default the parameter's label."""
    return variable(dims, values, p.unit, words or p.label, symbol=p.symbol, display_units=p.display_unit, **more)


def _shared(estimate: JointEstimate) -> dict[str, Variable]:
    variables = {}
    for j, (key, term) in enumerate(zip(estimate.joint.shared, estimate.joint.terms, strict=True)):
        label = ", ".join(filter(None, (term.parameter.label, key[1])))
        members, mode = estimate.shared[None, :, j], float(estimate.shared_mode[j])
        variables[shared_name(key)] = of_parameter(term.parameter, DRAWS, members, label, mode=mode)
    return variables


def _alone(estimate: JointEstimate, alone: Sequence[Array]) -> dict[str, Variable]:
    """Quantiles (dataset, quantile) of each shared parameter as each data set has it by itself; NaN of the others."""
    variables, joint = {}, estimate.joint
    for (name, group), term in zip(joint.shared, joint.terms, strict=True):
        rows = np.full((len(alone), len(QUANTILES)), np.nan)
        for e, members in enumerate(alone):
            if joint.groups[e].get(name) == group:
                rows[e] = member_quantiles(members[:, joint.experiments[e].prior.names.index(name)], QUANTILES)
        words = "5, 50 and 95 % of a data set alone"
        variables[shared_name((name, group))] = variable(("dataset", "quantile"), rows, term.parameter.unit, words)
    return variables


def _own(estimate: JointEstimate, names: Sequence[str]) -> dict[str, Variable]:
    """(chain, draw, dataset) of the parameters that data sets have of their own, NaN where one has it not."""
    count = len(estimate.members.border)
    values: dict[str, Array] = {}
    parameters: dict[str, Parameter] = {}
    for e, experiment in enumerate(estimate.joint.experiments):
        members = estimate.control(e)[:-1]
        for j in estimate.joint.columns(e)[1]:
            p = experiment.prior.parameters[j]
            values.setdefault(p.name, np.full((1, count, len(names)), np.nan))[0, :, e] = members[:, j]
            parameters[p.name] = p
    taken = {shared_name(key) for key in estimate.joint.shared}
    return {
        f"{name}_own" if name in taken else name: of_parameter(parameters[name], (*DRAWS, "dataset"), array)
        for name, array in values.items()
    }


def _prior(estimate: JointEstimate) -> dict[str, Variable]:
    """Quantiles (quantile,) of the priors of what is shared."""
    z = np.array([-1.6448536, 0.0, 1.6448536])
    return {
        shared_name(key): variable("quantile", term.to_physical(term.mean + term.std * z), term.parameter.unit, "prior")
        for key, term in zip(estimate.joint.shared, estimate.joint.terms, strict=True)
    }


def _fit(estimate: JointEstimate, names: Sequence[str]) -> dict[str, Variable]:
    """Observations and predictive bands of each data set, padded with NaN, in display units; and each data set against
    all others, as the estimate without the odd ones has it.
    """
    experiments, agreed = estimate.joint.experiments, estimate.agreement
    most = max(len(experiment.observations) for experiment in experiments)
    times, values = np.full((2, len(experiments), most), np.nan)
    bands = np.full((len(experiments), max(map(len, estimate.grids)), 4), np.nan)
    for e, (experiment, run, grid) in enumerate(zip(experiments, estimate.forecasts, estimate.grids, strict=True)):
        to_time = (experiment.model.time_unit, experiment.model.time_display_unit)
        to_value = (experiment.observable.unit, experiment.observable.display_unit)
        k = len(experiment.observations)
        times[e, :k] = convert(experiment.observations.times, *to_time)
        values[e, :k] = convert(experiment.observations.values, *to_value)
        bands[e, : len(grid), 0] = convert(grid, *to_time)
        alive = run.path[:-1][run.active[:-1]]
        bands[e, : len(grid), 1:] = convert(member_quantiles(alive, QUANTILES, axis=0).T, *to_value)
    observables = [experiment.observable for experiment in experiments]
    time_units = text(experiment.model.time_display_unit for experiment in experiments)
    apart = "from the value of all others, in standard deviations"
    odd = np.array([int(name in estimate.odd) for name in names])
    alive_counts = np.array([int(run.active[:-1].sum()) for run in estimate.forecasts])
    return {
        "chi2_per_observation": variable("dataset", estimate.chi2, "1", "misfit per observation at the mode"),
        "alive": variable("dataset", alive_counts, "1", "members that ran"),
        "observable": variable("dataset", text(o.label for o in observables), "", "what was observed"),
        "unit": variable("dataset", text(o.display_unit for o in observables), "", "unit of values and bands"),
        "time_unit": variable("dataset", time_units, "", "unit of times"),
        "time": variable(("dataset", "observation"), times, "1", "times of the observations"),
        "value": variable(("dataset", "observation"), values, "1", "observations"),
        "band": variable(("dataset", "point", "what"), bands, "1", "time; 5, 50 and 95 % of the members there"),
        "distance": variable("dataset", np.sqrt(agreed.squares), "1", apart),
        "chance": variable("dataset", agreed.chances, "1", "probability of a larger distance if all share one value"),
        "odd": variable("dataset", odd, "1", "1: left out in the group without"),
    }


@dataclass(frozen=True)
class StoredGroups:
    """A file about several data sets together: a thin view of ``tree``."""

    tree: xr.DataTree

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets."""
        return tuple(map(str, self.group("alone")["dataset"].values))

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Warnings of the estimate, the worst first."""
        return parsed(self.tree.attrs["warnings"])

    def group(self, name: str) -> xr.Dataset:
        """The variables of a group."""
        return self.tree.children[name].to_dataset()


@dataclass(frozen=True)
class StoredJoint(StoredGroups):
    """A file of :func:`save_joint`: groups posterior, prior, alone, fit, and, without odd data sets, without."""

    @property
    def shared(self) -> tuple[str, ...]:
        """Names of the variables of what is shared."""
        return tuple(str(name) for name in self.group("prior").data_vars)

    @property
    def odd(self) -> tuple[str, ...]:
        """Names of the data sets that do not share the values of the others."""
        fit = self.group("fit")  # of which a file of an earlier version has no such column
        odd = fit["odd"].values if "odd" in fit else np.zeros(len(self.datasets))
        return tuple(name for name, is_odd in zip(self.datasets, odd, strict=True) if is_odd)

    @property
    def cautions_without(self) -> tuple[Caution, ...]:
        """Warnings of the estimate without the odd data sets."""
        return parsed(self.group("without").attrs["warnings"])


def load_joint(path: Path) -> StoredJoint:
    """Read the file into memory. Raises :class:`OutputError`: it is none, cut short or altered."""
    joint = StoredJoint(load_groups(path, ("posterior", "prior", "alone", "fit"), "a joint estimate"))
    with understood(path):
        _ = joint.datasets, joint.cautions, joint.odd
    return joint


def load_groups(path: Path, groups: Sequence[str], what: str) -> xr.DataTree:
    """A file with ``groups`` in memory. Raises :class:`OutputError`: it is not ``what``, cut short or altered."""
    held = read_groups(path)
    if {f"/{group}" for group in groups} - set(held):
        raise OutputError(f"{path}: not {what}")
    with understood(path):
        return tree_of(held)
