"""The localised gain of a problem: which one its settings ask for, and where its readings and unknowns are."""

from __future__ import annotations

import math

import numpy as np

from en4dvar.model.forward import field_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.field_prior import places_of
from en4dvar.problem import InverseProblem
from en4dvar.schemes import LOCALISED, MINIMISERS
from en4dvar.schemes.local_gain import ByCorrelation, ByDistance, Gain
from en4dvar.schemes.settings import AssimilationSettings, Localisation


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
    if len(lost) >= settings.members - 1 and settings.own.minimiser:
        raise ConfigError(
            f"{len(lost)} parameters have no place, as many as {settings.members} members know directions; give them "
            f"places, 'at: {{{lost[0]}: 0}}', or use {others}"
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
