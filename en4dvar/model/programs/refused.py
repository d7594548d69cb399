"""What a control file of PEST asks for that would change the estimate and is not done here, by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from en4dvar.model.programs.control_file import ControlFile, PestRow
from en4dvar.model.programs.spread import OFF, READ
from en4dvar.plumbing.errors import ConfigError

SEARCH = "this is a search for an optimum, not an estimate"
OPTIONS: Mapping[str, str] = {  # option of PEST++, or how several begin → why not
    "ies_no_noise": "errors are drawn here, from the weights",
    "ies_phi_factor": "weights are those of the control file",
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


def refuse(
    control: ControlFile, parameters: Sequence[PestRow], observed: Sequence[PestRow], informed: set[str]
) -> None:
    """Raise :class:`ConfigError` with all that is refused; ``informed``: groups of prior information that counts."""
    if reasons := [
        *_modes(control, bool(informed)),
        *_options(control),
        *_rows(control, parameters, observed, informed),
    ]:
        raise ConfigError(f"{control.path}: " + "; ".join(dict.fromkeys(reasons)))


def _modes(control: ControlFile, informed: bool) -> Iterator[str]:
    words = [row.cells["line"].lower().split() for row in control.lines("control data")]
    mode = control.options.get("pestmode", words[0][1] if words and len(words[0]) > 1 else "estimation").lower()
    if mode.startswith("regul"):
        if informed:
            yield "regularisation mode adapts the weights of prior information; prior_information=False leaves it out"
    elif mode != "estimation":
        yield f"mode {mode} is not known here; estimation is"


def _options(control: ControlFile) -> Iterator[str]:
    for name, text in control.options.items():
        for begin, why in OPTIONS.items():
            if name.startswith(begin) and name not in READ and text.lower() not in OFF:
                yield f"option {name}: {why}"
                break
        if name in ("enforce_bounds", "ies_enforce_bounds") and text.lower() in OFF:
            yield f"option {name}: bounds hold here"


def _rows(
    control: ControlFile, parameters: Sequence[PestRow], observed: Sequence[PestRow], informed: set[str]
) -> Iterator[str]:
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
