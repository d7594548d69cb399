"""A run at work, of any kind: its directory, its log, the identity by which it is resumed, what it kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.plumbing.files import write_text
from en4dvar.results.checkpoint import FOLDER, CheckpointError, read_checkpoint, write_checkpoint
from en4dvar.results.fingerprint import IDENTITY, Identity
from en4dvar.runs.progress import RunLog
from en4dvar.runs.rundir import OF_EVERY_RUN, Mode, RunDirectory

S = TypeVar("S")


@dataclass
class Session:
    """A run at work in its directory.

    ``attributes`` go into its result files; ``notices`` are what the run itself found worth a warning. It has ``begun``
    once its directory says what it is.
    """

    config: Any
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
        earlier = self.earlier()
        if earlier is not None and (difference := self.identity.difference(earlier, retried)):
            raise OutputError(
                f"{directory.path}: the run cannot be resumed to the same result, for this has changed:\n{difference}\n"
                "give --force to compute everything again, or another --out"
            )
        directory.claim(*OF_EVERY_RUN, IDENTITY, *files)  # before anything is made that a failure would leave
        directory.folder(FOLDER)
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
