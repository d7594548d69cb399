"""A control file of PEST or PEST++ (``.pst``) as the arguments of :func:`en4dvar.estimate`.

Priors are those of PEST++'s ensemble smoother: ``parval1`` in the middle and bounds four standard deviations apart
(option ``par_sigma_range``), of the logarithm where ``partrans`` is ``log``; at the bounds they are cut off. The std of
an observation is 1/weight; those of weight 0 are left out. Prior information counts as further observations. The
observations of groups that hold inequalities are bounds. Files of covariances and of a prior ensemble take the place of
bounds and weights. What it asks for that would change the estimate and is not done here is an error that names it.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from en4dvar.model.programs.control_file import ControlFile, NamedMatrix, PestRow, read_control, read_matrix, text_of
from en4dvar.model.programs.languages import identifier, is_pest, names_in
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, retold

PARAMETERS = ["parnme", "partrans", "parchglim", "parval1", "parlbnd", "parubnd", "pargp", "scale", "offset", "dercom"]
OBSERVATIONS = ["obsnme", "obsval", "weight", "obgnme"]
RANGE = 4.0  # standard deviations between the bounds: PEST++ (White et al. 2020), option par_sigma_range
OBSERVED = "observations"
BOUNDS = {"at_most": ("l_", "less", ">@"), "at_least": ("g_", "greater", "<@")}  # how their groups begin: PEST++
RANGES = {"at_most": "less_than", "at_least": "greater_than"}  # columns of external tables, where the group is none
_WHY_NOT = {  # reason → options of PEST++, or how several begin
    "errors are drawn here, from the weights": "ies_no_noise da_obs",
    "weights are those of the control file": "ies_phi_factor",
    "an estimate begins at its prior here": "ies_restart da_restart ies_obs_restart ies_observation_restart",
    "there is one weight an observation here": "ies_weight da_weight",
    "name a localisation in assimilation= instead": "ies_loc ies_autoadaloc",
    "the prior alone regularises here": "ies_reg_factor",
    "no observation is left out here": "ies_drop_conflicts",
    "tie the parameters one by one": "tie_by_group",
    "numbers are written with an exponent where that is shorter": "tpl_force_decimal",
    "this is a search for an optimum, not an estimate": "mou_ opt_ sqp_",
    "a prior ensemble is that of prior={'ensemble': 'members.csv'}": "da_par",
}
OPTIONS = {option: why for why, options in _WHY_NOT.items() for option in options.split()}
COLUMNS: Mapping[str, str] = {  # of external tables
    "cycle": "the cycles of pestpp-da are not known here",
    "state_par_link": "the cycles of pestpp-da are not known here",
    "mean": "the middle of a prior is parval1 here",
    "lower_bound": "errors have no bounds here",
    "upper_bound": "errors have no bounds here",
}
OFF = ("", "0", "false", "no")
PARCOV = ("parcov", "parameter_covariance", "parcov_filename")
OBSCOV = ("obscov", "observation_covariance", "obscov_filename")
PRIOR_DRAWS = ("ies_par_en", "ies_parameter_ensemble", "ies_par_csv", "ies_parameter_csv")  # the last two: earlier
ERROR_DRAWS = ("ies_obs_en", "ies_observation_ensemble", "ies_obs_csv", "ies_observation_csv")
READ = (*PARCOV, *OBSCOV, *PRIOR_DRAWS, *ERROR_DRAWS)
CHANCE = 6.0  # standard errors that draws may lie off
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[edED][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*({_NUMBER})\s*\*\s*(?:(log)\s*\(\s*([^\s()]+)\s*\)|([^\s()*=]+))\s*", re.IGNORECASE)


def from_pest(path: str | Path, files: Sequence[str] = (), *, prior_information: bool = True) -> dict[str, Any]:
    """``model``, ``data``, ``priors``, ``error`` and what is correlated, for ``en4dvar.estimate(**from_pest(path))``.

    Observations, and behind them prior information, count as readings 1, 2, 3, … in the order of the control file.
    Names of parameters are in lower case, with ``_`` for what is neither letter nor digit.

    Parameters
    ----------
    files: beside the control file, copied into each scratch directory: whatever the model needs besides its templates.
    prior_information: whether it counts; PEST++'s ensemble smoother leaves it out.

    Raises
    ------
    ConfigError: it cannot be read (with the line), or asks for what is not known here.
    """
    control = read_control(Path(path).absolute())
    rows = control.rows("parameter data", PARAMETERS)
    observed = [row for row in _named_once(control.rows("observation data", OBSERVATIONS)) if _weight(row) > 0]
    parameters = _parameters(control, [row for row in rows if len(row.cells) > 2])
    parents = {row.word("parnme"): row.word("partrans") for row in rows if len(row.cells) == 2}
    equations = _equations(control, parameters) if prior_information else []
    informed = {reading.group for reading in equations}
    refused = [*_refused(control, bool(informed)), *_refused_rows(control, rows, observed, informed)]
    if reasons := dict.fromkeys(refused):
        raise ConfigError(f"{control.path}: {'; '.join(reasons)}")
    observations = [reading for row in observed for reading in _observations(row)]
    readings, names = [*observations, *equations], [reading.name for reading in observations]
    if not readings:
        raise ConfigError(f"{control.path}: no observation has a weight above 0")
    templates, instructions = _files(control)
    scalings = {name: _scaling(row) for name, row in parameters.items()}
    priors = {name: _prior(control, row, parameters, parents) for name, row in parameters.items()}
    _check_templates(templates.values(), parameters, priors)
    correlated = priors_in_files(control, parameters, priors, scalings)
    return {
        "model": {
            "command": " && ".join(row.cells["line"].strip() for row in control.sections["model command line"]),
            "shell": True,
            "parameters": scalings,
            "templates": templates,
            "files": [str(control.file(file)) for file in files],
            "outputs": {
                OBSERVED: {
                    "instructions": instructions,
                    "delimiters": control.options.get("additional_ins_delimiters", ""),
                    OBSERVED: names,
                    "combinations": [reading.terms for reading in equations],
                }
            },
            "time_unit": "1",
        },
        "data": {
            "time": np.arange(1.0, len(readings) + 1),
            OBSERVED: np.array([reading.value for reading in readings]),
        },
        "priors": priors,
        "error": _error(control, readings, names),
        **correlated,
    }


class _Reading(NamedTuple):
    """An observation, or an equation of prior information with its ``terms``; its group, and which bound it is."""

    value: float
    std: float
    terms: Mapping[str, float] = {}
    name: str = ""
    group: str = ""
    bound: str = ""


def _observations(row: PestRow) -> list[_Reading]:
    """The one reading of an observation, or the two bounds of a range. Raises :class:`ConfigError`."""
    std, group = row.number("standard_deviation", 1 / _weight(row)), row.word("obgnme")
    own = _Reading(row.number("obsval"), std, name=row.word("obsnme"), group=group, bound=_bound(group))
    values = {} if own.bound else {key: row.number(column) for key, column in RANGES.items() if column in row.cells}
    if len(values) == 2 and not values["at_least"] < values["at_most"]:
        raise ConfigError(f"{row.where}: greater_than of {own.name} is not below its less_than")
    return [own._replace(value=value, bound=key) for key, value in values.items()] or [own]


def _bound(group: str) -> str:
    """Which bound the readings of a group are, "" if none."""
    return next((key for key, begin in BOUNDS.items() if group.startswith(begin)), "")


def _error(control: ControlFile, readings: Sequence[_Reading], names: Sequence[str]) -> Any:
    """The std of each reading, or their covariance, and where some are inequalities, which are bounds."""
    std = np.array([reading.std for reading in readings])
    marks = {key: np.array([float(reading.bound == key) for reading in readings]) for key in BOUNDS}
    bounds = {key: each for key, each in marks.items() if each.any()}
    values = np.array([reading.value for reading in readings])
    full = errors_in_files(control, names, values, std, np.max([*marks.values()], axis=0))
    if full is not None:
        return {"covariance": full}
    return {f"{OBSERVED}_std": std, **bounds} if bounds else std


def _weight(row: PestRow) -> float:
    """Raises :class:`ConfigError` where it is negative."""
    weight = row.number("weight")
    if weight < 0:
        raise ConfigError(f"{row.where}: the weight {weight:g} is negative")
    return weight


def _parameters(control: ControlFile, rows: Sequence[PestRow]) -> dict[str, PestRow]:
    """Name as it is here → row. Raises :class:`ConfigError` where two become one."""
    named: dict[str, PestRow] = {}
    for row in rows:
        name = identifier(row.word("parnme"))
        if name in named:
            words = f"{named[name].word('parnme')} and {row.word('parnme')} are both {name!r} here"
            raise ConfigError(f"{row.where}: {words}; rename one of them")
        named[name] = row
    if not named:
        raise ConfigError(f"{control.path}: no parameter in '* parameter data'")
    return named


def _named_once(rows: Sequence[PestRow]) -> Sequence[PestRow]:
    """The rows of observations. Raises :class:`ConfigError` where two have one name."""
    first: dict[str, PestRow] = {}
    for row in rows:
        if (before := first.setdefault(row.word("obsnme"), row)) is not row:
            raise ConfigError(f"{row.where}: observation {row.word('obsnme')} stands in {before.where}, too")
    return rows


def _check_templates(templates: Iterable[str], parameters: Mapping[str, PestRow], priors: Mapping[str, Any]) -> None:
    """Raise :class:`ConfigError`: no template has a parameter that is estimated, nor what is tied to it."""
    with retold(ValueError, ConfigError):
        named = set[str]().union(*(names_in(text_of(Path(file)), Path(file)) for file in templates))
    tied = {name: prior["tied"] for name, prior in priors.items() if isinstance(prior, dict) and "tied" in prior}
    named |= {tied[name] for name in named & tied.keys()}
    for name, row in parameters.items():
        if name not in named and row.word("partrans") in ("log", "none"):
            raise ConfigError(f"{row.where}: parameter {row.word('parnme')} is in no template")


def _scaling(row: PestRow) -> dict[str, float]:
    """What of scale and offset is not trivial. Raises :class:`ConfigError`."""
    scale, offset = row.number("scale", 1.0), row.number("offset", 0.0)
    if scale == 0:
        raise ConfigError(f"{row.where}: the scale of {row.word('parnme')} is 0")
    return {**({"scale": scale} if scale != 1 else {}), **({"offset": offset} if offset else {})}


def _prior(control: ControlFile, row: PestRow, parameters: Mapping[str, PestRow], parents: Mapping[str, str]) -> Any:
    """What ``priors`` says of a parameter. Raises :class:`ConfigError`."""
    name, kind, value = row.word("parnme"), row.word("partrans"), row.number("parval1")
    if kind == "fixed":
        return value
    if kind == "tied":
        to = identifier(row.word("partied") or parents.get(name, ""))
        if to not in parameters or parameters[to].word("partrans") == "tied":
            raise ConfigError(f"{row.where}: {name} is tied to no parameter that is estimated or fixed")
        if parameters[to].number("parval1") == 0:
            raise ConfigError(f"{row.where}: {name} is tied to {to}, whose parval1 is 0")
        return {"tied": to, "factor": value / parameters[to].number("parval1")}
    if kind not in ("log", "none"):
        raise ConfigError(f"{row.where}: parameter {name} is {kind!r}; log, none, fixed and tied are known")
    low, high = row.number("parlbnd"), row.number("parubnd")
    if not (low <= value <= high and low < high):
        raise ConfigError(f"{row.where}: parval1 of {name} is {value:g}, outside of its bounds {low:g} and {high:g}")
    if kind == "log" and not low > 0:
        raise ConfigError(f"{row.where}: {name} is log, but its lower bound {low:g} is not above 0")
    span = math.log(high / low) if kind == "log" else high - low
    stated = row.number("standard_deviation", 0.0) * (math.log(10) if kind == "log" else 1)  # PEST's log is log10
    std = stated or span / control.number("par_sigma_range", RANGE)
    bounds = {"lower": low, "upper": high}
    if kind == "log":
        return {"prior": "lognormal", "median": value, "log_std": std, **bounds}
    return {"prior": "normal", "mean": value, "std": std, **bounds}


def _equations(control: ControlFile, parameters: Mapping[str, PestRow]) -> list[_Reading]:
    """Prior information, ``label factor * name + factor * log(name) = value weight group``. Raises ConfigError."""
    lines = [(row.where, row.cells["line"].partition(" ")[2]) for row in control.sections["prior information"]]
    for row in control.tables("prior information"):
        equation, *further = (row.cells.get(key, "") for key in ("equation", "weight", "obgnme"))
        lines.append((row.where, " ".join([equation, *further])))
    return [reading for where, text in lines if (reading := _equation(where, text, parameters))]


def _equation(where: str, text: str, parameters: Mapping[str, PestRow]) -> _Reading | None:
    """None where its weight is 0."""
    left, _, right = text.rpartition("=")
    terms: dict[str, float] = {}
    at = 0
    while term := _TERM.match(left, at):
        sign, factor, log, of_log, plain = term.groups()
        name = identifier(of_log or plain)
        if name not in parameters:
            raise ConfigError(f"{where}: prior information on {of_log or plain}, which is no parameter")
        key = f"log10({name})" if log else name
        terms[key] = terms.get(key, 0.0) + float(f"{sign}1") * float(factor.lower().replace("d", "e"))
        at = term.end()
    numbers = PestRow(where, dict(zip(("value", "weight"), right.split(), strict=False)))
    if at < len(left.rstrip()) or not terms:
        raise ConfigError(f"{where}: {text.strip()!r} is no equation of prior information")
    weight = _weight(numbers)
    group = " ".join(right.lower().split()[2:3])
    return _Reading(numbers.number("value"), 1 / weight, terms, "", group, _bound(group)) if weight else None


def _files(control: ControlFile) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Input file → template, and output file → instruction files. Raises :class:`ConfigError`."""
    templates: dict[str, str] = {}
    instructions: dict[str, list[str]] = {}
    for section in ("model input", "model output", "model input/output"):
        for row in control.rows(section, ["pest_file", "model_file", "more"]):
            if not {"pest_file", "model_file"} <= set(row.cells) or "more" in row.cells:
                raise ConfigError(f"{row.where}: a line of '* {section}' holds two names of files")
            own = control.file(row.cells["pest_file"])
            path = Path(row.cells["model_file"].strip("\"'").replace("\\", "/"))
            file = str(path)
            if path.is_absolute() or ".." in path.parts:
                raise ConfigError(f"{row.where}: {file} lies outside of the folder that the model runs in")
            if section == "model output" or (section != "model input" and is_pest(text_of(own), "if")):
                instructions.setdefault(file, []).append(str(own))
            elif file in templates:
                raise ConfigError(f"{control.path}: two templates become {file}")
            else:
                templates[file] = str(own)
    if not instructions:
        raise ConfigError(f"{control.path}: no instruction file")
    return templates, instructions


