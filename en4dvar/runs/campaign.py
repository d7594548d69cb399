"""What a run leaves behind: for each of up to 10⁵ data sets its file or the reason of its failure, read when asked."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from en4dvar.estimation.summary import ParameterSummary, frame, results_table
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.errors import OutputError, TooFewMembersError, retold
from en4dvar.plumbing.hints import counted
from en4dvar.results.checkpoint import decode
from en4dvar.results.pack import Entry, read_outcome

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from en4dvar.report.result import Result


@dataclass(frozen=True)
class DatasetOutcome:
    """``file`` is the posterior's netCDF, with its ``sha256``, or None where ``failure`` says why there is none.
    ``exit_code`` is that of the failure (1, 2 or 3), 0 where there is none.
    """

    name: str
    file: Path | None = None
    failure: str = ""
    exit_code: int = 0
    warnings: tuple[Caution, ...] = ()
    summary: tuple[ParameterSummary, ...] = ()
    n_observations: int = 0
    sha256: str = ""
    remarks: tuple[str, ...] = ()  # that the terminal shows below the table
    lines: str = ""  # of ``summary.csv``


@dataclass(frozen=True)
class Campaign:
    """The outcome of a run over any number of data sets, in their order; posteriors are read from disk when asked for.

    ``notices`` are what the run itself found worth a warning, e.g. a damaged checkpoint. ``failed``: the outcomes
    without a posterior, where they are known without reading all of them.
    """

    directory: Path
    outcomes: Sequence[DatasetOutcome]
    notices: tuple[str, ...] = ()
    failed: tuple[DatasetOutcome, ...] | None = None

    @cached_property
    def failures(self) -> tuple[DatasetOutcome, ...]:
        """The data sets without a posterior."""
        return tuple(o for o in self.outcomes if o.failure) if self.failed is None else self.failed

    @property
    def exit_code(self) -> int:
        """0: every data set has a posterior; 3: all failures are lost ensembles; 1: others failed."""
        codes = {o.exit_code for o in self.failures}
        return max(codes, default=0) if codes <= {TooFewMembersError.exit_code} else 1

    def __repr__(self) -> str:
        failed = f", {len(self.failures)} without a posterior" if self.failures else ""
        return f"<Campaign of {counted(len(self.outcomes), 'data set')} in {self.directory}{failed}>"

    def __str__(self) -> str:
        """The table of all data sets."""
        return results_table({o.name: o.summary for o in self.outcomes if not o.failure})

    def summary(self) -> "pd.DataFrame":
        """A row a data set and parameter, in display units; NaN where a number is not to be quoted."""
        return frame({o.name: o.summary for o in self.outcomes if not o.failure})

    def plot(self) -> "Figure":
        """The estimates of all data sets side by side."""
        from en4dvar.report.page import SetSummary, estimates
        from en4dvar.report.paper import on_paper

        return on_paper(estimates([SetSummary.of(result, result.name) for result in self]))

    def __len__(self) -> int:
        return len(self.outcomes) - len(self.failures)

    def __iter__(self) -> "Iterator[Result]":
        """Posteriors, one after the other; none is kept."""
        from en4dvar.report.result import load_result  # what draws pages is slow to import

        return (load_result(o.file) for o in self.outcomes if o.file is not None)

    def __getitem__(self, name: str) -> "Result":
        """The posterior of a data set. Raises :class:`KeyError` where it is unknown or has failed."""
        from en4dvar.report.result import load_result

        for outcome in self.outcomes:
            if outcome.name == name and outcome.file is not None:
                return load_result(outcome.file)
        raise KeyError(name)


class Outcomes(Sequence[DatasetOutcome]):
    """Each is read when it is asked for, which raises :class:`OutputError` where it was altered.

    ``folder``: of the run. ``record``: the pack in it; ``entries``: what that holds. ``files``: name of the data set in
    the pack → where its posterior is in the folder.
    """

    def __init__(self, folder: Path, record: str, entries: Mapping[str, Entry], files: Mapping[str, str]):
        self._folder, self._record, self._entries = folder, folder / record, entries
        self._files, self._stems = files, tuple(files)

    def __len__(self) -> int:
        return len(self._stems)

    def __getitem__(self, index: Any) -> Any:
        stems = self._stems[index]
        return self._read(stems) if isinstance(stems, str) else tuple(map(self._read, stems))

    def lines(self) -> Iterator[str]:
        """Those of ``summary.csv`` of each data set; the rest of what is known of it is not looked at."""
        for stem in self._stems:
            with retold((ValueError, LookupError, TypeError), OutputError, f"{self._record / stem}: "):
                yield str(json.loads(self._raw(stem))["lines"])

    def _raw(self, stem: str) -> bytes:
        return read_outcome(self._record, stem, self._entries[stem])

    def _read(self, stem: str) -> DatasetOutcome:
        with retold(ValueError, OutputError, f"{self._record / stem}: "):  # anybody can write a checksum
            outcome = decode(self._raw(stem), DatasetOutcome)
        return outcome if outcome.failure else replace(outcome, file=self._folder / self._files[stem])
