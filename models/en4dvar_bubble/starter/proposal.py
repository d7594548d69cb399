"""From what the data show to what a first configuration says."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from en4dvar.estimation.population.campaign import FEWEST_SETS
from en4dvar.inputs.window import vertex
from en4dvar.model.forward import Trajectory
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.hints import listed
from en4dvar.plumbing.units import convert, unit_after
from en4dvar_bubble.collapse import conceivable, lobe
from en4dvar_bubble.dynamics import R0, R_EQ, R_MAX
from en4dvar_bubble.laws.loading import qualified
from en4dvar_bubble.laws.shells import MarmottantShell
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.starter import elsewhere
from en4dvar_bubble.starter.elsewhere import Entry
from en4dvar_bubble.starter.grouped import NO_GROUPS, Grouped, Together, ends_with
from en4dvar_bubble.starter.guess import FAR, OF_GELS, RELAXING, SPAN, STIFFENING, Guess, first_guess
from en4dvar_bubble.starter.look import (
    BETWEEN,
    COLLAPSED,
    TOP_WIDTH,
    Look,
    Start,
    at_rest,
    look,
    typical_look,
    usable,
    without_rebound,
)
from en4dvar_bubble.starter.physics import SIMPLER, WHY, physics

LAWS: Mapping[Start, str] = {"acoustic": "quadratic-kelvin-voigt", "laser": "neo-hookean-kelvin-voigt"}
LEAST_NOISE = 0.0005  # of R_max: no camera reads better
NOISE_LOG_STD = 0.4  # of the noise scale: a scatter is told by a dozen windows, and not alike at all radii
DISCREPANCY = "{kernel: matern-3/2, grows_beyond: 10 m/s}"
LEAST_SHIFT = 0.1  # of the step between samples: of the prior of the clock
TIMING = 0.05  # of the step between samples
SAME_STEP = 1.1  # of films whose largest and smallest steps differ by less
NUCLEUS = (0.66e-6, 0.8)  # m; both gels of Mancia et al. (2021), Table 1: 0.43 ± 0.31 and 1.3 ± 0.44 µm
# Bounds of the log_std of a guess: it errs by that much, so that a narrower prior would exclude what made the data.
WIDTHS = {"G": (2.0, 2.5), "mu": (1.5, 2.0)}  # of 47 synthetic gels ln G/guess had a root mean square of 2.1
SAME_CLOCK = 2e-6  # s: of a guessed clock
COLLAPSE_ALONE = ", and its window ends with the first collapse, before the rebound has a top"
ANOTHER = (
    "{}: behind {:.6g} us another bubble begins, {} the one before, which had come to rest: give each a file of its "
    "own, or a column that says whose each row is, and name it by --by{}"
)
EACH_ALONE = "it is for each bubble alone, and the gel's values do not use it; 'true' takes up to twice the time"
BUBBLES = (1e-7, 0.1)  # m: between these radii
SEEN = (3e-6, 50e-9, 1e-4)  # m, s, m: one below is not read in shorter steps; radius of a usual bubble


@dataclass(frozen=True)
class Proposal:
    """What goes into the configuration; ``remarks`` and ``warnings`` are told to the user.

    ``simpler``: keys of the model, and their values, of quicker physics to compare with; empty where there is none.
    ``population``: what is asked of several bubbles together; None where there are too few of them.
    ``longer``: where the window may end, too, in a gel of which most histories have a third minimum; "" in others.
    ``datasets``: what it was made from; others show no bubble, as ``warnings`` tell.
    """

    data: tuple[Entry, ...]
    model: tuple[Entry, ...]
    parameters: tuple[Entry, ...]
    simpler: Mapping[str, str]
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    population: Together | None = None
    longer: str = ""
    datasets: tuple[str, ...] = ()
    assimilation: tuple[Entry, ...] = (
        Entry("members", "48"),
        Entry("draws", "400", "effective draws if the posterior is sampled: its mean is then known to 5 % of its std"),
    )


def propose(
    histories: Mapping[str, tuple[Array, Array]],
    start: Start | None = None,
    law: str | None = None,
    medium: str = "gel",
    groups: Grouped = NO_GROUPS,
    scale: elsewhere.Known = elsewhere.SCALE,
    edge: float = 0.0,
) -> Proposal:
    """A proposal for one or several data sets: name → times (K,) s, radius (K,) m.

    ``medium``: one of those of :mod:`en4dvar_bubble.starter.elsewhere`. ``groups``: of its data sets. ``scale``: what
    is known of what multiplies all radii; ``edge``: std (m) of what moves them all alike.

    Raises :class:`DataError`: no history shows a bubble, or they suggest different starts. ConfigError: unknown law.
    """
    looks, unseen = _looks(histories, start)
    views = list(looks.values())
    chosen, look = views[0].start, typical_look(views)
    model, law_name = built(chosen, law, look)
    others = _others(model, look)
    observed = {"R_max": look.lobe.R_max, "t_c": look.lobe.t_c, "rebound": look.rebound}
    guess = first_guess(elsewhere.centred(model, medium), others, observed)
    ratio = look.lobe.rayleigh_ratio(model.medium)
    told = [
        f"R_max {_text(look.lobe.R_max, 'm', 'um', 3)}, collapse {_text(look.lobe.t_c, 's', 'us', 3)} later"
        f"{' (not recorded: where the readings before it lead to)' * look.early}, "
        f"{ratio:.2f} of the Rayleigh time (elasticity shortens it, viscosity and gas prolong it)"
    ]
    other = "laser" if chosen == "acoustic" else "acoustic"
    or_other = f"; if it was {other}, give --start {other}" * (chosen == "acoustic" and start is None)
    told += [f"start: {chosen} ({look.reason}){or_other}"] * look.clear
    doubt = f"start: {chosen} is only a proposal ({look.reason}); if it was {other}, give --start {other}"
    warnings = [doubt] * (not look.clear)
    warnings += [
        f"{name}: {view.drift}; no radius at rest is taken from it{COLLAPSE_ALONE * (view.n_minima < 2)}"
        for name, view in looks.items()
        if view.drift and chosen == "laser"  # ultrasound's is seen before it grows
    ]
    for name, view in looks.items():
        for instant, size, which in (
            (view.earlier, "larger than", "larger one"),
            (view.another, "about as large as", "one before"),
        ):
            whose = f"; this is a proposal for the {which}" * (len(views) == 1)  # a window of several is for all
            warnings += [ANOTHER.format(name, 1e6 * instant, size, whose)] * bool(np.isfinite(instant))
    wrong = "make G wrong by half" if "G" in {*others, *guess.values} else "move an estimate by several error bars"
    warnings += [elsewhere.PULSE.format(wrong)] * (chosen == "acoustic")
    doubted, believed = elsewhere.doubted(looks, model), guess
    if doubted:
        warnings += doubted
        possible = all(conceivable(view.lobe, model.medium) for view in views)
        believed = guess.common() if possible else Guess()
    elif words := _implausible(look, model.law.sized):
        warnings.append(words)
    elif guess.misfit > FAR and chosen == "laser":  # no node comes close to what was observed
        warnings.append(_unmatched(guess.unmatched, look, model))
    elif guess.misfit > FAR:
        believed = Guess()  # made with an example of a pulse
    warnings += without_rebound(looks) if chosen == "laser" else elsewhere.clocks_apart(looks)
    if chosen == "laser" and "G" in guess.values:
        warnings += elsewhere.plane_in_a_gel(looks, model.medium)
    elif "G" in guess.values:
        believed = Guess()  # of a gel that a pulse stretches, readings tell G α/R0 alone
    slow = (elsewhere.SLOW_IN_WATER if medium == "water" else elsewhere.SLOW[0]) < ratio < elsewhere.SLOW[1]
    wall = elsewhere.wall(look.lobe.R_max, ratio) if slow and _in_a_liquid(model) else ()
    sizes = {group: len(looks.keys() & {*names}) for group, names in groups.of.items()}
    rest = at_rest(looks, histories, edge, scale.log_std)
    lines = (*_parameters(model, look, believed, tops(looks, histories, scale), medium, scale, rest), *wall[1:])
    free = {line.key for line in lines if line.value.startswith("{")}
    vary = [p.name for p in model.law.parameters if p.name in free] + [R0.name] * (
        R0 in model.parameters and math.isnan(look.before[0])
    )
    together, in_a_gel = None, chosen == "laser" and not _in_a_liquid(model)
    if vary and max(sizes.values(), default=len(views)) >= FEWEST_SETS:
        common = [quantity.key for quantity in elsewhere.known(medium)]
        together = Together(vary, common, _in_a_liquid(model), groups)
    return Proposal(
        _data(look, model, {**others, **guess.values}, views),
        (*_model(law_name, model, look), *wall[:1]),
        lines,
        SIMPLER[chosen],
        (*told, *[f"{len(views)} bubbles: {ends_with(groups.kind, sizes, looks)}"] * bool(together)),
        (*warnings, *unseen),
        together,
        _end(views, 3) if in_a_gel and np.median([v.n_minima for v in views]) > 2 else "",
        tuple(looks),
        (*Proposal.assimilation, *[Entry("what_if", "false", EACH_ALONE)] * bool(together)),
    )


def _unmatched(names: Sequence[str], look: Look, model: BubbleModel) -> str:
    """Which of the observed numbers no gel gives, and what may be wrong then."""
    rest = _text(look.resting[0], "m", "um")
    told = {"t_c": "collapse time", "rebound": f"rebound to {look.rebound:.2f} R_max"}
    asked = {
        "t_c": "are scale and frame rate right?",
        "rebound": f"is {rest} its radius at rest (R_eq), and does its gas lose heat as the model's does (model.gas)?",
    }
    questions = [asked[name] for name in names if name in asked]
    free = " and ".join(p.name for p in model.law.parameters if p.name in WIDTHS)
    return f"no {free} of {model.law.name} will give this {' and '.join(told[n] for n in names)}: {' '.join(questions)}"


def _implausible(look: Look, coated: bool) -> str:
    """Why nobody has seen a bubble of this size and duration, though the one fits the other; "" where many have.
    A ``coated`` one may be small."""
    smallest, shortest, usual = SEEN
    R, step = look.lobe.R_max, look.step
    if BUBBLES[0] < R < BUBBLES[1] and (coated or not (smallest > R and step < shortest)):
        return ""
    power = round(math.log10(usual / R) / 3)
    factor = f"Units {1000 ** abs(power)} times {'larger' if power > 0 else 'smaller'} would make it a usual one"
    told = f"R_max {_text(R, 'm', 'um', 3)}, read every {_text(step, 's', 'us', 3)}"
    seldom = "only ultrasound of small amplitude leaves a bubble" if BUBBLES[0] < R < BUBBLES[1] else "no bubble has"
    return f"{told}: {seldom} such a radius; are the units of both columns right? {factor}"


def starter(start: Start, law: str | None) -> Proposal:
    """A proposal without data: examples to be replaced."""
    model, law_name = built(start, law)
    data = [Entry("error", "{radius_std: 1 % of maximum}", "how well a radius is known: enter yours")]
    if start == "laser":
        words = "if readings show two collapses, 'to: trough 2' ends it at the second"
        data[:0] = [Entry("window", "{from: top, to: end}", words), Entry("time_zero", "top")]
    lines = [example(p, model) for p in model.law.parameters]
    pulse = elsewhere.example_pulse(model.law)
    shift = Entry("t_s", "{prior: normal, mean: 0 us, std: 0.5 us}", "the clock of the data against the model's")
    clocks = [elsewhere.amplitude(pulse), elsewhere.clock(pulse)] if start == "acoustic" else [shift]
    lines += [*_radii(start, None), *clocks]
    return Proposal(tuple(data), _model(law_name, model, None), tuple(lines), SIMPLER[start])


def with_columns(proposal: Proposal, errors: Sequence[str], common: str) -> Proposal:
    """The proposal with the errors that the data file states: columns of the std of radii and of times, and the
    ``common`` std of what moves all radii alike, "" where the file states none."""
    own = {
        "radius_std": Entry("  radius_std", f"{{column: {errors[0]}}}", "of each reading"),
        "time_std": Entry("  time_std", f"{{column: {errors[1]}}}", "of the exposure"),
    }
    data = tuple(own.get(entry.key.removeprefix("  # ").strip(), entry) for entry in proposal.data)
    alike = Entry(
        "reading_offset", f"{{prior: normal, mean: 0 um, std: {common}}}", "the level of the edge, the same for all"
    )
    return replace(proposal, data=data, parameters=(*proposal.parameters, *[alike] * bool(common)))


def built(start: Start, law: str | None, look: Look | None = None) -> tuple[BubbleModel, str]:
    """The model, and how the file names its law. Raises :class:`ConfigError` where no such law starts so."""
    name = qualified(law) if law else LAWS[start]
    said: dict[str, object] = {**physics(start, look), "start": start, "law": name}
    with retold(ValueError, ConfigError, f"--law {name} --start {start}: "):
        model = BubbleModel.from_settings(BubbleSettings.model_validate(said))
        if start == "acoustic":
            said |= {"driving": elsewhere.example_pulse(model.law)}
            model = BubbleModel.from_settings(BubbleSettings.model_validate(said))
    return model, name


def _looks(histories: Mapping[str, tuple[Array, Array]], start: Start | None) -> tuple[dict[str, Look], list[str]]:
    """What each history shows, and why others show no bubble. Raises :class:`DataError` where none shows one."""
    looks, unseen = usable(histories, lambda name: look(*histories[name], start))
    clear = [view.start for view in looks.values() if view.clear]
    others = [name for name, view in looks.items() if view.start not in clear]
    if others and len({*clear}) == 1 and 2 * len(clear) > len(looks):  # bubbles of a folder are made in one way
        words = f"so begin {len(clear)} of {len(looks)} histories; {listed(others, 5)} in the growth"
        looks, unseen = usable(histories, lambda name: look(*histories[name], clear[0]))
        looks = {name: replace(view, reason=words, clear=False) for name, view in looks.items()}
    if len({view.start for view in looks.values()}) > 1:
        kinds = {kind: [n for n, view in looks.items() if view.start == kind] for kind in ("acoustic", "laser")}
        told = "; ".join(f"{kind}: {', '.join(names[:3])}" for kind, names in kinds.items())
        raise DataError(f"the data sets suggest different starts ({told}); give --start acoustic or --start laser")
    return looks, unseen


def _others(model: BubbleModel, look: Look) -> dict[str, float]:
    """Every parameter but G and μ at the centre of its proposed prior, SI."""
    example = {name: float(v[0]) for name, v in model.law.example_values().items() if name not in WIDTHS}
    example |= {name: STIFFENING[0] for name in example if name == "alpha"}
    if model.start == "acoustic":
        return {**example, "R0": look.before[0] if np.isfinite(look.before[0]) else NUCLEUS[0]}
    return {**example, "R_eq": look.resting[0], "R_max": look.lobe.R_max}


def _data(look: Look, model: BubbleModel, theta: Mapping[str, float], views: Sequence[Look]) -> tuple[Entry, ...]:
    """Window, clock and errors."""
    if model.start == "laser":
        lines = [
            _window(look, views),
            Entry("time_zero", "top", "the model's clock starts at the top, shifted by t_s"),
        ]
    else:
        level = f"{100 * COLLAPSED:g} % of maximum"
        end, words = "end", f"all readings: none after the maximum is below {level.replace('maximum', 'it')}"
        if any(view.falls for view in views):
            end = level + " or end" * (not all(view.falls for view in views))
            words = "growth and collapse down to this share; then the wall is too fast for the model"
        lines = [Entry("window", f"{{from: start, to: {end}}}", words), _clock(look, model, theta)]
    std, words = "1 % of maximum", "too few readings to show their scatter: enter what you know of your camera"
    if np.isfinite(look.noise):
        std = _text(max(look.noise, LEAST_NOISE * look.lobe.R_max), "m", "um")
        words = "scatter of the readings where R is smooth; sigma below scales it"
    alike = max(view.step for view in views) < SAME_STEP * min(view.step for view in views)  # else each has its own
    timing = _text(TIMING * look.step, "s", "us") if alike else f"{100 * TIMING:g} % of step"
    key = "  time_std" if model.start == "laser" else "  # time_std"  # a flash is short
    return (
        *lines,
        Entry("error", "", "how well a reading is known"),
        Entry("  radius_std", std, words),
        Entry(key, timing, "5 % of the step between frames: exposure and jitter matter where R is steep"),
        Entry("  discrepancy", DISCREPANCY, "what the model misses; its size and correlation time are estimated"),
    )


def _window(look: Look, views: Sequence[Look]) -> Entry:
    """From the top to the second minimum, or to the end of histories that have none."""
    low = f", prominence: {100 * look.prominence:g} %" if look.prominence < 0.1 else ""
    words, until = "what happens before the top is not modelled", ""
    if look.drift and len(views) == 1:
        words, until = f"{words}; {look.drift}: no bubble after its last minimum", f", until: trough {look.n_minima}"
    end, last = _end(views), np.fmin.reduce([view.another for view in views])
    if last > max(view.lobe.t_max + 2 * view.lobe.t_c for view in views):  # else clocks differ
        text = f"{1e6 * last:.9g} us"
        end, until = text if end == "end" else end, until or f", until: {text}"
    return Entry("window", f"{{from: top, to: {end}{until}{low}}}", words)


def _end(views: Sequence[Look], number: int = 2) -> str:
    """The minimum of this ``number``, and what ends histories that have fewer: one that has come to rest is not short
    of minima, and all of it counts; one that drifts where it should rest is a bubble up to its last minimum.
    """
    fewest, most = (min(number, extreme(view.n_minima for view in views)) for extreme in (min, max))
    instants = [f"trough {n}" for n in range(most, max(fewest, 2) - 1, -1)]
    if drifts := any(view.drift and view.n_minima == 1 for view in views):
        instants.append("trough 1")
    return " or ".join([*instants, *["end"] * (fewest < (1 if drifts else 2))])


class Tops(NamedTuple):
    """Priors of where and how high the tops of histories are: mean and std (s) of the clock that starts where each
    history's own readings put its top (``time_zero: top``), mean (as text) and relative std of the height.
    """

    t_s: tuple[float, float]
    R_max: tuple[str, float]


def tops(looks: Mapping[str, Look], histories: Mapping[str, tuple[Array, Array]], scale: elsewhere.Known) -> Tops:
    """Of the clock, beside each history's own top; of the heights of several, what covers all largest readings."""
    rows = []
    for name, view in looks.items():
        times, radius = histories[name]
        zero = vertex(times, radius)
        largest = float(radius[times >= zero].max())
        of_time = zero - view.top.time, TOP_WIDTH * view.top.time_std, LEAST_SHIFT * view.step
        rows.append((*of_time, view.top.height / largest - 1, TOP_WIDTH * view.top.height_std / largest))
    several, (shift, *_) = len(looks) > 1, np.mean(rows, axis=0)
    _, late, least, high, size = np.sqrt(np.mean(np.square(rows), axis=0))
    height = "maximum" if several else _text(view.top.height, "m", "um", 5)
    return Tops(
        (float(shift), math.hypot(np.std(rows, axis=0)[0], late, least)),
        (height, math.hypot(high * several, size, scale.log_std)),
    )