def _refused(control: ControlFile, informed: bool) -> Iterator[str]:
    """Modes and options that are not known here; ``informed``: prior information counts."""
    words = [row.cells["line"].lower().split() for row in control.sections["control data"]]
    mode = control.options.get("pestmode", words[0][1] if words and len(words[0]) > 1 else "estimation").lower()
    if mode.startswith("regul"):
        if informed:
            yield "regularisation mode adapts the weights of prior information; prior_information=False leaves it out"
    elif mode != "estimation":
        yield f"mode {mode} is not known here; estimation is"
    for name, text in control.options.items():
        reasons = (why for begin, why in OPTIONS.items() if name.startswith(begin))
        if name not in READ and text.lower() not in OFF and (why := next(reasons, "")):
            yield f"option {name}: {why}"
        if name in ("enforce_bounds", "ies_enforce_bounds") and text.lower() in OFF:
            yield f"option {name}: bounds hold here"


def _refused_rows(
    control: ControlFile, parameters: Sequence[PestRow], observed: Sequence[PestRow], informed: set[str]
) -> Iterator[str]:
    """What rows ask for and is not done here; ``informed``: groups of prior information that counts."""
    used = {row.word("obgnme") for row in observed} | informed
    for row in control.rows("observation groups", ["obgnme", "covfle"]):
        if row.word("covfle") and row.word("obgnme") in used:
            words = "correlated errors are those of option obscov"
            yield f"group {row.word('obgnme')} has a covariance, {row.cells['covfle']}: {words}"
    for row in parameters:
        if row.word("dercom") not in ("", "0", "1"):
            yield f"{row.word('parnme')} has a model command of its own for derivatives (dercom {row.word('dercom')})"
    for row in [*parameters, *observed]:
        for column, why in COLUMNS.items():
            if row.word(column) not in ("", "-1", "0"):
                yield f"column {column}: {why}"


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
            words = f"{name} has the mean {mean:g} and std {spread:g} there, and {value:g} and {std:g} by its weight"
            raise ConfigError(f"{draws.path}: {words}; errors are drawn from the weights here: leave the file out")


def _file(control: ControlFile, options: Sequence[str]) -> NamedMatrix | None:
    for name in options:
        if (text := control.options.get(name, "")).lower() not in OFF:
            with retold(ConfigError, ConfigError, f"{control.path}: option {name}: "):
                return read_matrix(control.file(text))
    return None
