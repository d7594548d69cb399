"""What twin experiments and sequences hand back to a session: in words, as a table, as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from en4dvar.plumbing.tables import table
from en4dvar.report.sequence import sequence_figures
from en4dvar.report.svg import on_paper
from en4dvar.report.twin import scores as scores_in_time
from en4dvar.results.series_file import estimates, series_group
from en4dvar.series.problem import SeriesResult
from en4dvar.series.twin import TwinResult

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


class TwinOutcome(TwinResult):
    """A twin experiment's truth, observations and estimates; ``scores`` by estimate."""

    def __repr__(self) -> str:
        own = self.experiment
        scores = [f"{name} RMSE {s.mean_rmse:.3g}, spread {s.mean_spread:.3g}" for name, s in self.scores.items()]
        return f"<TwinOutcome: {own.members} members, {own.cycles} cycles; {'; '.join(scores)}>"

    def __str__(self) -> str:
        return "\n".join([scores_table(self), *(f"warning: {words}" for words in self.warnings)])

    def summary(self) -> pd.DataFrame:
        """RMSE and spread after the burn-in, a row an estimate."""
        from en4dvar.plumbing.whole_table import WholeTable

        rows = {name: (score.mean_rmse, score.mean_spread) for name, score in self.scores.items()}
        return WholeTable.from_dict(rows, orient="index", columns=["rmse", "spread"])

    def plot(self) -> Figure:
        """RMSE and spread in time."""
        return on_paper(scores_in_time(series_group(self, {})))


class SequenceOutcome(SeriesResult):
    """The state and parameters along a series of data."""

    def __repr__(self) -> str:
        told = [f"{name} {mean:.4g} ± {std:.2g} {unit}".removesuffix(" 1") for name, mean, std, unit in estimates(self)]
        more = f" and {len(told) - MOST} more" if len(told) > MOST else ""
        about = f"{self.problem.name}, {len(self.problem.series.times)} times"
        return f"<SequenceOutcome {about}; at the end {', '.join(told[:MOST])}{more}>"

    def __str__(self) -> str:
        return "\n".join([estimates_table(self), *(f"warning: {words}" for words in self.warnings)])

    def summary(self) -> pd.DataFrame:
        """Mean and standard deviation at the last time, a row a variable."""
        from en4dvar.plumbing.whole_table import WholeTable

        return WholeTable(estimates(self), columns=["variable", "mean", "std", "unit"]).set_index("variable")

    def plot(self) -> Figure:
        """The state in time, or the parameters where it is known."""
        _, _, chart = next(sequence_figures(series_group(self, {})))
        return on_paper(chart)


MOST = 4  # variables in one line


def scores_table(result: TwinResult) -> str:
    """RMSE and spread after the burn-in as an aligned table."""
    rows = [(name, f"{s.mean_rmse:.4g}", f"{s.mean_spread:.4g}") for name, s in result.scores.items()]
    return table([("estimate", "RMSE", "spread"), *rows])


def estimates_table(result: SeriesResult) -> str:
    """State and parameters at the last time as an aligned table."""
    rows = [(name, f"{mean:.5g}", f"{std:.3g}", unit) for name, mean, std, unit in estimates(result)]
    return table([("at the end", "mean", "std", "unit"), *rows])