def _clock(look: Look, model: BubbleModel, theta: Mapping[str, float]) -> Entry:
    """Where the file's zero lies on the driving's clock: the maximum of the first guess is put on that of the data."""
    peak = getattr(model.driving, "end", 0.0)
    times = np.linspace(0.0, peak + 5 * look.lobe.t_c, 400)
    shift = 0.0
    if all(p.name in theta for p in model.parameters):
        (path,) = model.trajectories(model.initial_states({n: np.array([v]) for n, v in theta.items()}), times)
        if isinstance(path, Trajectory):
            with suppress(DataError):
                shift = look.lobe.t_max - lobe(times, path["R"]).t_max
    if abs(shift) <= SAME_CLOCK and look.begin >= 0:
        return Entry("time_zero", "file", "the file's clock agrees with that of the pulse")
    text = f"{math.floor(1e7 * min(shift, look.begin)) / 10:.9g} us"  # no reading lies before the pulse
    return Entry("time_zero", text, "puts the R_max of the guess on that of the data: enter the clock of your pulse")


def _of_each(radius: float, look: Look, top: Tops) -> str:
    """A radius of the ``look``, where it is one at several bubbles as a share of the largest reading of each."""
    share = f"{100 * radius / look.lobe.R_max:.2g} % of maximum"
    return share if top.R_max[0] == "maximum" else _text(radius, "m", "um")


