"""What a control file says of priors and errors in files of its own: covariances and ensembles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from en4dvar.model.programs.control_file import ControlFile, PestRow
from en4dvar.model.programs.matrices import NamedMatrix, read_matrix
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, retold

OFF = ("", "0", "false", "no")
PARCOV = ("parcov", "parameter_covariance", "parcov_filename")
OBSCOV = ("obscov", "observation_covariance", "obscov_filename")
PRIOR_DRAWS = ("ies_par_en", "ies_parameter_ensemble")
ERROR_DRAWS = ("ies_obs_en", "ies_observation_ensemble")
READ = (*PARCOV, *OBSCOV, *PRIOR_DRAWS, *ERROR_DRAWS)
CHANCE = 6.0  # standard errors that draws may lie off


def priors_in_files(
    control: ControlFile, rows: Mapping[str, PestRow], priors: dict[str, Any], parameters: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """Change ``priors`` to those of a prior ensemble or covariance, of which the ensemble counts; the further sections.

    The members and the covariance are of the value before scale and offset, the covariance of its decadic logarithm
    where ``partrans`` is ``log``. Raises :class:`ConfigError`.
    """
    uncertain = [name for name, prior in priors.items() if isinstance(prior, dict) and "prior" in prior]
    named = [rows[name].word("parnme") for name in uncertain]
    if draws := _file(control, PRIOR_DRAWS):
        for own in (row.word("parnme") for row in rows.values() if row.word("partrans") == "fixed"):
            if own in draws.columns and np.ptp(draws.of([own])) > 0:
                raise ConfigError(f"{draws.path}: {own} varies there, but is fixed in {control.path}")
        for name in uncertain:
            bounds = {key: priors[name][key] for key in ("lower", "upper")}
            parameters[name] = {**parameters[name], **bounds}
            priors[name] = {"prior": "ensemble", "map": priors[name]["prior"]}
        return {"prior": {"ensemble": dict(zip(uncertain, draws.of(named).T, strict=True))}}
    if (matrix := _file(control, PARCOV)) is None:
        return {}
    covariance = matrix.covariance(named)
    std = np.sqrt(np.diag(covariance))
    for name, own in zip(uncertain, std.tolist(), strict=True):
        key, unit = ("log_std", math.log(10)) if "log_std" in priors[name] else ("std", 1.0)
        priors[name] = {**priors[name], key: own * unit}
    correlation = covariance / np.outer(std, std)
    np.fill_diagonal(correlation, 1.0)
    blocks = []
    count, which = connected_components(correlation != 0, directed=False)
    for block in (np.flatnonzero(which == k) for k in range(count)):
        if len(block) > 1:
            rows_of = correlation[np.ix_(block, block)].tolist()
            blocks.append({"between": [uncertain[i] for i in block], "matrix": rows_of})
    return {"prior_correlation": blocks} if blocks else {}


def errors_in_files(
    control: ControlFile, names: Sequence[str], values: Array, std: Array, bounds: Array
) -> Array | None:
    """R (K, K) of all readings, of which the first are the observations ``names``; None where it is diag(std²).

    What ``obscov`` says of the variance replaces the weights, in ``std`` (K,) too. A file of draws is held against it:
    PEST++ adds them to the readings, and here errors are drawn anew. ``bounds`` (K,): which readings are inequalities.
    Raises :class:`ConfigError`.
    """
    full = None
    if matrix := _file(control, OBSCOV):
        full = np.diag(std**2)
        full[: len(names), : len(names)] = matrix.covariance(names)
        std[:] = np.sqrt(np.diag(full))
        full = full if np.count_nonzero(full) > len(full) else None
        if full is not None and bounds.any():
            raise ConfigError(f"{matrix.path}: correlated errors do not go together with groups of inequalities")
    if draws := _file(control, ERROR_DRAWS):
        _check_draws(draws, [(names[i], values[i], std[i]) for i in range(len(names)) if not bounds[i]])
    return full


def _check_draws(draws: NamedMatrix, observations: Sequence[tuple[str, float, float]]) -> None:
    """Raise :class:`ConfigError` unless they are draws about the values with the stds."""
    names, count = [name for name, _, _ in observations], len(draws.rows)
    for (name, value, std), own in zip(observations, draws.of(names).T, strict=True):
        mean, spread = float(own.mean()), float(own.std(ddof=1)) if count > 1 else math.inf
        off = abs(mean - value) / std * math.sqrt(count), abs(spread / std - 1) * math.sqrt(2 * count)
        if max(off) > CHANCE:
            words = (
                f"{name} has the mean {mean:g} and the std {spread:g} there, and {value:g} and {std:g} by its weight"
            )
            raise ConfigError(f"{draws.path}: {words}; errors are drawn from the weights here: leave the file out")


def _file(control: ControlFile, options: Sequence[str]) -> NamedMatrix | None:
    """The matrix that one of the options names."""
    for name in options:
        if (text := control.options.get(name, "")).lower() not in OFF:
            with retold(ConfigError, ConfigError, f"{control.path}: option {name}: "):
                return read_matrix(control.file(text))
    return None
