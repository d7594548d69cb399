"""A stored result: what a run hands back, as its groups, without xarray; an analysis laid out in the ArviZ schema."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from en4dvar.data.observations import Observations
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.estimation.summary import ParameterSummary, brief, living, results_table
from en4dvar.model.forward import Observable
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import Caution, parsed
from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.results.complete import check_complete, joined, of_members
from en4dvar.results.declared import Axis, attributes_of, axes_of, group_of, lay_out, parameter_of
from en4dvar.results.netcdf import Group, Groups, Variable, read_groups, understood
from en4dvar.results.pack import PACK, read_result
from en4dvar.results.packed import unpacked
from en4dvar.results.record import observations_of
from en4dvar.results.scalars import ATTRIBUTES
from en4dvar.results.scopes import SCOPES
from en4dvar.results.variables import COORDINATES, GROUPS, OPTIONAL

NEXT = ".en4dvar-next"  # in a run directory: the run that replaces its result
COMPLETE = ".en4dvar-complete"  # in that: it is being put in place


@dataclass(frozen=True)
class StoredResult:
    """The posterior ensemble of one data set with everything that led to it: a thin view of ``groups``.

    Values are SI; members are draws of one chain; a failed member is NaN and ``active`` is False there.
    """

    groups: Groups

    @classmethod
    def from_analysis(cls, analysis: Analysis, attributes: Mapping[str, Any]) -> Self:
        """Lay out an analysis; ``attributes`` (see :func:`en4dvar.results.provenance.provenance`) join the root's."""
        return cls(build_groups(analysis, attributes))

    def with_attributes(self, path: str, /, **attributes: str) -> Self:
        """With other attributes of a group, ``"/"`` is the root."""
        group = self.groups[path]
        return type(self)({**self.groups, path: replace(group, attrs={**group.attrs, **attributes})})

    def group(self, name: str) -> Group:
        """A group of the file, e.g. ``"prior_predictive"``, with the variables of the group beside it."""
        return joined(self.groups, f"/{name}")

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Of the root."""
        return self.groups["/"].attrs

    @property
    def name(self) -> str:
        """Name of the data set."""
        return str(self.attributes["dataset"])

    @property
    def parameters(self) -> dict[str, Variable]:
        """Members (chain, draw) of the posterior, by parameter."""
        return of_members(self.groups["/posterior"])

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The series of the data set, and how their variables are called."""
        return axes_of(list(self.groups["/log_likelihood"].variables))

    @property
    def observable(self) -> str:
        """Name of the observed quantity; of several series that of the first."""
        return self.axes[0].name

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Why not to trust the posterior, or read it with care: code, severity, words, advice; the worst first."""
        return parsed(self.attributes["warnings"])

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)

    @property
    def alive(self) -> npt.NDArray[np.bool_]:
        """(N,) the members that survived the posterior forecast."""
        return np.asarray(self.groups["/sample_stats"]["active"].values.ravel(), dtype=bool)

    def of_readings(self, group: str, name: str, shared: bool = False) -> Array:
        """(…, K) of all readings, one series after the other: the variables ``<series>_<name>``, or of a single series
        ``name`` where that is ``shared``, as ``weights`` are."""
        held = self.group(group)
        return np.concatenate(
            [held[axis.own(name) if shared else f"{axis.name}_{name}"].values for axis in self.axes], axis=-1
        )

    def of_parameter(self, variable: str, name: str) -> float:
        """What ``variable`` of ``sample_stats`` is for a parameter, SI."""
        stats = self.groups["/sample_stats"]
        return float(stats[variable].values[stats["parameter"].values.tolist().index(name)])

    def members(self, group: str, name: str) -> Array:
        """(N',) finite values of a parameter in ``group`` (prior or posterior), display unit, members in order."""
        values = np.asarray(self.groups[f"/{group}"][name].values, dtype=float).ravel()
        return living(values, self.alive if group == "posterior" else True, self._parameter(name))

    @property
    def rows(self) -> tuple[ParameterSummary, ...]:
        """One row a parameter, as of :func:`~en4dvar.estimation.summary.summarise`."""
        cautions = self.cautions

        def row(name: str) -> ParameterSummary:
            prior, posterior = self.members("prior", name), self.members("posterior", name)
            centre, dfs = (self.of_parameter(key, name) for key in ("centre", "dfs"))
            return ParameterSummary.of(self._parameter(name), prior, posterior, centre, dfs, cautions)

        return tuple(map(row, self.parameters))

    def centres(self, names: Sequence[str]) -> Array:
        """(n,) of the parameters, SI."""
        return np.array([self.of_parameter("centre", name) for name in names])

    def observations(self, observables: Mapping[str, Observable] | None = None) -> Observations:
        """The observations (y, t, R) that the result was estimated from, to the bit.

        ``observables``: what the series hold, by their names; the file does not know how a model predicts them.
        """
        later = self.groups.get("/withheld")
        return observations_of(self.group("observed_data"), self.axes, self.name, observables or {}, later)

    @property
    def ended(self) -> str:
        """How the fit ended, in words."""
        s = self.groups["/sample_stats"].attrs
        ended = f"{'converged' if s['converged'] else 'not converged'}: {s['stop_reason']}"
        return f"{ended}; chi2/K {s['chi2_per_observation']:.3g}, NRMSE {s['nrmse']:.3g}, DFS {s['dfs']:.3g}"

    def __repr__(self) -> str:
        ended = "converged" if self.groups["/sample_stats"].attrs["converged"] else "not converged"
        warned = f", {len(self.warnings)} warning{'s' * (len(self.warnings) > 1)}" if self.warnings else ""
        return f"<{type(self).__name__} {self.name}: {brief(self.rows)}; {ended}{warned}>"

    def __str__(self) -> str:
        """The summary as a table (display units), how the fit ended, and the warnings."""
        parts = [results_table({self.name: self.rows}), self.ended]
        return "\n".join([*parts, *(f"{caution.kind}: {caution.words}" for caution in self.cautions)])

    def _parameter(self, name: str) -> Parameter:
        return parameter_of(name, self.groups["/posterior"][name].attrs)


def require_settled(run_dir: Path) -> None:
    """Raise :class:`OutputError` where files of two runs may lie side by side."""
    if (run_dir / NEXT / COMPLETE).exists():
        raise OutputError(
            f"{run_dir}: a run was killed while its files took the place of an earlier run's; 'en4dvar run' with "
            "--resume finishes that"
        )


def load_stored(path: str | Path) -> StoredResult:
    """Read ``posterior.nc`` into memory and close it, or what is at an address in a pack.

    Raises
    ------
    OutputError: it is no result, of another version, cut short or altered (see :mod:`en4dvar.results.seal`).
    """
    path = Path(path)
    with retold(ValueError, OutputError, f"{path}: not a result of en4dvar: "):  # anybody can write a checksum
        groups = unpacked(read_result(path)) if path.parent.name == PACK else read_groups(path)
        for path_in_file, group in groups.items():
            group.check()
            joined(groups, path_in_file).check()
    with understood(path):
        check_complete(path, groups)
    return StoredResult(groups)


def build_groups(a: Analysis, attributes: Mapping[str, Any]) -> dict[str, Group]:
    """All groups of an analysis by path; ``attributes`` are added to the root's and win over the defaults."""
    coordinates = lay_out(COORDINATES, a, SCOPES)
    groups = {"/": group_of({}, {}, {**attributes_of(ATTRIBUTES["/"], a), **attributes})}
    for path, table in GROUPS.items():
        variables = lay_out(table, a, SCOPES)
        if variables or path not in OPTIONAL:
            groups[path] = group_of(variables, coordinates, attributes_of(ATTRIBUTES.get(path, ()), a))
    return groups
