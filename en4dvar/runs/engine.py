"""The engine of every kind of run: directory, lock, log, resume, interrupts, result in place, page."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from en4dvar.executor import ExecutorError, one_blas_thread
from en4dvar.executor.processes import UnguardedError
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.fingerprint import identity
from en4dvar.results.provenance import provenance
from en4dvar.runs.interrupt import Interrupted, tell_interrupt, terminate_as_interrupt
from en4dvar.runs.kind import FIGURES, RunKind, kind_in
from en4dvar.runs.progress import RunLog
from en4dvar.runs.rundir import LOG, RunDirectory
from en4dvar.runs.session import Session, directory_mode

R = TypeVar("R")


def conduct_run(kind: RunKind[R], force: bool = False, resume: bool = False, command: str = "") -> R:
    """Conduct a run in its directory; arguments and errors as of :func:`en4dvar.run`."""
    with (
        one_blas_thread(),
        terminate_as_interrupt(),
        # first: what follows may compile the model
        RunDirectory.open(kind.directory, directory_mode(force, resume), (*kind.files, *kind.pages)) as directory,
    ):
        kind.check()
        with kind.executor() as executor, _session(kind, directory, command) as run:
            try:
                run.begin(*kind.files, *kind.pages, retried=kind.opened(run))
                return kind.conduct(run, executor)
            except BaseException:  # no worker writes once the directory is free for others
                kind.stop()
                with suppress(KeyboardInterrupt):  # of an impatient user: on to the next step
                    executor.kill()
                raise


def write_report(path: str | Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path:
    """Write (again) the page of a finished run of any kind from its result files.

    Parameters
    ----------
    path: the run directory. datasets: of a campaign, those that get a page in any case. workers: processes that draw.
    figures: also keep those of ``datasets``, or of all pages, as PDF and PNG.

    Raises
    ------
    OutputError: there is no result, it is damaged, the directory cannot be written, or a file that no run wrote would
        be replaced. LackingError: results of some data sets cannot be read; the page names them.
    """
    with RunDirectory.open(path, "report") as directory:
        kind = kind_in(directory.work)
        directory.claim(*(name for name in kind.pages if figures or name not in FIGURES))
        try:
            page = kind.page(directory.work, datasets, workers, figures)
        finally:
            directory.publish()
    if page is None:
        raise OutputError(f"{path}: a run of {kind.name}, which has no page")
    return page


@contextmanager
def _session(kind: RunKind[Any], directory: RunDirectory, command: str) -> Iterator[Session]:
    """Hold the log of a run in its ``directory``, and put the result in place where the block ends well.

    ``command``: what the user typed. What the user has of a run that is stopped becomes part of the last words of an
    interrupt and of errors that a resumed run survives.

    Raises
    ------
    OutputError: the log cannot be written, the result not put in place. Interrupted: the block was.
    """
    config = kind.config
    with tell_interrupt(kind.kept):
        who = identity(kind.settings, kind.model, kind.data)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
        }
        with RunLog(directory.at(LOG), append=directory.resumed) as log:
            run = Session(config, directory, directory.resumed, log, who, attributes)
            try:
                log.write(attributes["history"])
                yield run
                log.write("done")
            except (KeyboardInterrupt, ExecutorError, OutputError) as error:
                if isinstance(error, UnguardedError) or not (run.begun or isinstance(error, KeyboardInterrupt)):
                    raise
                raise _last_words(error, directory, kind.kept()) from error
        directory.publish()


def _last_words(error: BaseException, directory: RunDirectory, kept: str) -> BaseException:
    """The error as the user should see it: with what was kept, and what to do."""
    if gone := not directory.work.is_dir():
        kept = f"the run directory {directory.path} was removed or renamed while the run was at work"
    if isinstance(error, KeyboardInterrupt):
        return Interrupted(f"interrupted; {kept}")
    advice = "" if gone else "; give --resume to continue"
    kind = ExecutorError if isinstance(error, ExecutorError) else OutputError
    return kind(f"{error}; {kept}{advice}")
