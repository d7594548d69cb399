"""Kinds of run that estimate data sets together, from what the result files of their single estimates record: at the
end of the run that made these, or of several finished runs.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from en4dvar.config import Config
from en4dvar.executor import Executor, choose_executor
from en4dvar.results.checkpoint import digest, file_digest, write_checkpoint
from en4dvar.results.provenance import provenance
from en4dvar.results.store import load_stored
from en4dvar.runs.finished import Finished, finished, finished_set
from en4dvar.runs.kind import Kind
from en4dvar.runs.rundir import RunDirectory
from en4dvar.runs.trust import Ask
from en4dvar.runs.worklist import Worklist

Tell = Callable[[str], None]


@dataclass(frozen=True)
class SetGroup:
    """Names of ``datasets`` that are estimated together, with a ``folder`` of the run directory of their own."""

    name: str
    folder: str
    datasets: frozenset[str]


class TogetherKind(Kind, ABC):
    """An estimate of several data sets. ``what`` it is, in words; ``fewest`` data sets are needed. ``records``: of what
    an estimate within a run was made.
    """

    what: ClassVar[str]
    records: ClassVar[tuple[str, ...]]
    fewest: ClassVar[int]

    @abstractmethod
    def estimate(
        self, sets: Sequence[Finished], config: Config, executor: Executor, attributes: Mapping[str, Any], path: Path,
        tell: Tell,
    ) -> None:  # fmt: skip
        """Estimate the sets with the seed and settings of ``config``, and write the file ``path``.

        Raises :class:`ConfigError`, :class:`TooFewMembersError`, :class:`OutputError`.
        """

    def of_runs(
        self, run_dirs: Sequence[Path], out: Path, workers: int | None, trust: bool, ask: Ask | None, tell: Tell
    ) -> tuple[Path, Path]:
        """Of the data sets of finished runs, with the settings of the first; returns the paths of result and page.

        Raises
        ------
        RefusedError: code of a stranger, see :func:`~en4dvar.runs.rerun.rerun`. OutputError: there is no result, it is
            damaged, or a file that no run wrote would be replaced. Others as of :meth:`estimate`.
        """
        names = (*self.files, *self.pages)
        with RunDirectory.open(out, "beside", names) as directory:
            config, sets = finished(run_dirs, trust, ask)
            attributes = {**provenance("", None), "runs": ", ".join(run_dir.name for run_dir in run_dirs)}
            try:
                directory.claim(*names)
                with choose_executor(config.model, None, workers) as executor:
                    self.estimate(sets, config, executor, attributes, directory.at(self.result), tell)
                page = self.page(directory.work)
            finally:
                directory.publish()
        assert page is not None
        return out / self.result, out / page.name

    def within(self, work: Worklist, executor: Executor, group: SetGroup | None = None) -> None:
        """Of the data sets of a run (or of one ``group`` of them) that have a posterior, at its end; too few of them
        are told. A file that a resumed run finds, made of the same, is kept.

        Raises what :meth:`estimate` does.
        """
        config, run = work.config, work.run
        good = [d for d in work.good() if group is None or d.name in group.datasets]
        what = f"{self.what} of {group.name}" if group else self.what
        if len(good) < self.fewest:
            run.notice(f"no {what}, for which {self.fewest} data sets need a posterior; {len(good)} have one")
            return
        digests = (f"{d.name}: {work.pack.entries[d.stem].content_digest}" for d in good)
        made_of = [run.identity.settings, *digests]
        fingerprint, path = digest("\n".join(made_of).encode()), run.directory.at(self.result)
        record = self.records[0]
        if group:
            path = run.directory.folder(group.folder) / self.result
            record = f"{record}_{group.folder.replace('/', '_')}"
        done = run.restore(record, fingerprint, str, f"the {what} is made again")
        if done is not None and path.exists() and file_digest(path) == done:
            return
        sets = [finished_set(config, load_stored(run.directory.work / d.file), run.directory.path) for d in good]
        attributes = {**run.attributes, "identity": run.identity.settings, "runs": config.name}
        attributes |= {"group": group.name} if group else {}
        self.estimate(sets, config, executor, attributes, path, lambda words: run.log.write(f"{what}: {words}"))
        write_checkpoint(run.directory.at(record), fingerprint, file_digest(path))
