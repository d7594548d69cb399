"""Result ⇄ netCDF: what a run hands back, written as one file that xarray, ArviZ and ncdump open as it is."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import xarray as xr

from en4dvar.analysis import Analysis
from en4dvar.caution import Caution
from en4dvar.diagnostics import active_members
from en4dvar.errors import OutputError
from en4dvar.files import write_bytes
from en4dvar.state import Array, Parameter
from en4dvar.storage.groups import about, build_groups
from en4dvar.storage.netcdf import to_bytes, tree_of
from en4dvar.storage.seal import check_seal
from en4dvar.tables import table
from en4dvar.units import convert

if TYPE_CHECKING:
    import pandas as pd

GROUPS = ("prior", "posterior", "posterior_predictive", "observed_data", "sample_stats", "iterations")


@dataclass(frozen=True)
class ParameterSummary:
    """One row of the summary table; all values in ``unit``, the display unit."""

    name: str
    label: str
    symbol: str
    unit: str
    prior_mean: float
    prior_std: float
    mean: float
    std: float
    q05: float
    q50: float
    q95: float
    centre: float
    dfs: float

    @classmethod
    def of(
        cls, name: str, about: Mapping[Any, Any], prior: Array, posterior: Array, centre: float, dfs: float
    ) -> ParameterSummary:
        """Of members (N',) that are alive, display unit; the centre is SI. ``about``: attributes of the variable."""
        prior_mean, prior_std = _moments(prior)
        mean, std = _moments(posterior)
        q05, q50, q95 = np.quantile(posterior, (0.05, 0.5, 0.95)) if posterior.size else (np.nan,) * 3
        return cls(
            name=name,
            label=about["long_name"],
            symbol=about["symbol"],
            unit=about["display_units"],
            prior_mean=prior_mean,
            prior_std=prior_std,
            mean=mean,
            std=std,
            q05=float(q05),
            q50=float(q50),
            q95=float(q95),
            centre=convert(centre, about["units"], about["display_units"]),
            dfs=dfs,
        )


def summarise(analysis: Analysis) -> tuple[ParameterSummary, ...]:
    """:meth:`StoredResult.summary` without the detour through a tree."""
    alive = active_members(analysis.posterior_failures)

    def row(j: int, p: Parameter) -> ParameterSummary:
        prior = _living(analysis.prior[:, j], True, p.unit, p.display_unit)
        posterior = _living(analysis.posterior[:, j], alive, p.unit, p.display_unit)
        centre, dfs = float(analysis.centre[j]), float(analysis.dfs_per_parameter[j])
        return ParameterSummary.of(p.name, about(p), prior, posterior, centre, dfs)

    return tuple(row(j, p) for j, p in enumerate(analysis.parameters))


def results_table(summaries: Mapping[str, Iterable[ParameterSummary]]) -> str:
    """Posterior mean, std and 5/50/95 % of every parameter (data set → its rows), in display units."""
    header = ("data set", "parameter", "unit", "mean", "std", "5 %", "50 %", "95 %")
    rows = [
        (name, row.name, row.unit, *(f"{v:.4g}" for v in (row.mean, row.std, row.q05, row.q50, row.q95)))
        for name, summary in summaries.items()
        for row in summary
    ]
    return table([header, *rows])


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

    @property
    def prior(self) -> xr.Dataset:
        """Parameters (chain, draw) before the data."""
        return self.dataset("prior")

    @property
    def posterior(self) -> xr.Dataset:
        """Parameters (chain, draw) given the data."""
        return self.dataset("posterior")

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
        """Name of the observed quantity."""
        return str(next(iter(self.dataset("log_likelihood").data_vars)))

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Why not to trust the posterior, or read it with care: code, severity, words, advice; the worst first."""
        return tuple(map(Caution.parse, str(self.tree.attrs["warnings"]).splitlines()))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)

    def dataset(self, group: str) -> xr.Dataset:
        """A group of the file, e.g. ``"prior_predictive"``."""
        return self.tree.children[group].to_dataset()

    def members(self, group: str, name: str) -> Array:
        """(N',) finite values of a parameter in ``group`` (prior or posterior), display unit, members in order."""
        variable = self.dataset(group)[name]
        values = np.asarray(variable.values, dtype=float).ravel()
        alive = self.sample_stats["active"].values.ravel() if group == "posterior" else True
        return _living(values, alive, variable.attrs["units"], variable.attrs["display_units"])

    def summary(self) -> tuple[ParameterSummary, ...]:
        """One row a parameter: prior, mean, std (N−1), 5/50/95 %, centre, DFS; NaN where too few members live."""
        return tuple(self._summarise(str(name)) for name in self.posterior.data_vars)

    def _summarise(self, name: str) -> ParameterSummary:
        about, at = self.posterior[name].attrs, self.sample_stats.sel(parameter=name)
        prior, posterior = self.members("prior", name), self.members("posterior", name)
        return ParameterSummary.of(name, about, prior, posterior, float(at["centre"]), float(at["dfs"]))

    def to_dataframe(self) -> pd.DataFrame:
        """Posterior members as rows (index ``draw``), parameters as columns, SI; NaN where a member failed."""
        return self.posterior.isel(chain=0, drop=True).to_dataframe()

    def __str__(self) -> str:
        """The summary as a table (display units), how the fit ended, and the warnings."""
        s = self.sample_stats.attrs
        ended = f"{'converged' if s['converged'] else 'not converged'}: {s['stop_reason']}"
        fit = f"chi2/K {s['chi2_per_observation']:.3g}, NRMSE {s['nrmse']:.3g}, DFS {s['dfs']:.3g}"
        parts = [results_table({self.name: self.summary()}), f"{ended}; {fit}"]
        return "\n".join([*parts, *(f"{caution.kind}: {caution.words}" for caution in self.cautions)])


def _living(values: Array, alive: Any, unit: str, display_unit: str) -> Array:
    """Finite values (N,) of members alive, in the display unit."""
    return np.asarray(convert(values[np.isfinite(values) & alive], unit, display_unit))


def _moments(values: Array) -> tuple[float, float]:
    if values.size < 2:
        return (float(values[0]) if values.size else np.nan), np.nan
    return float(values.mean()), float(values.std(ddof=1))


def save(result: StoredResult, path: str | Path) -> Path:
    """Write ``path`` (NETCDF4); it appears complete or not at all. Raises :class:`OutputError`."""
    return write_bytes(path, to_bytes(result.tree))


def load_stored(path: str | Path) -> StoredResult:
    """Read a file of :func:`save` into memory and close it.

    Raises
    ------
    OutputError: it is not one, of another version, cut short or altered (see :mod:`en4dvar.storage.seal`).
    """
    path = Path(path)
    check_seal(path)
    try:
        with xr.open_datatree(path, engine="netcdf4", decode_timedelta=False) as tree:
            # a plain copy: the file can be replaced (or deleted) while the result is in use
            nodes = {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    except OSError as error:
        raise OutputError(f"{path}: not a readable netCDF file: {error.strerror or error}") from None
    missing = [group for group in GROUPS if f"/{group}" not in nodes]
    if missing:
        raise OutputError(f"{path}: not a result of en4dvar: no group {', '.join(missing)}")
    return StoredResult(xr.DataTree.from_dict(nodes))