def _in_a_liquid(model: BubbleModel) -> bool:
    """True of a laser's bubble that no elasticity holds together."""
    return model.start == "laser" and "G" not in {p.name for p in model.law.parameters}


def _model(law: str, model: BubbleModel, look: Look | None) -> tuple[Entry, ...]:
    start = model.start
    lines = [
        Entry("name", "bubble"),
        Entry("law", law, "others: en4dvar laws"),
        Entry("start", start, look.reason if look else "or " + ("laser" if start == "acoustic" else "acoustic")),
        *(Entry(key, value, WHY[value]) for key, value in physics(start, look).items()),
        *[Entry("rtol", "1e-8", WHY["rtol"])] * isinstance(model.law, MarmottantShell),
        *[Entry("viscosity_change", "1", WHY["viscosity_change"])] * _in_a_liquid(model),
    ]
    if start == "acoustic":
        pulse = ", ".join(f"{key}: {value}" for key, value in elsewhere.example_pulse(model.law).items())
        lines.append(Entry("driving", f"{{{pulse}}}", "an example: enter the pulse of your experiment"))
    return tuple(lines)


def _parameters(
    model: BubbleModel,
    look: Look,
    guess: Guess,
    top: Tops,
    medium: str,
    scale: elsewhere.Known,
    rest: tuple[str, float] | None,
) -> tuple[Entry, ...]:
    start, lines = model.start, [example(p, model) for p in model.law.parameters]
    for i, p in enumerate(model.law.parameters):
        if p.name in guess.values:
            width = float(np.clip(guess.log_std[p.name], *WIDTHS[p.name]))
            lines[i] = _spread(p, guess.values[p.name], width, f"{guess.source},", "knew before")
    lines += _radii(start, look, top, rest)
    if medium == "water":
        water = elsewhere.of_water(_of_each(0.05 * look.lobe.R_max, look, top)) if _in_a_liquid(model) else {}
        water |= {"mu": elsewhere.MU_OF_WATER} if model.law.sized else {}
        seen = {R_EQ.name} if np.isfinite(look.rest) else set()
        lines = [line if line.key in seen else water.get(line.key, line) for line in lines]
    pulse = elsewhere.example_pulse(model.law)
    lines += [elsewhere.amplitude(pulse)] * (start == "acoustic")
    mean, std = (_text(value, "s", "us", digits) for value, digits in zip(top.t_s, (4, 2), strict=True))
    words = "the vertex of a parabola through the readings about the top, relative to the top itself"
    at_top = Entry("t_s", f"{{prior: normal, mean: {mean}, std: {std}}}", words)
    sigma = f"{{prior: lognormal, median: 1, log_std: {NOISE_LOG_STD:g}}}"
    return (
        *lines,
        elsewhere.clock(pulse) if start == "acoustic" else at_top,
        Entry("sigma", sigma, "scale of the stated errors"),
        *(it.prior() for it in elsewhere.known(medium, scale)),
    )


