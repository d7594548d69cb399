"""Result ⇄ netCDF: what a run hands back, written as one file that xarray, ArviZ and ncdump open as it is."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from en4dvar.analysis import Analysis
from en4dvar.caution import Caution
from en4dvar.errors import OutputError
from en4dvar.forward import Observable
from en4dvar.observations import Observations
from en4dvar.state import Array
from en4dvar.storage.axes import Axis
from en4dvar.storage.beside import BESIDE, joined
from en4dvar.storage.complete import check_complete
from en4dvar.storage.groups import build_groups
from en4dvar.storage.netcdf import groups_of, netcdf_file, read_groups, tree_of
from en4dvar.storage.pack import PACK, results_of
from en4dvar.storage.plain import PlainResult, load_plain
from en4dvar.storage.readings import MEMBER
from en4dvar.storage.record import observations_of
from en4dvar.summary import ParameterSummary, results_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NEXT = ".en4dvar-next"  # in a run directory: the run that replaces its result
COMPLETE = ".en4dvar-complete"  # in that: it is being put in place


@dataclass(frozen=True)
class StoredResult:
    """The posterior ensemble of one data set with everything that led to it: a thin view of ``tree``.

    Values are SI; members are draws of one chain; a failed member is NaN and ``sample_stats.active`` is False there.
    """

    tree: xr.DataTree

    @classmethod
    def from_analysis(cls, analysis: Analysis, attributes: Mapping[str, Any]) -> Self:
        """Lay out an analysis; ``attributes`` (see :func:`en4dvar.storage.provenance.provenance`) join the root's."""
        return cls(tree_of(build_groups(analysis, attributes)))

    @cached_property
    def plain(self) -> PlainResult:
        """The same without xarray."""
        return PlainResult(groups_of({node.path: node.to_dataset(inherit=False) for node in self.tree.subtree}))

    @property
    def prior(self) -> xr.Dataset:
        """Parameters (chain, draw) before the data."""
        return _of_members(self.dataset("prior"))

    @property
    def posterior(self) -> xr.Dataset:
        """Parameters (chain, draw) given the data."""
        return _of_members(self.dataset("posterior"))

    @property
    def observed_data(self) -> xr.Dataset:
        """Observations (time), their error std and weights."""
        return self.dataset("observed_data")

    @property
    def sample_stats(self) -> xr.Dataset:
        """Members alive and reasons (chain, draw), centre and DFS (parameter); scalars of the fit as attributes."""
        return self.dataset("sample_stats")

    @property
    def iterations(self) -> xr.Dataset:
        """J and its terms (iteration), parameters (iteration, draw)."""
        return self.dataset("iterations")

    @property
    def attributes(self) -> Mapping[Hashable, Any]:
        """Root attributes of the file."""
        return self.tree.attrs

    @property
    def name(self) -> str:
        """Name of the data set."""
        return str(self.tree.attrs["dataset"])

    @property
    def observable(self) -> str:
        """Name of the observed quantity; of several series that of the first."""
        return self.axes[0].name

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The series of the data set, and how their variables are called."""
        return self.plain.axes

    def of_readings(self, group: str, name: str, shared: bool = False) -> Array:
        """(…, K) of all readings, one series after the other: the variables ``<series>_<name>``, or of a single series
        ``name`` where that is ``shared``, as ``weights`` are."""
        data = self.dataset(group)
        names = [axis.own(name) if shared else f"{axis.name}_{name}" if name else axis.name for axis in self.axes]
        return np.concatenate([np.asarray(data[one].values) for one in names], axis=-1)

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Why not to trust the posterior, or read it with care: code, severity, words, advice; the worst first."""
        return self.plain.cautions

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)

    def dataset(self, group: str) -> xr.Dataset:
        """A group of the file, e.g. ``"prior_predictive"``, with the variables of the group beside it."""
        found = {
            name: node.to_dataset() for name, node in self.tree.children.items() if name in (group, BESIDE.get(group))
        }
        return joined(found[group], found.get(BESIDE.get(group, "")))

    def observations(self, observables: Mapping[str, Observable] | None = None) -> Observations:
        """The observations (y, t, R) that the result was estimated from, to the bit.

        ``observables``: what the series hold, by their names; the file does not know how a model predicts them.
        """
        return observations_of(self.observed_data, self.axes, self.name, observables or {})

    def members(self, group: str, name: str) -> Array:
        """(N',) finite values of a parameter in ``group`` (prior or posterior), display unit, members in order."""
        return self.plain.members(group, name)

    @property
    def alive(self) -> npt.NDArray[np.bool_]:
        """(N,) the members that survived the posterior forecast."""
        return self.plain.alive

    def summary(self) -> tuple[ParameterSummary, ...]:
        """One row a parameter, as of :func:`~en4dvar.summary.summarise`."""
        return self.plain.summary()

    def to_dataframe(self) -> pd.DataFrame:
        """Posterior members as rows (index ``draw``), parameters as columns, SI; NaN where a member failed."""
        return self.posterior.isel(chain=0, drop=True).to_dataframe()

    @property
    def ended(self) -> str:
        """How the fit ended, in words."""
        s = self.sample_stats.attrs
        ended = f"{'converged' if s['converged'] else 'not converged'}: {s['stop_reason']}"
        return f"{ended}; chi2/K {s['chi2_per_observation']:.3g}, NRMSE {s['nrmse']:.3g}, DFS {s['dfs']:.3g}"

    def __str__(self) -> str:
        """The summary as a table (display units), how the fit ended, and the warnings."""
        parts = [results_table({self.name: self.summary()}), self.ended]
        return "\n".join([*parts, *(f"{caution.kind}: {caution.words}" for caution in self.cautions)])


