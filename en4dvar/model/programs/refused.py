"""What a control file of PEST asks for that would change the estimate and is not done here, by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from en4dvar.model.programs.control_file import ControlFile, PestRow
from en4dvar.plumbing.errors import ConfigError

OFF = ("", "0", "false", "no")
MATRIX = "give correlations as prior_correlation, and standard deviations in priors"
SEARCH = "this is a search for an optimum, not an estimate"
OPTIONS: Mapping[str, str] = {  # option of PEST++, or how several begin → why not
    "parcov": MATRIX,
    "parameter_covariance": MATRIX,
    "obscov": "correlated errors are those of error={'covariance': …}",
    "observation_covariance": "correlated errors are those of error={'covariance': …}",
    "ies_par": "a prior ensemble is that of prior={'ensemble': 'members.csv'}",
    "ies_obs": "errors are drawn here, from the weights",
    "ies_observation_ensemble": "errors are drawn here, from the weights",
    "ies_restart": "an estimate begins at its prior here",
    "ies_weight": "there is one weight an observation here",
    "ies_loc": "name a localisation in assimilation= instead",
    "ies_autoadaloc": "name a localisation in assimilation= instead",
    "ies_reg_factor": "the prior alone regularises here",
    "ies_drop_conflicts": "no observation is left out here",
    "tie_by_group": "tie the parameters one by one",
    "tpl_force_decimal": "numbers are written with an exponent where that is shorter",
    "mou_": SEARCH,
    "opt_": SEARCH,
    "sqp_": SEARCH,
    "da_par": "a prior ensemble is that of prior={'ensemble': 'members.csv'}",
    "da_obs": "errors are drawn here, from the weights",
    "da_restart": "an estimate begins at its prior here",
    "da_weight": "there is one weight an observation here",
}
COLUMNS: Mapping[str, str] = {  # of external tables
    "cycle": "the cycles of pestpp-da are not known here",
    "state_par_link": "the cycles of pestpp-da are not known here",
    "mean": "the middle of a prior is parval1 here",
    "lower_bound": "errors have no bounds here",
    "upper_bound": "errors have no bounds here",
}


def refuse(control: ControlFile, parameters: Sequence[PestRow], observed: Sequence[PestRow], informed: bool) -> None:
    """Raise :class:`ConfigError` with all that is refused; ``informed``: prior information counts."""
    if reasons := [*_modes(control, informed), *_options(control), *_rows(control, parameters, observed)]:
        raise ConfigError(f"{control.path}: " + "; ".join(dict.fromkeys(reasons)))


def _modes(control: ControlFile, informed: bool) -> Iterator[str]:
    words = [row.cells["line"].lower().split() for row in control.lines("control data")]
    mode = control.options.get("pestmode", words[0][1] if words and len(words[0]) > 1 else "estimation").lower()
    if mode.startswith("regul"):
        if informed:
            yield "regularisation mode adapts the weights of prior information; prior_information=False leaves it out"
    elif mode != "estimation":
        yield f"mode {mode} is not known here; estimation is"
    if len(commands := control.lines("model command line")) > 1:
        yield f"{len(commands)} model commands, of which PEST chooses one and PEST++ runs all; put them into one script"


def _options(control: ControlFile) -> Iterator[str]:
    for name, text in control.options.items():
        for begin, why in OPTIONS.items():
            if name.startswith(begin) and text.lower() not in OFF:
                yield f"option {name}: {why}"
                break
        if name in ("enforce_bounds", "ies_enforce_bounds") and text.lower() in OFF:
            yield f"option {name}: bounds hold here"


def _rows(control: ControlFile, parameters: Sequence[PestRow], observed: Sequence[PestRow]) -> Iterator[str]:
    for row in control.rows("observation groups", ["obgnme", "covfle"]):
        if row.word("covfle"):
            yield f"group {row.word('obgnme')} has a covariance, {row.cells['covfle']}: {OPTIONS['obscov']}"
    for row in [*parameters, *observed]:
        for column, why in COLUMNS.items():
            if row.word(column) not in ("", "-1", "0"):
                yield f"column {column}: {why}"
