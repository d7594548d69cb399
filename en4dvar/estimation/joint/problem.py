"""Who shares what: inverse problems, quantities that have one value in several of them, and what each says alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.ensemble.forecast import check_problem
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import suggest
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import AT_ONCE, InverseProblem, common_to

EVERYONE = ""  # the group of a quantity that all experiments share


@dataclass(frozen=True)
class Single:
    """The estimate of one experiment by itself: mode (n,) and posterior precision (n, n), in units of the prior."""

    mode: Array
    precision: Array

    @classmethod
    def of_physical(cls, prior: Prior, members: Array, mode: Array) -> "Single":
        """From the members (N, n) alive and the mode (n,) of a posterior. Raises ValueError outside a map's range."""
        z = (prior.from_physical(np.vstack([members, mode])) - prior.mean) / prior.std
        return cls(z[-1], np.linalg.inv(np.atleast_2d(np.cov(z[:-1].T))))


@dataclass(frozen=True)
class JointProblem:
    """``experiments`` and, for each, ``groups``: name of a parameter that it shares → with which group.

    Parameters of one name and one group have one value; it has a single prior, which must be the same in all
    experiments of the group. Models, windows, errors and the parameters of their own may differ.

    Raises ConfigError: fewer than two experiments, two of one name, a shared parameter that an experiment does not
    estimate, nothing shared, or priors that differ or are correlated.
    """

    experiments: tuple[InverseProblem, ...]
    groups: tuple[Mapping[str, str], ...]

    def __post_init__(self) -> None:
        names = [problem.observations.name for problem in self.experiments]
        if again := sorted({name for name in names if names.count(name) > 1}):
            raise ConfigError(f"data sets of a joint estimate need different names: {', '.join(again)} twice")
        for problem, groups in zip(self.experiments, self.groups, strict=True):
            check_problem(problem)
            if problem.fields:
                raise ConfigError(f"{problem.observations.name}: whole fields cannot be estimated jointly")
            if problem.prior.blocks:
                raise ConfigError(f"{problem.observations.name}: a joint estimate needs priors that are not correlated")
            if missing := sorted(set(groups) - set(problem.prior.names)):
                raise ConfigError(f"{problem.observations.name}: {', '.join(missing)}: shared, but not estimated there")
        if not self.shared:
            raise ConfigError("a joint estimate shares at least one parameter")
        for key, terms in self._terms.items():
            if any(term != terms[0] for term in terms):
                raise ConfigError(
                    f"{self.words(key)}: its prior must be the same in all experiments that share it: {AT_ONCE}"
                )

    @property
    def shared(self) -> tuple[tuple[str, str], ...]:
        """(name, group) of what is shared, in order of appearance."""
        return tuple(self._terms)

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        """The priors of what is shared."""
        return tuple(terms[0] for terms in self._terms.values())

    @property
    def names(self) -> tuple[str, ...]:
        """Of the experiments."""
        return tuple(problem.observations.name for problem in self.experiments)

    def of(self, kept: Sequence[int]) -> "JointProblem":
        """The same of some of the experiments."""
        return JointProblem(tuple(self.experiments[e] for e in kept), tuple(self.groups[e] for e in kept))

    def of_border(self, e: int) -> list[int]:
        """Which of the shared quantities experiment e has, in the order of its control vector."""
        groups = self.groups[e]
        return [self.shared.index((name, groups[name])) for name in self.experiments[e].prior.names if name in groups]

    def columns(self, e: int) -> tuple[list[int], list[int]]:
        """Where the shared and the own quantities stand in the control vector of experiment e."""
        names, groups = self.experiments[e].prior.names, self.groups[e]
        return (
            [j for j, name in enumerate(names) if name in groups],
            [j for j, name in enumerate(names) if name not in groups],
        )

    def standard(self, e: int, border: Array, own: Array) -> Array:
        """Control vectors (…, n) of experiment e, in units of its prior, of border (…, c) and own quantities."""
        shared, rest = self.columns(e)
        z = np.empty((*np.shape(border)[:-1], len(shared) + len(rest)))
        z[..., shared] = border[..., self.of_border(e)]
        z[..., rest] = own
        return z

    @staticmethod
    def words(key: tuple[str, str]) -> str:
        """A shared quantity as it is called in tables."""
        name, group = key
        return f"{name} ({group})" if group else name

    @cached_property
    def _terms(self) -> dict[tuple[str, str], list[PriorTerm]]:
        terms: dict[tuple[str, str], list[PriorTerm]] = {}
        for problem, groups in zip(self.experiments, self.groups, strict=True):
            for term in problem.prior.terms:
                if term.parameter.name in groups:
                    terms.setdefault((term.parameter.name, groups[term.parameter.name]), []).append(term)
        return terms


def sharing(experiments: Sequence[InverseProblem], names: Sequence[str], apart: Sequence[str] = ()) -> JointProblem:
    """Experiments of which those that estimate one of the parameters ``names`` have it in common, and what is
    :func:`with_common` but for that named ``apart``.

    Raises :class:`ConfigError`, also where fewer than two do.
    """
    if len(experiments) < 2:
        raise ConfigError("a joint estimate takes at least two data sets")
    for name in names:
        if sum(name in problem.prior.names for problem in experiments) < 2:
            known = sorted({name for problem in experiments for name in problem.prior.names})
            raise ConfigError(f"{name}: cannot be shared, for no two data sets estimate it{suggest(name, known)}")
    groups = tuple({name: EVERYONE for name in names if name in problem.prior.names} for problem in experiments)
    return JointProblem(tuple(experiments), with_common(experiments, groups, apart))


def with_common(
    experiments: Sequence[InverseProblem], groups: Sequence[Mapping[str, str]], apart: Sequence[str] = ()
) -> tuple[Mapping[str, str], ...]:
    """``groups`` of each experiment, and what is not of them and common to the experiments
    (:func:`~en4dvar.problem.common_to`), with everyone: an error that all have alike does not average out.

    Raises :class:`ConfigError`: of ``apart`` a name that is not common.
    """
    if not any(groups):
        raise ConfigError("a joint estimate shares at least one parameter")
    common = common_to(experiments, {name for shared in groups for name in shared})
    if wrong := [name for name in apart if name not in common]:
        raise ConfigError(f"{wrong[0]}: apart, but not shared unless it is asked for{suggest(wrong[0], common)}")
    everyone = {name: EVERYONE for name in common if name not in apart}
    each = zip(experiments, groups, strict=True)
    return tuple({**shared, **{n: g for n, g in everyone.items() if n in p.prior.names}} for p, shared in each)
