"""What an estimation and a twin experiment share: a locked directory, a log, an identity to resume by, last words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

from en4dvar.config import AnyConfig, TwinConfig
from en4dvar.errors import ConfigError, OutputError
from en4dvar.executor import ExecutorError
from en4dvar.files import write_text
from en4dvar.inputs.asked import DataFile
from en4dvar.runs.interrupt import Interrupted, tell_interrupt
from en4dvar.runs.progress import RunLog
from en4dvar.runs.rundir import Mode, RunDirectory
from en4dvar.storage.checkpoint import FOLDER, CheckpointError, read_checkpoint, write_checkpoint
from en4dvar.storage.fingerprint import Identity, identity
from en4dvar.storage.provenance import provenance

S = TypeVar("S")
IDENTITY = f"{FOLDER}/run"


@dataclass
class Session:
    """A run at work in its directory.

    ``attributes`` go into its result files; ``notices`` are what the run itself found worth a warning. It has ``begun``
    once its directory says what it is.
    """

    config: AnyConfig
    directory: RunDirectory
    resumed: bool
    log: RunLog
    identity: Identity
    attributes: Mapping[str, str]
    notices: list[str] = field(default_factory=list)
    begun: bool = False

    def earlier(self) -> Identity | None:
        """The identity of the run that is resumed. Raises :class:`CheckpointError`."""
        return read_checkpoint(self.directory.at(IDENTITY), "run", Identity) if self.resumed else None

    def begin(self, *files: str, retried: frozenset[str] = frozenset()) -> None:
        """Write what the run is and claim the ``files`` it will write; a resumed run must be the same run.

        ``retried``: data sets that failed, whose data files may differ.

        Raises :class:`OutputError`: the run is not the same (says what has changed), the directory cannot be written.
        """
        directory, config = self.directory, self.config
        directory.folder(FOLDER)
        earlier = self.earlier()
        if earlier is not None and (difference := self.identity.difference(earlier, retried)):
            raise OutputError(
                f"{directory.path}: the run cannot be resumed to the same result, for this has changed:\n{difference}\n"
                "give --force to compute everything again, or another --out"
            )
        directory.claim("run.log", "config.yaml", "config.resolved.yaml", IDENTITY, *files)
        write_text(directory.at("config.yaml"), config.text)
        write_text(directory.at("config.resolved.yaml"), config.resolved)
        write_checkpoint(directory.at(IDENTITY), "run", self.identity)
        self.begun = True

    def restore(self, file: str, fingerprint: str, kind: type[S], otherwise: str) -> S | None:
        """What a checkpoint of the run that is resumed holds; one that cannot be used is told, with what is done
        ``otherwise``.
        """
        if not self.resumed:
            return None
        try:
            return read_checkpoint(self.directory.at(file), fingerprint, kind)
        except CheckpointError as error:
            self.notice(f"{error}; {otherwise}")
            return None

    def notice(self, message: str) -> None:
        """Something about the run itself that the user should know."""
        self.notices.append(message)
        self.log.write(f"warning: {message}")


def directory_mode(force: bool, resume: bool) -> Mode:
    """How the run directory is opened. Raises :class:`ConfigError`."""
    if force and resume:
        raise ConfigError("force replaces a run, resume continues it; give one of them")
    return "force" if force else "resume" if resume else "new"


@contextmanager
def session(
    config: AnyConfig,
    data: Mapping[str, DataFile],
    directory: RunDirectory,
    command: str,
    kept: Callable[[], str],
) -> Iterator[Session]:
    """Hold the log of a run in its ``directory``, and put the result in place where the block ends well.

    ``data``: name of each data set → its file; ``command``: what the user typed; ``kept``: says what the user has of a
    run that is stopped, which becomes part of the last words of an interrupt and of errors that a resumed run survives.

    Raises
    ------
    OutputError: the log cannot be written, the result not put in place. Interrupted: the block was.
    """
    model = config.experiment.model if isinstance(config, TwinConfig) else config.model
    with tell_interrupt(kept):
        who = identity(config.resolved, model, data)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
        }
        with RunLog(directory.at("run.log"), append=directory.resumed) as log:
            run = Session(config, directory, directory.resumed, log, who, attributes)
            try:
                log.write(attributes["history"])
                yield run
                log.write("done")
            except (KeyboardInterrupt, ExecutorError, OutputError) as error:
                if not run.begun and not isinstance(error, KeyboardInterrupt):
                    raise
                raise _last_words(error, directory, kept()) from error
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