def save(result: StoredResult, path: str | Path) -> Path:
    """Write ``path`` (NETCDF4) through xarray; it appears complete or not at all. Raises :class:`OutputError`."""
    with netcdf_file(Path(path)) as partial:
        result.tree.to_netcdf(partial, engine="netcdf4")
    return Path(path)


def require_settled(run_dir: Path) -> None:
    """Raise :class:`OutputError` where files of two runs may lie side by side."""
    if (run_dir / NEXT / COMPLETE).exists():
        raise OutputError(
            f"{run_dir}: a run was killed while its files took the place of an earlier run's; 'en4dvar run' with "
            "--resume finishes that"
        )


def result_files(run_dir: Path) -> list[Path]:
    """Where the results of a run directory's data sets are, by name; of a single one ``posterior.nc``, which need not
    exist.

    Raises :class:`OutputError` as :func:`require_settled`, and of a campaign of an earlier version.
    """
    require_settled(run_dir)
    if (run_dir / PACK).exists():
        return results_of(run_dir / PACK) or [run_dir / "posterior.nc"]
    if (run_dir / "datasets").is_dir():
        raise OutputError(
            f"{run_dir}: a campaign of an earlier version of en4dvar, with a file for each data set in datasets/; run "
            "it again, or read these files one by one (load_result)"
        )
    return [run_dir / "posterior.nc"]


def load_stored(path: str | Path) -> StoredResult:
    """Read a file of :func:`save` into memory and close it, or what is at an address in a pack.

    Raises
    ------
    OutputError: it is not one, of another version, cut short or altered (see :mod:`en4dvar.storage.seal`).
    """
    import xarray as xr

    path = Path(path)
    if path.parent.name == PACK:
        try:
            return StoredResult(tree_of(load_plain(path).groups))
        except ValueError as error:  # of xarray; anybody can write a checksum
            raise OutputError(f"{path}: not a result of en4dvar: {error}") from None
    nodes = read_groups(path)
    check_complete(path, groups_of(nodes))
    return StoredResult(xr.DataTree.from_dict(nodes))


def plain_result(path: Path) -> PlainResult:
    """What :func:`load_stored` gives, of an address without xarray. Raises :class:`OutputError`."""
    return load_plain(path) if path.parent.name == PACK else load_stored(path).plain


def _of_members(dataset: xr.Dataset) -> xr.Dataset:
    """A group of parameters without the values of pieces of time: what has one number a member."""
    return dataset[[name for name, variable in dataset.data_vars.items() if variable.dims == MEMBER]]
