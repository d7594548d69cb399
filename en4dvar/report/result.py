"""The result that a session works with: what is stored, and its figures."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from en4dvar.report import figures
from en4dvar.storage.store import StoredResult, load_stored


class Result(StoredResult):
    """The posterior of one data set; its figures are matplotlib's, in display units, and shown by a notebook."""

    def plot_histograms(self) -> Figure:
        """Posterior over prior, one panel a parameter."""
        return figures.histograms(self)

    def plot_history(self) -> Figure:
        """Data, prior and posterior predictive bands and the residuals of the centre."""
        return figures.history(self)

    def plot_pairs(self) -> Figure:
        """Posterior members of every pair of parameters with their correlation."""
        return figures.pairs(self)


def load_result(path: str | Path) -> Result:
    """Read a result file. Raises :class:`~en4dvar.errors.OutputError` as :func:`~en4dvar.storage.store.load_stored`."""
    return Result(load_stored(path).tree)
