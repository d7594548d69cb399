"""How the data sets of a run ended, as it is on disk: of 10⁵ sets nothing is in memory that was not asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

from en4dvar.plumbing.errors import OutputError
from en4dvar.results.codec import decode_text
from en4dvar.results.pack import Entry, read_outcome
from en4dvar.runs.campaign import DatasetOutcome


class Outcomes(Sequence[DatasetOutcome]):
    """Each is read when it is asked for, which raises :class:`OutputError` where it was altered.

    Parameters
    ----------
    folder: of the run. record: the pack in it; entries: what that holds. files: name of the data set in the pack →
        where its posterior is in the folder.
    """

    def __init__(self, folder: Path, record: str, entries: Mapping[str, Entry], files: Mapping[str, str]):
        self._folder, self._record, self._entries = folder, folder / record, entries
        self._files, self._stems = files, tuple(files)

    def __len__(self) -> int:
        return len(self._stems)

    @overload
    def __getitem__(self, index: int) -> DatasetOutcome: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[DatasetOutcome, ...]: ...

    def __getitem__(self, index: int | slice) -> DatasetOutcome | tuple[DatasetOutcome, ...]:
        stems = self._stems[index]
        return self._read(stems) if isinstance(stems, str) else tuple(map(self._read, stems))

    def lines(self) -> Iterator[str]:
        """Those of ``summary.csv`` of each data set; the rest of what is known of it is not looked at."""
        for stem in self._stems:
            try:
                yield str(json.loads(self._raw(stem))["lines"])
            except (ValueError, LookupError, TypeError) as error:  # as below
                raise OutputError(f"{self._record / stem}: {error}") from None

    def _raw(self, stem: str) -> bytes:
        return read_outcome(self._record, stem, self._entries[stem])

    def _read(self, stem: str) -> DatasetOutcome:
        try:
            outcome = decode_text(self._raw(stem), DatasetOutcome)
        except ValueError as error:  # anybody can write a checksum
            raise OutputError(f"{self._record / stem}: {error}") from None
        return outcome if outcome.failure else replace(outcome, file=self._folder / self._files[stem])
