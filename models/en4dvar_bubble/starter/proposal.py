"""From what the data show to what a first configuration says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.errors import DataError
from en4dvar.state import Array, Parameter
from en4dvar.units import convert
from en4dvar_bubble.collapse import Lobe, doubt, lobe
from en4dvar_bubble.dynamics import R0, R_EQ, R_MAX
from en4dvar_bubble.laws.loading import qualified
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.starter.guess import Guess, first_guess
from en4dvar_bubble.starter.look import Look, Start, look, typical

LAWS: Mapping[Start, str] = {"acoustic": "quadratic-kelvin-voigt", "laser": "neo-hookean-kelvin-voigt"}
MODEL: Mapping[Start, Mapping[str, str]] = {
    "acoustic": {"gas": "heat"},
    "laser": {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"},
}
WHY = {
    "heat": "the gas gives heat to the wall",
    "transport": "near R_max there is more vapour than gas; it condenses at the wall, through the gas",
    "conducting": "the wall warms; with a cold one R_eq comes out wrong (docs/calibration.md)",
}
# The quicker gas that a laser-induced bubble can be compared with; benchmarks/laser_gas.py has what it costs.
SIMPLER: Mapping[Start, Mapping[str, str]] = {
    "acoustic": {},
    "laser": {"gas": "polytropic", "vapour": "none", "medium_heat": "cold", "vapour_pressure": "saturated"},
}
LEAST_NOISE = 0.01  # of R_max: what single-bubble models agree to with good data at best
TIMING = 0.05  # of the step between samples
NUCLEUS = 0.5e-6  # m: order of the stress-free radii in Mancia et al. (2021), Table 1
GAS_FRACTION = 0.12  # R_eq/R_max of laser-induced bubbles, where no radius at rest is seen
# Bounds of the log_std of a guess: it errs by that much, so that a narrower prior would exclude what made the data.
WIDTHS = {"G": (1.0, 1.5), "mu": (0.7, 1.2)}
BETWEEN = 1.645  # standard deviations from the median to 5 and 95 %
SAME_CLOCK = 2e-6  # s: what a first guess can be off by
BUBBLES = (1e-7, 0.1)  # m: between these radii


@dataclass(frozen=True)
class Entry:
    """One line of a section: key, value as YAML, and a comment."""

    key: str
    value: str
    comment: str = ""


@dataclass(frozen=True)
class Proposal:
    """What goes into the configuration; ``remarks`` and ``warnings`` are told to the user.

    ``simpler``: keys of the model, and their values, of quicker physics to compare with; empty where there is none.
    """

    data: tuple[Entry, ...]
    model: tuple[Entry, ...]
    parameters: tuple[Entry, ...]
    simpler: Mapping[str, str]
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def propose(
    histories: Mapping[str, tuple[Array, Array]], start: Start | None = None, law: str | None = None
) -> Proposal:
    """A proposal for one or several data sets: name → times (K,) s, radius (K,) m.

    Raises
    ------
    DataError: a history shows no bubble, or the data sets suggest different starts. ConfigError: unknown law.
    """
    looks = _looks(histories, start)
    views = list(looks.values())
    chosen = views[0].start
    model, law_name = _built(chosen, law)
    look = _typical(views)
    others = _others(model, look)
    observed = {"R_max": look.lobe.R_max, "t_c": look.lobe.t_c, "rebound": look.rebound}
    guess = first_guess(model, others, observed)
    ratio = look.lobe.rayleigh_ratio(model.medium)
    told = [
        f"R_max {_text(look.lobe.R_max, 'm', 'um', 3)}, collapse {_text(look.lobe.t_c, 's', 'us', 3)} later, "
        f"{ratio:.2f} of the Rayleigh time (elasticity shortens it, viscosity and gas prolong it)"
    ]
    told += [f"start: {chosen} ({look.reason})"] * look.clear
    other = "laser" if chosen == "acoustic" else "acoustic"
    doubt = f"start: {chosen} is only a proposal ({look.reason}); if it was {other}, say --start {other}"
    warnings = [doubt] * (not look.clear)
    doubted = _doubted(looks, model)
    if doubted:
        warnings += doubted
    elif not BUBBLES[0] < look.lobe.R_max < BUBBLES[1]:
        warnings.append("no bubble has such a radius; are the units of both columns right?")
    elif guess.far:
        warnings.append(
            f"no G and mu of {model.law.name} give this {'R_max and ' if chosen == 'acoustic' else ''}collapse time: "
            + ("is the driving that of your experiment?" if chosen == "acoustic" else "are scale and frame rate right?")
        )
    return Proposal(
        _data(chosen, look, model, {**others, **guess.values}),
        _model(law_name, chosen, look),
        _parameters(model, chosen, look, Guess({}, {}, 0.0) if doubted else guess),
        SIMPLER[chosen],
        tuple(told),
        tuple(warnings),
    )


def _doubted(looks: Mapping[str, Look], model: BubbleModel) -> list[str]:
    """Data sets whose scales cannot be right, one line for those with the same words."""
    found: dict[str, list[str]] = {}
    for name, view in looks.items():
        if words := doubt(view.lobe, model.medium):
            found.setdefault(words, []).append(name)
    return [words if len(looks) == 1 else f"{', '.join(names)}: {words}" for words, names in found.items()]


def starter(start: Start, law: str | None) -> Proposal:
    """A proposal without data: examples to be replaced."""
    model, law_name = _built(start, law)
    data = [Entry("error", "{radius_std: 1 % of maximum}", "how well a radius is known: put yours")]
    if start == "laser":
        data[:0] = [Entry("window", "{from: R_max, to: minimum 2}"), Entry("time_zero", "window")]
    lines = [_example(p, model) for p in model.law.parameters]
    lines += _radii(start, None)
    lines += [Entry("t_s", "{prior: normal, mean: 0 us, std: 0.5 us}", "the clock of the data against the model's")]
    return Proposal(tuple(data), _model(law_name, start, None), tuple(lines), SIMPLER[start])


def with_columns(proposal: Proposal, errors: Sequence[str], common: str) -> Proposal:
    """The proposal with the errors that the data file states: columns of the std of radii and of times, and the
    ``common`` std of what moves all radii alike, "" where the file states none."""
    kept = [entry for entry in proposal.data if entry.key not in ("  radius_std", "  time_std", "  # time_std")]
    told = [
        Entry("  radius_std", f"{{column: {errors[0]}}}", "each reading's own"),
        Entry("  model_std", "1 % of maximum", "a model is rarely better; added to it in squares"),
        Entry("  time_std", f"{{column: {errors[1]}}}", "of the exposure"),
    ]
    alike = [
        Entry("reading_offset", f"{{prior: normal, mean: 0 um, std: {common}}}", "the level of the edge, of all alike"),
        Entry("# reading_scale", "{prior: lognormal, median: 1, log_std: 0.01}", "how well is the pixel's size known?"),
    ]
    return replace(proposal, data=(*kept, *told), parameters=(*proposal.parameters, *alike * bool(common)))


def _built(start: Start, law: str | None) -> tuple[BubbleModel, str]:
    """The model, and how the file names its law. Raises :class:`ConfigError` where there is no such law."""
    name = qualified(law) if law else LAWS[start]
    settings = BubbleSettings.model_validate({**MODEL[start], "start": start, "law": name})
    return BubbleModel.from_settings(settings), name


def _looks(histories: Mapping[str, tuple[Array, Array]], start: Start | None) -> dict[str, Look]:
    looks: dict[str, Look] = {}
    for name, (times, radius) in histories.items():
        try:
            looks[name] = look(times, radius, start)
        except DataError as error:
            raise DataError(f"{name}: {error}") from None
    if len({view.start for view in looks.values()}) > 1:
        kinds = {kind: [n for n, view in looks.items() if view.start == kind] for kind in ("acoustic", "laser")}
        told = "; ".join(f"{kind}: {', '.join(names[:3])}" for kind, names in kinds.items())
        raise DataError(f"the data sets suggest different starts ({told}); say --start acoustic or --start laser")
    return looks


def _typical(views: Sequence[Look]) -> Look:
    """One look at several data sets: medians of the numbers, words of the first that is not clear."""
    first = next((v for v in views if not v.clear), views[0])
    return replace(
        first,
        step=typical([v.step for v in views]),
        noise=typical([v.noise for v in views]),
        rebound=typical([v.rebound for v in views]),
        rest=typical([v.rest for v in views]),
        n=sum(v.n for v in views),
        times=(min(v.times[0] for v in views), max(v.times[1] for v in views)),
        lobe=Lobe(*(typical([getattr(v.lobe, k) for v in views]) for k in ("R_max", "t_max", "t_c"))),
        n_minima=min(v.n_minima for v in views),
        prominence=min(v.prominence for v in views),
        descent=max((v.descent for v in views if np.isfinite(v.descent)), default=float("nan")),
    )


def _others(model: BubbleModel, look: Look) -> dict[str, float]:
    """Every parameter but G and μ at the centre of its proposed prior, SI."""
    example = {name: float(v[0]) for name, v in model.law.example_values().items() if name not in WIDTHS}
    if model.start == "acoustic":
        return {**example, "R0": NUCLEUS}
    return {**example, "R_eq": _rest(look), "R_max": look.lobe.R_max}


def _rest(look: Look) -> float:
    return look.rest if np.isfinite(look.rest) else GAS_FRACTION * look.lobe.R_max


def _data(start: Start, look: Look, model: BubbleModel, theta: Mapping[str, float]) -> tuple[Entry, ...]:
    """Window, clock and errors."""
    if start == "laser":
        end = f"minimum {min(look.n_minima, 2)}" if look.n_minima else "end"
        low = f", prominence: {100 * look.prominence:g} %" if look.prominence < 0.1 else ""
        lines = [
            Entry("window", f"{{from: R_max, to: {end}{low}}}", "what happens before R_max is not modelled"),
            Entry("time_zero", "window", "the model's clock starts at R_max"),
        ]
    else:
        end = _text(look.descent, "s", "us", 4) if np.isfinite(look.descent) else "end"
        words = "growth and collapse down to 20 % of R_max; then the wall is too fast for the model"
        lines = [Entry("window", f"{{from: start, to: {end}}}", words), _clock(look, model, theta)]
    least = LEAST_NOISE * look.lobe.R_max
    scatter = (
        f"scatter near R_max: {_text(look.noise, 'm', 'um')}"
        if np.isfinite(look.noise)
        else "too few points near R_max"
    )
    if look.noise > least:
        std, words = _text(look.noise, "m", "um"), scatter
    else:
        std, words = "1 % of maximum", f"{scatter}; a model is rarely better than 1 %"
    timing = _text(TIMING * look.step, "s", "us")
    key = "  time_std" if start == "laser" else "  # time_std"  # a flash is short
    return (
        *lines,
        Entry("error", "", "how well a reading is known: put what you know of your camera"),
        Entry("  radius_std", std, words),
        Entry(key, timing, "5 % of the step between frames: exposure and jitter matter where R is steep"),
    )


def _clock(look: Look, model: BubbleModel, theta: Mapping[str, float]) -> Entry:
    """Where the file's zero lies on the driving's clock: the maximum of the first guess is put on that of the data."""
    peak = getattr(model.driving, "end", 0.0)
    times = np.linspace(0.0, peak + 5 * look.lobe.t_c, 400)
    shift = 0.0
    if all(p.name in theta for p in model.parameters):
        (path,) = model.trajectories(model.initial_states({n: np.array([v]) for n, v in theta.items()}), times)
        try:
            shift = look.lobe.t_max - lobe(times, path["R"]).t_max  # type: ignore[index]
        except (DataError, TypeError):
            shift = 0.0
    if abs(shift) <= SAME_CLOCK:
        return Entry("time_zero", "file", "the file's clock agrees with that of the pulse")
    zero = min(shift, look.times[0])
    return Entry(
        "time_zero", _text(zero, "s", "us"), "puts the guess's R_max on the data's: give the clock of your pulse"
    )


def _model(law: str, start: Start, look: Look | None) -> tuple[Entry, ...]:
    lines = [
        Entry("name", "bubble"),
        Entry("law", law, "others: en4dvar laws"),
        Entry("start", start, look.reason if look else "or " + ("laser" if start == "acoustic" else "acoustic")),
        *(Entry(key, value, WHY[value]) for key, value in MODEL[start].items()),
    ]
    if start == "acoustic":
        pulse = "{kind: histotripsy, amplitude: -24 MPa, frequency: 1 MHz, exponent: 3.7, delay: 5 us}"
        lines.append(Entry("driving", pulse, "put the pulse of your experiment"))
    return tuple(lines)


def _parameters(model: BubbleModel, start: Start, look: Look, guess: Guess) -> tuple[Entry, ...]:
    lines = []
    for p in model.law.parameters:
        if p.name in guess.values:
            low, high = WIDTHS[p.name]
            width = f"{np.clip(guess.log_std[p.name], low, high):.2g}"
            value = _text(guess.values[p.name], p.unit, p.display_unit)
            from_what = "R_max and collapse time" if start == "acoustic" else "collapse time and rebound"
            off = math.exp(BETWEEN * float(width))
            words = f"{p.label}: first guess from {from_what}, may be off by a factor of {off:.2g}; "
            words += "narrow it to what you knew before"
            lines.append(Entry(p.name, f"{{prior: lognormal, median: {value}, log_std: {width}}}", words))
        else:
            lines.append(_example(p, model))
    lines += _radii(start, look)
    std = _text(0.5e-6 if start == "acoustic" else 0.5 * look.step, "s", "us")
    words = (
        "the clock of the data against that of the pulse" if start == "acoustic" else "R_max falls between two frames"
    )
    return (*lines, Entry("t_s", f"{{prior: normal, mean: 0 us, std: {std}}}", words))


def _example(p: Parameter, model: BubbleModel) -> Entry:
    """A prior about the law's example value."""
    value = float(model.law.example_values()[p.name][0]) if p.name in model.law.example_values() else 1.0
    text = _text(value, p.unit, p.display_unit)
    words = f"{p.label}: an example value, not from the data"
    if p.transform == "lognormal":
        return Entry(p.name, f"{{prior: lognormal, median: {text}, log_std: 0.5}}", words)
    if p.transform == "logit" and np.all(np.isfinite(p.bounds)):
        low, high = (_text(b, p.unit, p.display_unit) for b in p.bounds)
        return Entry(p.name, f"{{prior: logit, lower: {low}, upper: {high}, median: {text}, logit_std: 0.5}}", words)
    return Entry(p.name, f"{{prior: normal, mean: {text}, std: 20 %}}", words)


def _radii(start: Start, look: Look | None) -> list[Entry]:
    if start == "acoustic":
        value = _text(NUCLEUS, "m", "um")
        return [
            Entry(R0.name, f"{{prior: lognormal, median: {value}, log_std: 0.5}}", f"{R0.label}: the data hardly tell")
        ]
    known = look is not None and np.isfinite(look.rest)
    words = (
        "the radius at rest; wide, for gas leaks into the gel, and the model's does not"
        if known
        else f"{GAS_FRACTION:g} R_max: no radius at rest is seen"
    )
    value, width = (_text(_rest(look), "m", "um") if look else "20 um"), 0.3 if known else 0.4
    return [
        Entry(R_EQ.name, f"{{prior: lognormal, median: {value}, log_std: {width}}}", words if look else R_EQ.label),
        Entry(R_MAX.name, "{prior: normal, mean: maximum, std: 1 %}", "the largest radius of each data set"),
    ]


def _text(value: float, unit: str, display: str, digits: int = 2) -> str:
    """A quantity to some digits in a readable unit, e.g. ``0.27 kPa``."""
    number = f"{float(f'{convert(value, unit, display):.{digits}g}'):g}"
    return number if display == "1" else f"{number} {display}"