def example(p: Parameter, model: BubbleModel) -> Entry:
    """A prior about the law's example value; of α, a gel's G and μ, and what relaxes, one that spans what is known."""
    if p.name in elsewhere.COATING:
        return elsewhere.COATING[p.name]
    gels = {"alpha": STIFFENING, **RELAXING}
    if any(other.name == "G" for other in model.law.parameters):
        gels |= OF_GELS
    if p.name in gels:
        return _spread(p, *gels[p.name], f"{SPAN.get(p.name, 'of gels')};", "know of your gel")
    text = _text(float(model.law.example_values()[p.name][0]), p.unit, p.display_unit)
    words = "an example value, not from the data"
    if p.transform == "lognormal":
        return _lognormal(p, text, "0.5", words)
    words = f"{p.label}: {words}"
    if p.transform == "logit" and np.all(np.isfinite(p.bounds)):
        low, high = (_text(b, p.unit, p.display_unit) for b in p.bounds)
        return Entry(p.name, f"{{prior: logit, lower: {low}, upper: {high}, median: {text}, logit_std: 0.5}}", words)
    return Entry(p.name, f"{{prior: normal, mean: {text}, std: 20 %}}", words)


def _spread(p: Parameter, median: float, log_std: float, source: str, known: str) -> Entry:
    """A wide prior, and how far its median may be off."""
    width = f"{log_std:.2g}"
    words = f"{source} may be off by a factor of {math.exp(BETWEEN * float(width)):.2g}; narrow it to what you {known}"
    return _lognormal(p, _text(median, p.unit, p.display_unit), width, words)


