"""The results of a run directory: those that are there, and by name those that ought to be, which is known from three
places: the lines of its pack, ``checkpoints/run`` and ``posterior.nc``. Whichever is damaged, no data set vanishes
without a word.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from en4dvar.plumbing.called import CONTINUED, advised
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.campaign_file import datasets_in
from en4dvar.results.checkpoint import CheckpointError, read_checkpoint
from en4dvar.results.kinds import require_no_other
from en4dvar.results.pack import PACK, Pack, file_names, known_pack, read_result, results_of
from en4dvar.results.provenance import IDENTITY, Identity
from en4dvar.results.store import StoredResult, load_stored, posterior_file, require_settled

R = TypeVar("R")
MOST_NAMES = 20
ABSENT = "not there: lost, or not estimated yet"
NAMELESS = "some data set"


class LackingError(OutputError):
    """Data sets of a run, which the message names, cannot be read; ``rest``: what was made of others, if anything."""

    def __init__(self, message: str, rest: str | Path | None = None):
        super().__init__(message)
        self.rest = rest
        self.exit_code = 2 if rest is None else 1


class RunResults:
    """The results of a run directory, by name; of a single data set ``posterior.nc``. ``files``: where they are;
    ``lacking``: data sets of a campaign that cannot be read → why, those whose content is damaged as they are read.
    Raises :class:`OutputError`: there are none, a run was killed as it replaced another, or is of another kind.
    """

    def __init__(self, run_dir: Path):
        require_settled(run_dir)
        if not has_results(run_dir):
            require_no_other(run_dir)
        self.run_dir, self.whole = run_dir, run_dir / "posterior.nc"
        self.lacking: dict[str, str] = {}
        self._read = False
        planned = _planned(run_dir)
        self._names = {stem: name for name, stem in file_names(planned).items()}
        pack = run_dir / PACK
        self.files: list[Path] = []
        if pack.exists() or len(planned) > 1:
            self.files = results_of(pack) if pack.exists() else []
            self._look_for(planned, known_pack(pack) if pack.exists() else Pack(pack))
        if not (self.files or self.lacking):
            self.files = [posterior_file(run_dir)]  # or says what is missing

    def _look_for(self, planned: list[str], pack: Pack) -> None:
        estimated = datasets_in(self.whole)
        held = {name for name, entry in pack.entries.items() if entry.content_size}
        for name, stem in file_names(planned or estimated).items():
            if stem not in (held if name in estimated else pack.entries):
                self.lacking[name] = ABSENT
        if not (planned or estimated or pack.whole):
            self.lacking[NAMELESS] = "its name is lost"

    def __iter__(self) -> Iterator[tuple[Path, StoredResult]]:
        """Each is read when its turn comes. Raises :class:`OutputError` of a single data set."""
        for path, result in self._each(load_stored):
            self._read = True
            yield path, result

    def _each(self, read: Callable[[Path], R]) -> Iterator[tuple[Path, R]]:
        for path in self.files:
            try:
                yield path, read(path)
            except OutputError as error:
                if path == self.whole:
                    raise
                self.lacking[self._names.get(path.name, path.name)] = str(error).removeprefix(f"{path}: ")

    def check(self) -> None:
        """Compare every result with its checksum. Raises :class:`LackingError` where one cannot be read."""
        if self.files != [self.whole]:
            list(self._each(read_result))
        self.require()

    def require(self, rest: str | Path | None = None) -> None:
        """Raise :class:`LackingError` where data sets cannot be read; ``rest`` is what was made of others."""
        if not self.lacking:
            return
        told = [f"{name} ({reason})" for name, reason in list(self.lacking.items())[:MOST_NAMES]]
        if len(self.lacking) > MOST_NAMES:
            told.append(f"and {len(self.lacking) - MOST_NAMES} more")
        words = f"{self.run_dir}: no result that can be read of {', '.join(told)}"
        hint = f"{advised(*CONTINUED)} estimates what is missing"
        raise LackingError(f"{words}; {hint}", rest if self._read else None)


def result_files(run_dir: Path) -> list[Path]:
    """Where the results of a run directory's data sets are, as of :class:`RunResults`. Raises :class:`OutputError`;
    :class:`LackingError` where one that ought to be there cannot be read.
    """
    results = RunResults(run_dir)
    results.check()
    return results.files


def has_results(run_dir: Path) -> bool:
    """Whether a folder holds results of data sets, whole or not."""
    return any((run_dir / name).exists() for name in ("posterior.nc", PACK))


def _planned(run_dir: Path) -> list[str]:
    """The data sets of the run, in order; none where it does not say, or that is damaged."""
    try:
        identity = read_checkpoint(run_dir / IDENTITY, "run", Identity)
    except CheckpointError:
        return []
    return [name for name, _ in identity.data] if identity else []
