"""A result without xarray, as its groups, in a hundredth of the time: what tables and estimates of many data sets
together are made of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.caution import Caution, worst_first
from en4dvar.errors import OutputError
from en4dvar.observations import Observations
from en4dvar.state import Array, Parameter
from en4dvar.storage.axes import Axis, axes_of
from en4dvar.storage.beside import BESIDE, joined
from en4dvar.storage.complete import check_complete, of_members
from en4dvar.storage.netcdf import Groups, Variable, datasets_of
from en4dvar.storage.pack import read_result
from en4dvar.storage.packed import unpacked
from en4dvar.storage.record import observations_of
from en4dvar.summary import ParameterSummary, living


@dataclass(frozen=True)
class PlainResult:
    """What :class:`~en4dvar.storage.store.StoredResult` shows through xarray, by the same names."""

    groups: Groups

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
    def cautions(self) -> tuple[Caution, ...]:
        """Why not to trust the posterior, or read it with care; the worst first."""
        return worst_first(map(Caution.parse, str(self.attributes["warnings"]).splitlines()))

    @property
    def alive(self) -> npt.NDArray[np.bool_]:
        """(N,) the members that survived the posterior forecast."""
        return np.asarray(self.groups["/sample_stats"].variables["active"].values.ravel(), dtype=bool)

    @property
    def log_likelihood(self) -> Array:
        """(N, K) of every member and reading, one series after the other."""
        held = self.groups["/log_likelihood"].variables
        return np.concatenate([held[axis.name].values[0] for axis in self.axes], axis=-1)

    def members(self, group: str, name: str) -> Array:
        """(N',) finite values of a parameter in ``group`` (prior or posterior), display unit, members in order."""
        values = np.asarray(self.groups[f"/{group}"].variables[name].values, dtype=float).ravel()
        return living(values, self.alive if group == "posterior" else True, self._parameter(name))

    def summary(self) -> tuple[ParameterSummary, ...]:
        """One row a parameter, as of :func:`~en4dvar.summary.summarise`."""
        stats, cautions = self.groups["/sample_stats"], self.cautions
        places = {str(name): i for i, name in enumerate(stats.every["parameter"].values)}

        def row(name: str) -> ParameterSummary:
            prior, posterior = self.members("prior", name), self.members("posterior", name)
            centre, dfs = (float(stats.variables[key].values[places[name]]) for key in ("centre", "dfs"))
            return ParameterSummary.of(self._parameter(name), prior, posterior, centre, dfs, cautions)

        return tuple(map(row, self.parameters))

    def centres(self, names: Sequence[str]) -> Array:
        """(n,) of the parameters, SI."""
        stats = self.groups["/sample_stats"]
        own = stats.every["parameter"].values.tolist()
        return np.asarray(stats.variables["centre"].values[[own.index(name) for name in names]], dtype=float)

    def observations(self) -> Observations:
        """As of :meth:`~en4dvar.storage.store.StoredResult.observations`, of which the file knows no prediction."""
        paths = ("/observed_data", f"/{BESIDE['observed_data']}")
        shown = datasets_of({path: self.groups[path] for path in paths if path in self.groups})
        return observations_of(joined(shown[paths[0]], shown.get(paths[1])), self.axes, self.name, {})

    def _parameter(self, name: str) -> Parameter:
        about = self.groups["/posterior"].variables[name].attrs
        return Parameter(
            name, about["units"], label=about["long_name"], symbol=about["symbol"], display_unit=about["display_units"]
        )


def load_plain(address: Path) -> PlainResult:
    """Read what is at an address in a pack.

    Raises
    ------
    OutputError: it is damaged, or no result of en4dvar.
    """
    try:
        groups = unpacked(read_result(address))
        for group in groups.values():
            group.check_sizes()
    except ValueError as error:  # anybody can write a checksum
        raise OutputError(f"{address}: not a result of en4dvar: {error}") from None
    check_complete(address, groups)
    return PlainResult(groups)
