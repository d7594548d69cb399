"""What localised schemes work on: readings with a model that predicts them, an ensemble, and what they tell; and the
localised gain of a problem, by where its readings and unknowns are.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from en4dvar.model.forward import field_of
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.priors.field_prior import places_of
from en4dvar.priors.prior import member_stream
from en4dvar.problem import InverseProblem
from en4dvar.schemes import LOCALISED, MINIMISERS
from en4dvar.schemes.local_gain import ByCorrelation, ByDistance, Gain, parts
from en4dvar.schemes.settings import AssimilationSettings, Localisation

Members = Indices
Forward = Callable[[Array], Array]  # members (M, n) → predictions (M, K)


@dataclass(frozen=True)
class FieldData:
    """Readings ``values`` (K,) with independent errors ``std`` (K,), and the model that predicts them.

    ``forward``: members (M, n) → predictions (M, K); it gets ``at_once`` members in a call.
    """

    values: Array
    std: Array
    forward: Forward
    at_once: int = 16

    def predict(self, members: Callable[[slice], Array], count: int) -> Array:
        """Predictions (count, K) of members that are made a few at a time. Raises as :meth:`enough`."""
        return self.enough(self.runs(members, count))

    def runs(self, members: Callable[[slice], Array], count: int) -> Array:
        """The same, NaN where a reading is missing."""
        predictions = np.empty((count, len(self.values)))
        for first in range(0, count, self.at_once):
            some = slice(first, min(first + self.at_once, count))
            predictions[some] = np.asarray(self.forward(members(some)), dtype=float)
        return predictions

    @staticmethod
    def enough(predictions: Array, fewest: int | None = None) -> Array:
        """Predictions (M, K) as they are.

        Raises :class:`En4dvarError` where those of fewer than ``fewest``, by default all, are finite.
        """
        count = len(predictions)
        lost = np.flatnonzero(~np.isfinite(predictions).all(axis=1))
        if count - len(lost) < (count if fewest is None else fewest):
            raise En4dvarError(f"{len(lost)} of {count} members have predictions that are not finite, first {lost[0]}")
        return predictions

    def width(self, members: int) -> int:
        """Numbers that a cell takes in an update."""
        return max(len(self.values), members)

    def perturbations(self, seed: int, purpose: str, members: Iterable[int]) -> Array:
        """Draws (M, K) of the errors of ``members``, centred."""
        z = np.stack([member_stream(seed, purpose, i).standard_normal(len(self.values)) for i in members])
        return np.asarray(self.std * (z - z.mean(axis=0)))


@dataclass(frozen=True)
class Pass:
    """Where a descent stands, or ES-MDA before a pass: the ``centre`` (n,) and its ``prediction`` (K,), J_b there.

    ``step`` is the length of the next step, ``share`` the part of it that is taken, ``dfs`` the trace of H K;
    ``members`` gives a part (N, m) of the ensemble. What is not known is NaN.
    """

    centre: Array
    prediction: Array
    members: Callable[[slice], Array]
    background: float = math.nan
    step: float = math.nan
    share: float = 1.0
    dfs: float = math.nan


def moment_of(ensemble: Array, alive: Members, moment: Callable[..., Array] = np.mean) -> Array:
    """The mean (n,) of some members of (N, n), or another ``moment``, a part at a time."""
    each = parts(ensemble.shape[1], len(ensemble))
    return np.concatenate([moment(ensemble[alive, part], axis=0) for part in each])


def prior_members(problem: InverseProblem, settings: AssimilationSettings, seed: int) -> Array:
    """The prior ensemble (N, n + m): n parameters with names, m cells of fields; ``exact`` has the prior's mean."""
    prior, n = problem.prior, len(problem.prior.terms)
    ensemble = np.empty((settings.members, n + sum(field.field.size for field in problem.fields)))
    if n:
        exact = settings.sampling == "exact" and settings.members > n
        ensemble[:, :n] = prior.sample(settings.members, seed, "exact" if exact else "random")
    for field, columns in problem.columns_of_fields:
        for i, member in enumerate(ensemble):
            member[n + columns.start : n + columns.stop] = field.draw(seed, i)
    if settings.sampling == "exact":
        mean = moment_of(ensemble, np.arange(len(ensemble)))
        mean[:n] -= prior.mean
        ensemble -= mean
    return ensemble


