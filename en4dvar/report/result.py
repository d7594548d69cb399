"""The result that a session works with: what is stored as xarray shows it, and its figures."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from en4dvar.errors import OutputError
from en4dvar.files import write_text
from en4dvar.report import figures
from en4dvar.report.drawing import draw
from en4dvar.report.notebook import cell_html
from en4dvar.report.page import IDENTIFIERS, render_set
from en4dvar.storage.netcdf import to_bytes
from en4dvar.storage.readings import MEMBER
from en4dvar.storage.store import StoredResult, load_stored
from en4dvar.storage.xarrays import dataset_of, tree_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

    from en4dvar.report.chart import Chart


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
        """A group of the file, e.g. ``"prior_predictive"``, with the variables of the group beside it."""
        return dataset_of(self.group(group))

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

    def to_dataframe(self) -> pd.DataFrame:
        """Posterior members as rows (index ``draw``), parameters as columns, SI; NaN where a member failed."""
        return self.posterior.isel(chain=0, drop=True).to_dataframe()

    def plot_histograms(self) -> Figure:
        """Posterior over prior, one panel a parameter."""
        return _on_paper(figures.histograms(self))

    def plot_history(self) -> Figure:
        """Data, prior and posterior predictive bands and the residuals of the centre."""
        return _on_paper(figures.history(self))

    def plot_pairs(self) -> Figure:
        """Posterior members of every pair of parameters with their correlation."""
        return _on_paper(figures.pairs(self))

    def save(self, path: str | Path) -> Path:
        """Write one netCDF file, which :func:`load_result` reads again. Raises :class:`OutputError`."""
        if Path(path).suffix != ".nc":
            raise OutputError(f"{path}: name a file that ends in .nc; a whole run directory is written by a run")
        return to_bytes(self.groups).write(Path(path))

    def report(self, path: str | Path) -> Path:
        """Write the page of the result as one HTML file. Raises :class:`OutputError`."""
        if Path(path).suffix != ".html":
            raise OutputError(f"{path}: name a file that ends in .html")
        drawn = draw(figures.all_figures(self), IDENTIFIERS)
        return write_text(Path(path), render_set(self, drawn, copies=False))

    def to_inference_data(self) -> Any:
        """What ArviZ works with: the groups as its ``InferenceData``; from version 1 on that is a DataTree.

        Raises ImportError where ArviZ is not installed.
        """
        import arviz

        groups = {path.strip("/"): node.to_dataset() for path, node in self.tree.children.items()}
        known = getattr(arviz, "InferenceData", None)
        return (
            self.tree if known is None or isinstance(self.tree, known) else known(attrs=dict(self.attributes), **groups)
        )

    def _repr_html_(self) -> str:
        return cell_html(self)


def _on_paper(chart: Chart) -> Figure:
    from en4dvar.report.paper import on_paper  # matplotlib takes time to import

    return on_paper(chart)


def load_result(path: str | Path) -> Result:
    """Read a result file. Raises :class:`~en4dvar.errors.OutputError` as :func:`~en4dvar.storage.store.load_stored`."""
    return Result(load_stored(path).groups)


def _of_members(dataset: xr.Dataset) -> xr.Dataset:
    """A group of parameters without the values of pieces of time: what has one number a member."""
    return dataset[[name for name, variable in dataset.data_vars.items() if variable.dims == MEMBER]]
