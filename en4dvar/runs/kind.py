"""A kind of run, declared: its files, what it is made of, how its units of work are combined, and its page.

:mod:`~en4dvar.runs.engine` does the rest, the same for every kind: it claims the directory, keeps what is done,
resumes, answers interrupts and writes the page. :data:`KINDS` lists the kinds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from en4dvar.executor import Executor, choose_executor
from en4dvar.inputs.asked import DataFile
from en4dvar.model.forward import ForwardModel
from en4dvar.results.netcdf import understood

if TYPE_CHECKING:
    from en4dvar.runs.session import Session

R = TypeVar("R")
REPORT = "report.html"
FIGURES = ("figures/*.png", "figures/*.pdf")


class Kind:
    """What the runs of a kind have in common.

    ``files`` are those a run writes into its directory beside the ones of every run, ``pages`` those of its page, which
    can be written again: names relative to the directory, in which ``*`` stands for any text. A file of such a name
    that no run wrote is never replaced. ``result``: the one of ``files`` by which a finished run of this kind is known.
    ``writer``: ``module:function`` that writes the page into a folder from its files, imported when it is wanted, for
    what draws pages is slow to import; of a page with figures also told whether to keep these as files.
    """

    name: ClassVar[str]
    files: ClassVar[tuple[str, ...]]
    pages: ClassVar[tuple[str, ...]] = ()
    result: ClassVar[str]
    writer: ClassVar[str] = ""

    @classmethod
    def page(cls, folder: Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path | None:
        """Write the page of a finished run from its result files; None for a kind that has none.

        Parameters
        ----------
        folder: of the run. datasets: those that get a page of their own in any case. workers: processes that draw.
        figures: also keep the figures as PDF and PNG.

        Raises :class:`OutputError`.
        """
        if not cls.writer:
            return None
        told = (figures,) if {*FIGURES} <= {*cls.pages} else ()
        with understood(folder / cls.result):
            page: Path = resolve_name(cls.writer)(folder, *told)
        return page


class RunKind(Kind, ABC, Generic[R]):
    """A run with a configuration and a directory of its own, whose units of work are kept as they end."""

    config: Any
    """The configuration of the run: its text, what it says resolved, seed, execution and output."""

    @property
    def directory(self) -> Path:
        """Where the run writes."""
        return Path(self.config.directory)

    @property
    def model(self) -> ForwardModel:
        """The forward model, whose sources are part of what decides the numbers."""
        model: ForwardModel = self.config.model
        return model

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
        return choose_executor(self.model, asked.executor, asked.workers, asked.address, asked.limits)

    @abstractmethod
    def kept(self) -> str:
        """What the user has of a run that is stopped, in words."""

    def opened(self, run: Session) -> frozenset[str]:
        """Look at what an earlier run left; returns the data sets that failed in it, whose files may differ now."""
        return frozenset()

    @abstractmethod
    def conduct(self, run: Session, executor: Executor) -> R:
        """Compute every unit of work that is not kept, combine them, and write the result files.

        Raises :class:`OutputError` and what the computation raises.
        """

    def stop(self) -> None:
        """End what computes in threads of this process."""


KINDS = {
    "estimate": "en4dvar.runs.runner:EstimateKind",
    "sequence": "en4dvar.runs.sequence_run:SequenceKind",
    "twin": "en4dvar.runs.twin_run:TwinKind",
    "design": "en4dvar.runs.design_run:DesignKind",
    "sweep-twin": "en4dvar.runs.twin_sweep:SweepKind",
    "calibrate": "en4dvar.runs.calibration_run:CalibrationKind",
    "joint": "en4dvar.runs.joint_run:JointKind",
    "population": "en4dvar.runs.population_run:PopulationKind",
}


def kind_named(name: str) -> type[Kind]:
    """The declaration of a kind. Raises :class:`KeyError`."""
    declared: type[Kind] = resolve_name(KINDS[name])
    return declared


def kind_in(folder: Path) -> type[Kind]:
    """The kind of the finished run in ``folder``; that of an estimate where there is no result of another kind."""
    kinds = map(kind_named, KINDS)  # that of an estimate first
    return next((kind for kind in kinds if (folder / kind.result).is_file()), kind_named("estimate"))
