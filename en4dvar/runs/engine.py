"""A kind of run, declared: its files, what it is made of, how its units of work are combined, and its page.

The engine does the rest, the same for every kind: it claims the directory and locks it, keeps what is done, resumes,
answers interrupts, puts the result in place and writes the page. :mod:`en4dvar.results.kinds` lists the kinds.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from types import GenericAlias
from typing import Any, ClassVar, Generic, TypeVar

from en4dvar.executor import Executor, ExecutorError, choose_executor, one_blas_thread
from en4dvar.executor.processes import UnguardedError
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.called import advised
from en4dvar.plumbing.errors import ConfigError, En4dvarError, OutputError
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.user_code import reason_of
from en4dvar.results.checkpoint import FOLDER, CheckpointError, Keeper, digest, read_checkpoint, write_checkpoint
from en4dvar.results.kinds import kind_in, require_result
from en4dvar.results.netcdf import understood
from en4dvar.results.provenance import IDENTITY, Identity, identity, provenance
from en4dvar.results.run_results import has_results
from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
from en4dvar.runs.progress import run_log
from en4dvar.runs.rundir import LOG, OF_EVERY_RUN, Mode, RunDirectory

R = TypeVar("R")
S = TypeVar("S")
Tell = Callable[[int, int], None]  # how many are done, and of how many
REPORT = "report.html"
FIGURES = ("figures/*.png", "figures/*.pdf")


class Kind:
    """What the runs of a kind have in common.

    ``files`` are those a run writes into its directory beside the ones of every run, ``pages`` those of its page, which
    can be written again: names relative to the directory, in which ``*`` stands for any text. A file of such a name
    that no run wrote is never replaced. ``result``: the one of ``files`` by which a finished run of this kind is known.
    ``writer``: ``module:function`` that writes the page into a folder from its files, imported when it is wanted, for
    what draws pages is slow to import; of a page with figures also told whether to keep these as files. ``readers``:
    the commands that read a finished run of this kind.
    """

    name: ClassVar[str]
    files: ClassVar[tuple[str, ...]]
    pages: ClassVar[tuple[str, ...]] = ()
    result: ClassVar[str]
    writer: ClassVar[str] = ""
    readers: ClassVar[tuple[str, ...]] = ("report",)

    @classmethod
    def page(cls, folder: Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path | None:
        """Write the page of a finished run from its result files; None for a kind that has none.

        ``folder``: of the run. ``datasets``: those that get a page of their own in any case. ``workers``: processes
        that draw. ``figures``: also keep the figures as PDF and PNG.

        Raises :class:`OutputError`.
        """
        if not cls.writer:
            return None
        if datasets:
            raise OutputError(f"--dataset {datasets[0]}: a run of the kind {cls.name} has one page, of all it holds")
        told = (figures,) if {*FIGURES} <= {*cls.pages} else ()
        with understood(folder / cls.result):
            page: Path = resolve_name(cls.writer)(folder, *told)
        return page


class RunKind(Kind, ABC, Generic[R]):
    """A run with a configuration and a directory of its own, whose units of work are kept as they end. ``units``: what
    the user has of a run that is stopped, in words.
    """

    units: ClassVar[str]
    config: Any
    """The configuration of the run: its text, what it says resolved, model, seed, directory, execution and output."""

    @property
    def data(self) -> Mapping[str, DataFile]:
        """Name of each data set → its file."""
        return {}

    @property
    def settings(self) -> str:
        """What decides the numbers, as YAML: the resolved configuration, and what a kind is asked beside it."""
        return str(self.config.resolved)

    def check(self) -> None:
        """Refuse, before anything is written, what cannot be computed. Raises errors of ours."""

    def executor(self) -> Executor:
        """Where the units of work are computed, as the configuration asks."""
        asked = self.config.execution
        return choose_executor(self.config.model, asked.executor, asked.workers, asked.address, asked.limits)

    def kept(self) -> str:
        """What the user has of a run that is stopped, and where."""
        return f"the {self.units} are kept in {self.config.directory}"

    def opened(self, run: "Session") -> frozenset[str]:
        """Look at what an earlier run left; returns the data sets that failed in it, whose files may differ now."""
        return frozenset()

    @abstractmethod
    def conduct(self, run: "Session", executor: Executor) -> R:
        """Compute every unit of work that is not kept, combine them, and write the result files; the page follows.
        Raises :class:`OutputError` and what the computation raises.
        """


@dataclass
class Session:
    """A run at work in its directory.

    ``log`` writes down what it does. ``attributes`` go into its result files; ``notices`` are what the run itself found
    worth a warning. It has ``begun`` once its directory says what it is.
    """

    config: Any
    directory: RunDirectory
    log: Callable[[str], None]
    identity: Identity
    attributes: Mapping[str, str]
    notices: list[str] = field(default_factory=list)
    begun: bool = False

    @property
    def fingerprint(self) -> str:
        """A digest of what decides the numbers, data included."""
        return digest(self.identity.settings.encode() + repr(self.identity.data).encode())

    def earlier(self) -> Identity | None:
        """The identity of the run that is resumed. Raises :class:`CheckpointError`."""
        return read_checkpoint(self.directory.at(IDENTITY), "run", Identity) if self.directory.resumed else None

    def begin(self, *files: str, retried: frozenset[str] = frozenset()) -> None:
        """Write what the run is and claim the ``files`` it will write; a resumed run must be the same run.

        ``retried``: data sets that failed, whose data files may differ.

        Raises :class:`OutputError`: the run is not the same (says what has changed), the directory cannot be written.
        """
        directory, config = self.directory, self.config
        self.identity.require_same(self.earlier(), directory.path, retried)
        directory.claim(*OF_EVERY_RUN, IDENTITY, *files)  # before anything is made that a failure would leave
        directory.folder(FOLDER)
        write_text(directory.at("config.yaml"), config.text)
        write_text(directory.at("config.resolved.yaml"), config.resolved)
        write_checkpoint(directory.at(IDENTITY), "run", self.identity)
        self.begun = True

    def restore(self, file: str, fingerprint: str, kind: type[S], otherwise: str) -> S | None:
        """What a checkpoint of the resumed run holds; one of no use is told, with what is done ``otherwise``."""
        if not self.directory.resumed:
            return None
        try:
            return read_checkpoint(self.directory.at(file), fingerprint, kind)
        except CheckpointError as error:
            self.notice(f"{error}; {otherwise}")
            return None

    def kept(self, file: str, fingerprint: str, kind: type[S], otherwise: str) -> tuple[S | None, Keeper]:
        """As :meth:`restore`, and what keeps in the ``file`` what follows."""
        every = self.config.execution.checkpoint_every
        return self.restore(file, fingerprint, kind, otherwise), Keeper(self.directory.at(file), fingerprint, every)

    def notice(self, message: str) -> None:
        """Something about the run itself that the user should know."""
        self.notices.append(message)
        self.log(f"warning: {message}")


class KeptUnits(Generic[S]):
    """What is ``done`` of the units of work of a run, by their names, in the order of their ends; kept as by
    :meth:`Session.kept`.
    """

    def __init__(self, run: Session, file: str, kind: type[S], otherwise: str):
        kinds: Any = GenericAlias(tuple, (GenericAlias(tuple, (str, kind)), ...))
        before, self.keeper = run.kept(file, run.fingerprint, kinds, otherwise)
        self.log = run.log
        self.done: dict[str, S] = dict(before or ())

    def work(
        self, executor: Executor, function: Callable[..., S], calls: Mapping[str, tuple[Any, ...]], tell: Tell | None,
        *, failed: Callable[..., S], line: Callable[[str, S], str],
    ) -> list[S]:  # fmt: skip
        """The units of ``calls`` (name → arguments), in their order; those that are not done are done: ``failed`` makes
        a unit of a call and the reason why it ended in an error, ``line`` is what the log says of one, by its name.
        """
        left, tell = [name for name in calls if name not in self.done], tell or (lambda done, total: None)
        before = len(calls) - len(left)
        tell(before, len(calls))
        try:
            for count, (i, ended) in enumerate(executor.map(function, (calls[name] for name in left)), 1):
                if isinstance(ended, Exception):
                    reason = str(ended) if isinstance(ended, En4dvarError) else reason_of(ended)
                    ended = failed(*calls[left[i]], reason=reason)
                self.done[left[i]] = ended
                self.log(line(left[i], ended))
                self.keeper.keep(lambda: tuple(self.done.items()))
                tell(before + count, len(calls))
        finally:
            self.keeper.write(tuple(self.done.items()))
        return [self.done[name] for name in calls]


def require_some(units: str, failures: Sequence[str]) -> None:
    """Raise :class:`En4dvarError` where all units of work failed; ``failures``: why each did, "" where it did not."""
    if all(failures):
        raise En4dvarError(f"all {len(failures)} {units} failed, the first: {failures[0]}")


def directory_mode(force: bool, resume: bool) -> Mode:
    """How the run directory is opened. Raises :class:`ConfigError`."""
    if force and resume:
        raise ConfigError("force replaces a run, resume continues it; give one of them")
    return "force" if force else "resume" if resume else "new"


def conduct_run(kind: RunKind[R], force: bool = False, resume: bool = False, command: str = "") -> R:
    """Conduct a run in its directory; arguments and errors as of :func:`en4dvar.run`."""
    names = (*kind.files, *kind.pages)
    with (
        one_blas_thread(),
        terminate_as_interrupt(),
        # first: what follows may compile the model
        RunDirectory.open(kind.config.directory, directory_mode(force, resume), names) as directory,
    ):
        kind.check()
        with kind.executor() as executor, _session(kind, directory, command) as run:
            try:
                run.begin(*names, retried=kind.opened(run))
                result = kind.conduct(run, executor)
                if kind.writer and kind.config.report:
                    kind.page(directory.work, figures=kind.config.figures)
                return result
            except BaseException:  # no worker writes once the directory is free for others
                with suppress(KeyboardInterrupt):  # of an impatient user: on to the next step
                    executor.kill()
                raise


def write_report(path: str | Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path:
    """Write (again) the page of a finished run of any kind from its result files.

    ``path``: the run directory. ``datasets``: of a campaign, those that get a page in any case. ``workers``: processes
    that draw. ``figures``: also keep those of ``datasets``, or of all pages, as PDF and PNG.

    Raises :class:`OutputError`: there is no result, it is damaged, the directory cannot be written, or a file that no
    run wrote would be replaced. :class:`LackingError`: results of some data sets cannot be read; the page names them.
    """
    if not has_results(Path(path)):
        require_result(Path(path))
    with RunDirectory.open(path, "report") as directory:
        kind: type[Kind] = kind_in(directory.work)
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

    Raises :class:`OutputError`: the log cannot be written, the result not put in place. :class:`Interrupted`: the block
    was.
    """

    def kept() -> str:
        if directory.work.is_dir():
            return kind.kept()
        return f"the run directory {directory.path} was removed or renamed while the run was at work"

    config = kind.config
    with tell_interrupt(kept):
        who = identity(kind.settings, config.model, kind.data)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
            "identity": who.settings,
        }
        with run_log(directory.at(LOG), append=directory.resumed) as log, tell_interrupt(kept):  # in the log as well
            run = Session(config, directory, log, who, attributes)
            try:
                log(attributes["history"].partition(" ")[2])  # its time is that of the line
                yield run
                log("done")
            except (ExecutorError, OutputError) as error:
                if isinstance(error, UnguardedError) or not run.begun:
                    raise
                told = ExecutorError if isinstance(error, ExecutorError) else OutputError
                advice = f"; give {advised('--resume')} to continue" if directory.work.is_dir() else ""
                raise told(f"{error}; {kept()}{advice}") from error
        directory.publish()