def _lognormal(p: Parameter, median: str, log_std: str, words: str) -> Entry:
    return Entry(p.name, f"{{prior: lognormal, median: {median}, log_std: {log_std}}}", f"{p.label}: {words}")


def _radii(
    start: Start, look: Look | None, top: Tops | None = None, rest: tuple[str, float] | None = None
) -> list[Entry]:
    if start == "acoustic":
        line = _spread(R0, *NUCLEUS, "of agarose, 0.3 and 1 % (Mancia 2021);", "know of your gel")
        if rest is not None:
            words = f"the readings before it grows; {TOP_WIDTH:g} times their errors wide, for they are in the fit"
            line = _lognormal(R0, rest[0], f"{rest[1]:.2g}", words)
        return [line]
    value, width, words = "20 um", 0.4, R_EQ.label
    if look is not None and top is not None:
        radius, width, words = look.resting
        value = _of_each(radius, look, top)
    mean, std = top.R_max if top else ("maximum", 0.03)
    prior, source = f"{{prior: normal, mean: {mean}, std: {100 * std:.2g} %}}", "the errors of readings and scale"
    return [
        Entry(R_EQ.name, f"{{prior: lognormal, median: {value}, log_std: {width}}}", words),
        Entry(R_MAX.name, prior, f"the top of the history, with {source}"),
    ]


def _text(value: float, unit: str, display: str, digits: int = 2) -> str:
    """A quantity to some digits in a readable unit, e.g. ``0.27 kPa``."""
    number = f"{float(f'{convert(value, unit, display):.{digits}g}'):g}"
    return f"{number}{unit_after(display)}"
