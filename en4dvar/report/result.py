"""The result that a session works with: what is stored as xarray shows it, its figures, and what a notebook shows."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from en4dvar.estimation.summary import estimate_cells, frame
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.hints import listed, shown, suggest
from en4dvar.plumbing.units import convert
from en4dvar.report import figures
from en4dvar.report.history import history
from en4dvar.report.html import render
from en4dvar.report.page import render_set
from en4dvar.report.paper import on_paper
from en4dvar.results.netcdf import dataset_of, to_bytes, tree_of
from en4dvar.results.store import StoredResult, load_stored, of_members, posterior_file

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

FEWEST_DRAWS = 4  # of a chain: ArviZ's diagnostics need as many


class Result(StoredResult):
    """The posterior of one data set through xarray; figures are matplotlib's, in display units.

    ``posterior["G"].values[0]`` are the members (N,) of G, SI, NaN where one failed. What xarray shows is a view:
    a change of it changes neither the figures nor what :meth:`save` writes.
    """

    @cached_property
    def tree(self) -> xr.DataTree:
        """All groups of the file."""
        return tree_of(self.groups)

    def dataset(self, group: str) -> xr.Dataset:
        """A group of the file, e.g. ``"prior_predictive"``, with the variables of the group beside it. Raises
        :class:`ConfigError`: there is none of the name.
        """
        if f"/{group}" not in self.groups:
            there = sorted(name.strip("/") for name in self.groups if name != "/")
            raise ConfigError(f"no group {shown(group)}{suggest(str(group), there)}; there are {listed(there)}")
        return dataset_of(self.group(group))

    @property
    def prior(self) -> xr.Dataset:
        """Parameters (chain, draw) before the data."""
        return self.dataset("prior")[list(of_members(self.groups["/prior"]))]

    @property
    def posterior(self) -> xr.Dataset:
        """Parameters (chain, draw) given the data."""
        return self.dataset("posterior")[list(of_members(self.groups["/posterior"]))]

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

    def summary(self) -> pd.DataFrame:
        """The posterior in a few numbers, a row a parameter, in display units; NaN where one is not to be quoted."""
        return frame({self.name: self.rows}).droplevel("dataset")

    def to_dataframe(self) -> pd.DataFrame:
        """Posterior members as rows (index ``draw``), parameters as columns, SI; NaN where a member failed."""
        return self.posterior.isel(chain=0, drop=True).to_dataframe()

    def plot(self) -> Figure:
        """The fit, as :meth:`plot_history`."""
        return self.plot_history()

    def plot_histograms(self) -> Figure:
        """Posterior over prior, one panel a parameter. Raises :class:`OutputError`: there is none, only fields."""
        return on_paper(figures.histograms(self._with_parameters()))

    def plot_history(self) -> Figure:
        """Data, prior and posterior predictive bands and the residuals of the centre."""
        return on_paper(history(self))

    def plot_pairs(self) -> Figure:
        """Posterior members of every pair of parameters with their correlation. Raises as :meth:`plot_histograms`."""
        return on_paper(figures.pairs(self._with_parameters()))

    def _with_parameters(self) -> Result:
        if not self.rows:
            raise OutputError("no parameter was estimated, only fields, which 'report' draws on the page of the result")
        return self

    def save(self, path: str | Path) -> Path:
        """Write one netCDF file, which :func:`load_result` reads again. Raises :class:`OutputError`."""
        if Path(path).suffix != ".nc":
            raise OutputError(f"{path}: name a file that ends in .nc; a whole run directory is written by a run")
        return to_bytes(self.groups).write(Path(path))

    def report(self, path: str | Path) -> Path:
        """Write the page of the result as one HTML file. Raises :class:`OutputError`."""
        if Path(path).suffix != ".html":
            raise OutputError(f"{path}: name a file that ends in .html")
        return write_text(Path(path), render_set(self))

    def to_inference_data(self, units: Literal["SI", "display"] = "SI", chains: int = 1) -> Any:
        """What ArviZ works with: the groups as its ``InferenceData``; from version 1 on that is a DataTree.

        ``units``: those of parameters and readings. ``chains``: the members that are alive, which have no order, are
        dealt out to so many, for plots and diagnostics that compare chains; what is left over is left out, as members
        are that failed.

        Raises :class:`ConfigError` where ArviZ is not installed, or members are too few for the chains.
        """
        try:
            import arviz
        except ImportError:
            raise ConfigError("to_inference_data needs ArviZ: pip install arviz") from None
        groups = {path.strip("/"): node.to_dataset() for path, node in self.tree.children.items()}
        if units == "display":
            groups = {name: _in_display_units(group) for name, group in groups.items()}
        if chains != 1 or 0 < self.alive.sum() < len(self.alive):
            groups = {name: self._dealt(group, chains) for name, group in groups.items()}
        known = vars(arviz).get("InferenceData")  # asked for as an attribute, it is a warning from version 1.3 on
        if known is None or isinstance(self.tree, known):
            from xarray import DataTree

            return DataTree.from_dict({"/": self.tree.to_dataset(), **groups})
        return known(attrs=dict(self.attributes), **groups)

    def _dealt(self, group: xr.Dataset, chains: int) -> xr.Dataset:
        """The living members of a group as ``chains`` of equal length."""
        import xarray as xr

        if not {"chain", "draw"} <= {*group.dims}:
            return group
        each = int(self.alive.sum()) // max(chains, 1)
        if each < FEWEST_DRAWS and chains != 1:
            raise ConfigError(f"{self.alive.sum()} members are too few for {chains} chains of {FEWEST_DRAWS} draws")
        living = np.flatnonzero(self.alive)[: each * chains].reshape(chains, each)
        chosen = group.isel(chain=0, draw=xr.DataArray(living, dims=("own", "among")))
        dealt = chosen.drop_vars(["chain", "draw"], errors="ignore").rename(own="chain", among="draw")
        return dealt.transpose("chain", "draw", ...)

    def _repr_html_(self) -> str:
        """A piece of HTML; everything in it is escaped."""
        rows = [(row.label, row.unit, *estimate_cells(row), f"{row.dfs:z.2f}") for row in self.rows]
        return render("notebook.html.j2", result=self, rows=rows)


def _in_display_units(group: xr.Dataset) -> xr.Dataset:
    """With the variables that have one in their display unit."""
    shown = {}
    for name, variable in group.data_vars.items():
        unit, display = variable.attrs.get("units"), variable.attrs.get("display_units")
        if unit and display and unit != display:
            shown[name] = variable.copy(data=convert(variable.values, unit, display)).assign_attrs(units=display)
    return group.assign(shown)


def load_result(path: str | Path) -> Result:
    """Read a result file, or the one in a run's directory. Raises :class:`OutputError` as :func:`load_stored`."""
    return Result(load_stored(posterior_file(path) if Path(path).is_dir() else path).groups)