def gain_of(problem: InverseProblem, settings: AssimilationSettings) -> Gain:
    """The gain that the settings ask for. Raises :class:`ConfigError` where the problem does not suit it."""
    asked = settings.localisation
    if asked is None:
        raise ConfigError("a field estimated cell by cell needs a localised gain, e.g. {radius: 10}")
    if settings.scheme not in LOCALISED:
        raise ConfigError(f"a scheme for data that can be localised is {' or '.join(LOCALISED)}")
    if not problem.observations.noise.plain or problem.has_noise_scale:
        raise ConfigError(
            "takes independent Gaussian errors of known std: no covariance, correlation time, shared or timing error, "
            "robust cost, discrepancy or sigma"
        )
    others = f"scheme: {' or '.join(name for name in LOCALISED if name not in MINIMISERS)}"
    if asked.radius is None:
        if settings.own.minimiser:
            raise ConfigError(f"by correlation there is no cost that {settings.scheme} could minimise; use {others}")
        return ByCorrelation(asked.threshold)
    observed = _observed(problem, asked)
    places = _places(problem, asked, observed.shape[1])
    lost = [name for name, where in zip(problem.prior.names, places, strict=False) if np.isnan(where[0])]
    if len(lost) >= settings.members - 1:
        raise ConfigError(
            f"{len(lost)} parameters have no place, as many as {settings.members} members know directions; give them "
            f"places, 'at: {{{lost[0]}: 0}}', or use {others} with 'localisation: {{by: correlation}}'"
        )
    if 4 * len(lost) > settings.members - 1 and not settings.own.minimiser:
        raise ConfigError(
            f"{len(lost)} parameters have no place, more than a quarter of the directions that {settings.members} "
            f"members know: {settings.scheme} would take chance for what they explain; use more members or "
            f"scheme: {' or '.join(name for name in LOCALISED if name in MINIMISERS)}"
        )
    return ByDistance(places, observed[problem.observations.used], asked.radius)


def _observed(problem: InverseProblem, asked: Localisation) -> Array:
    """Coordinates (K, D) of the readings, with the field carried back to the begin of the model's clock.

    Raises :class:`ConfigError`.
    """
    coordinates = []
    for part in problem.parts:
        block = field_of(problem.model, part.observable)
        if part.name in asked.at:
            coordinates.append(np.broadcast_to(asked.at[part.name], (part.end - part.begin, len(asked.at[part.name]))))
        elif part.places is not None and block is not None and block.coordinates is not None:
            where = np.einsum("kj,kjd->kd", part.places.shares, places_of(block)[part.places.indices])
            if len(moving := asked.velocity) not in (0, where.shape[1]):
                raise ConfigError(f"velocity: {len(moving)} numbers, {block.name} has {where.shape[1]} coordinates")
            since = problem.observations.times[part.begin : part.end]
            coordinates.append(where - np.outer(since, moving) if moving else where)
        else:
            raise ConfigError(
                f"{part.name} has no place: it is no part of a field with coordinates; write 'at: {{{part.name}: 0}}', "
                "or leave localisation out"
            )
    if len({where.shape[1] for where in coordinates}) > 1:
        raise ConfigError("the places of the readings have different numbers of coordinates")
    return np.concatenate(coordinates)


def _places(problem: InverseProblem, asked: Localisation, dimensions: int) -> Array:
    """Coordinates (n + m, D) of what is estimated, NaN where there are none. Raises :class:`ConfigError`."""
    known = {*problem.prior.names, *(part.name for part in problem.parts)}
    for name, where in asked.at.items():
        if name not in known:
            raise ConfigError(f"at: {name!r} is not a parameter with a prior and no series")
        if len(where) != dimensions:
            raise ConfigError(f"at: {name} has {len(where)} coordinates, the readings have {dimensions}")
    unknown = (math.nan,) * dimensions
    named = np.array([asked.at.get(name, unknown) for name in problem.prior.names]).reshape(-1, dimensions)
    of_fields = [field.places for field in problem.fields]
    for field, own in zip(problem.fields, of_fields, strict=True):
        if own.shape[1] != dimensions:
            raise ConfigError(f"{field.field.name} has {own.shape[1]} coordinates, the readings have {dimensions}")
    return np.concatenate([named, *of_fields])
