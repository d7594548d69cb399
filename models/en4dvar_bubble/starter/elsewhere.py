"""What an experiment knows from elsewhere than from its radii, and how well: density, speed of sound, pressure, scale.

The collapse time fixes R_max √(ρ/(p_∞ + ~G)), so that an error of one per cent of scale or of density is one of G of a
per cent or half a per cent of the ambient pressure: 1 or 0.5 kPa, for every bubble alike. What is not known exactly is
estimated with a prior that says how well it is known; the data hardly change it, and its uncertainty is in every
interval.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.model.state import READING_SCALE
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.hints import listed, shown, suggest
from en4dvar.plumbing.units import UnitError, parse_quantity
from en4dvar_bubble.collapse import FAR, doubt, explained
from en4dvar_bubble.laws.base import ConstitutiveLaw
from en4dvar_bubble.medium import MEDIA, Medium, known_medium
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.numbers import P_A, WALL_DISTANCE
from en4dvar_bubble.starter.guess import OF_GELS
from en4dvar_bubble.starter.look import Look

ANY = "gel"
CHOICES = (ANY, *MEDIA)
"""Media that may be named; the first stands for any gel or solution that is mostly water."""

SLOW = 1.08, 1.3
"""Of the Rayleigh time: a collapse in a liquid that takes longer may have a wall nearby, and where it takes longer than
the second, the liquid is viscous: a wall at 1.1 R_max makes it 1.19."""

SLOW_IN_WATER = 1.05
"""The first of them where the viscosity is known: without a wall it is 1.042 − 1.25 S/(R_max p_∞) + 1.6/Re by forward
runs (50 to 1200 µm, R_eq up to 0.2 R_max). The rest is for scale, pressure and top; a wall at 5.7 R_max adds 0.036."""

WALLS = 8.0, 200.0
"""Median of a wall's distance, in R_max, and the largest, where a collapse takes 0.1 % longer."""

BY_VISCOSITY = 1.6
"""Over Re = R_max √(ρ p_∞)/μ: by what part of the Rayleigh time a collapse in a gel of 5 kPa takes longer, for gas and
elasticity cancel there (R_eq of 0.1 to 0.2 R_max; tests/bubble/test_wall.py holds it to forward runs)."""


@dataclass(frozen=True)
class Entry:
    """One line of a section: key, value as YAML, and a comment."""

    key: str
    value: str
    comment: str = ""


@dataclass(frozen=True)
class Known:
    """A quantity as it stands in a configuration: its key, median with unit, std of its logarithm, the source, and what
    says that data sets do not have one value of it, "" where they do."""

    key: str
    median: str
    log_std: float
    source: str
    shared: str = ""

    def prior(self, more: str = "") -> Entry:
        """Its line of the parameters; ``more`` is what else stands in it, where data sets have one value."""
        value = f"{{prior: lognormal, median: {self.median}, log_std: {self.log_std:g}{self.shared or more}}}"
        return Entry(self.key, value, self.source)


SCALE = Known(READING_SCALE.name, "1", 0.005, "size of a pixel: known to about 0.5 % from a calibration target")
PRESSURE = Known("p_inf", "101.3 kPa", 0.01, "weather changes it by 1 %, 100 m of altitude by 1.2 %: enter yours")
HISTOTRIPSY = {"kind": "histotripsy", "amplitude": "-24 MPa", "frequency": "1 MHz", "exponent": "3.7", "delay": "5 us"}
DIAGNOSTIC = {"kind": "sine", "amplitude": "100 kPa", "frequency": "2 MHz", "cycles": "8", "envelope": "hann"}

CLOCK_STD, CLOCK_SHARE = 1e-6, 0.1  # s, of 30 synthetic bubbles a guessed clock erred by 1.05e-6 (rms); of a period
CLOCKS_APART = 4e-6  # s: bubbles of one gel that differ in size grow this much apart


def example_pulse(law: ConstitutiveLaw) -> Mapping[str, str]:
    """Keys of a pulse and their values, as made such a bubble in published experiments: a coated one is driven by a
    burst as of a scanner, one in a gel grows in the tension of a histotripsy pulse.
    """
    return DIAGNOSTIC if law.sized else HISTOTRIPSY


def clock(pulse: Mapping[str, str]) -> Entry:
    """The line of the time shift. In a burst of several cycles a shift by a period changes little, and each would be a
    mode; half a cycle makes one bubble.
    """
    words, std = "the clock of the data against that of the pulse", CLOCK_STD
    if "cycles" in pulse:
        std = CLOCK_SHARE / parse_quantity(pulse["frequency"], "Hz", "MHz")
        words += (
            f": a camera that the pulse triggers is known to {100 * CLOCK_SHARE:g} % of its period, or to what you "
        )
        words += "enter; with half a period or more it may fit in several modes"
    return Entry("t_s", f"{{prior: normal, mean: 0 us, std: {1e6 * std:.3g} us}}", words)


def clocks_apart(looks: Mapping[str, Look]) -> list[str]:
    """Whose pulse comes at another instant of its clock than those of most. A bubble grows for about as long as it
    collapses.
    """
    grows = {name: view.lobe.t_max - view.lobe.t_c for name, view in looks.items()}
    usual, t_c = np.median([*grows.values()]), np.median([view.lobe.t_c for view in looks.values()])
    off = {name: abs(at - usual) for name, at in grows.items() if abs(at - usual) > max(CLOCKS_APART, 0.5 * t_c)}
    words = (
        f"{listed(off, 5)}: the bubble grows up to {1e6 * max(off.values(), default=0.0):.3g} us before or after most, "
        "and one time_zero is for all files: begin the times of each at its pulse, or write the instant of the pulse "
        "into each file as a line '# delay_us = 7.0', and propose again"
    )
    return [words] * bool(off)


def amplitude(pulse: Mapping[str, str]) -> Entry:
    """A line of the parameters, which is a comment until it holds the amplitude of the pulse that the model states."""
    words = (
        "amplitude of the driving, one for all bubbles (else add 'shared: none'): enter that of your pulse, with the "
        "error of your hydrophone, often 5 or 10 %"
    )
    return Entry(f"# {P_A.name}", f"{{prior: normal, mean: {pulse['amplitude']}, std: 5 %}}", words)


PULSE = (
    "the pulse is an example: enter that of your experiment in the line 'driving' of the model; the amplitude of the "
    "pulse is taken as exact, and an error of 10 % can {}; enter the error "
    f"of your hydrophone in the line '# {P_A.name}' of the parameters, and remove the '# ' from it"
)
COATING = {
    "sigma_0": Entry(
        "sigma_0",
        "{prior: logit, lower: 0 mN/m, upper: 72 mN/m, median: 20 mN/m, logit_std: 1}",
        "tension of the coating at rest: an example value, below that of water",
    ),
    "sigma_w": Entry("sigma_w", "72 mN/m", "tension of the broken coating: that of water"),
}
MU_OF_WATER = Entry("mu", "0.89 mPa s", "viscosity of water at 25 °C (IAPWS 2008); what else damps is the coating")
_OF_ANY = (
    Known("rho", "1030 kg/m^3", 0.02, "density: 90 % from water, 997, to the gels of rheometry codes, 1064"),
    Known("c", "1510 m/s", 0.015, "speed of sound: between water, 1497 m/s, and gels with 15 % of polymer, 1540 m/s"),
)


def known(medium: str, scale: Known = SCALE) -> Sequence[Known]:
    """What is known of an experiment in one of the :data:`CHOICES`, which a concentration may follow: ``agarose 1 %``.
    Raises :class:`ConfigError`: another medium, or a concentration (mass over that of the whole) not within 0 to 50 %.
    """
    name, _, text = medium.strip().partition(" ")
    if name not in CHOICES:
        raise ConfigError(f"unknown medium {shown(name)}{suggest(name, CHOICES)}")
    of_medium, concentration = _OF_ANY, None
    if text:
        with retold(UnitError, ConfigError, f"medium {shown(medium)}: "):
            concentration = parse_quantity(text, "1")
        if name in (ANY, "water") or not 0 < concentration <= 0.5:
            raise ConfigError(
                f"medium {shown(medium)}: a concentration is of a polymer, up to 50 %: polyacrylamide 8 %"
            )
    if name != ANY:
        it = known_medium(name, concentration)
        of_medium = (
            Known("rho", f"{it.rho:.4g} kg/m^3", float(f"{it.rho_log_std:.2g}"), f"density of {it.source}"),
            Known("c", f"{it.c:.4g} m/s", float(f"{it.c_log_std:.2g}"), f"speed of sound in {name}"),
        )
    return (*of_medium, PRESSURE, scale)


def scale_of(factor: float) -> Known:
    """That of a camera, and of a shape that lasts, which gives all radii of a bubble a factor of this std."""
    source = f"{SCALE.source}; a shape that lasts hides {100 * factor:.2g} % along the line of sight"
    wide = float(f"{math.hypot(SCALE.log_std, factor):.2g}")
    own = ", shared: none" * (factor > SCALE.log_std)  # the larger part is each bubble's own
    return replace(SCALE, log_std=wide, source=source, shared=own) if wide > SCALE.log_std else SCALE


def centred(model: BubbleModel, medium: str) -> BubbleModel:
    """The model with the medians of what is known: 1 % of density is half a kPa of a gel's modulus."""
    medians = {quantity.key: quantity.median for quantity in known(medium)}
    rho, c = parse_quantity(medians["rho"], "kg/m^3"), parse_quantity(medians["c"], "m/s")
    return replace(model, medium=replace(model.medium, rho=rho, c=c, p_inf=parse_quantity(medians["p_inf"], "Pa")))


def of_water(rest: str) -> dict[str, Entry]:
    """Priors of the viscosity and of R_eq, its median as text, by key. What damps a collapse in water is sound, heat
    and vapour, so that a guess from collapse and rebound books them as viscosity.
    """
    off = math.exp(1.645 * 1.5)
    words = f"viscosity: water has 0.0009; as a check, may be off by a factor of {off:.2g}; narrow it to what you know"
    of_rest = "0.05 R_max, the little gas that water leaves; may be off by a factor of 5.2; narrow it to what you know"
    mu = Entry("mu", "{prior: lognormal, median: 0.002 Pa s, log_std: 1.5}", words)
    return {"mu": mu, "R_eq": Entry("R_eq", f"{{prior: lognormal, median: {rest}, log_std: 1}}", of_rest)}


def wall(radius: float, slowness: float) -> tuple[Entry, Entry]:
    """A plane beside a bubble of ``radius`` (m) whose collapse takes ``slowness`` times Rayleigh's, for the model, and
    the prior of its distance. Such a liquid may be viscous instead, and the plane, which makes it 1 + 0.205 R_max/h
    (Rattray 1951), as far as a cuvette is wide: the prior is nearly flat in ln h, from where the bubble touches the
    plane to where nothing is seen of it.
    """
    nearest, median, farthest = (1e6 * radius * of_it for of_it in (1.1, *WALLS))
    distance = f"{float(f'{median:.2g}'):g} um"
    prior = f"{{prior: logit, lower: {nearest:.4g} um, upper: {farthest:.4g} um, median: {distance}, logit_std: 2}}"
    source = f"the collapse takes {slowness:.2f} of the Rayleigh time, as beside a plane or in a viscous liquid"
    return Entry("wall", f"{{distance: {distance}}}", source), Entry(WALL_DISTANCE.name, prior, "of that plane")


def plane_in_a_gel(views: Mapping[str, Look], medium: Medium) -> list[str]:
    """What a plane would do to G of the bubbles whose collapse takes longer than in a gel as :data:`OF_GELS` are, by
    more than the instant of the top, where it begins, is uncertain; one line or none. A softer or thicker gel does so,
    too; 1 % of the collapse time is worth 1 kPa. Where most bubbles do not, a scale of these few may be wrong instead.
    """
    G, mu = (OF_GELS[name][0] for name in ("G", "mu"))
    slow, others = {}, []
    for name, view in views.items():
        lobe, unsure = view.lobe, view.top.time_std / view.lobe.t_c
        usual = 1 + BY_VISCOSITY * mu / (lobe.R_max * math.sqrt(medium.rho * medium.p_inf))
        if doubt(lobe, medium):
            continue
        if (ratio := lobe.rayleigh_ratio(medium)) > usual + unsure:
            slow[name] = ratio, usual, 1e6 * lobe.R_max
        else:
            others.append(ratio / usual)  # small bubbles take longer than large ones
    if not slow:
        return []
    ratio, usual, radius = np.median([*slow.values()], axis=0)
    names = f"{listed(slow, 3)}: " * (len(views) > 1)
    rest, few = float(np.median(others or [1.0])), len(views) > 2 * len(slow)
    told = len(others) > len(slow) and (factor := rest * float(usual / ratio)) < 0.99
    scale = f", and {len(others)} others {rest:.2f} of what they would there: {explained(factor)}?" if told else "."
    alone = ", for these files alone, in a folder of their own" * few
    near = " and ".join(f"{20.5 / h:.0f} kPa at {h} R_max" for h in (3, 10))
    return [
        f"{names}the collapse takes {ratio:.2f} of the Rayleigh time; in a gel of {G / 1e3:g} kPa and {mu:g} Pa s it "
        f"takes {usual:.2f}{scale} The gel may be softer or thicker, or a rigid plane may be nearby (wall of the "
        f"vessel, cover glass). A plane makes G too small by about {near} and leaves no other trace (a free surface of "
        f"the gel makes it too large). If one is within 10 R_max, state its distance from the bubble's centre{alone}: "
        f"--set model.wall.distance='{float(f'{3 * radius:.2g}'):g} um'"
    ]


def doubted(looks: Mapping[str, Look], model: BubbleModel) -> list[str]:
    """Data sets whose scales cannot be right, one line for those with the same words."""
    doubts: dict[str, list[str]] = {}
    for name, view in looks.items():
        holds_gas = np.isfinite(view.before[0])  # and is no Rayleigh's empty bubble
        ratio = view.lobe.rayleigh_ratio(model.medium)
        bounded = (not holds_gas and ratio > 1) or ratio < 1 / FAR  # a gel stretched far stiffens
        if (model.start == "laser" or bounded) and (words := doubt(view.lobe, model.medium)):
            doubts.setdefault(words, []).append(name)
    return [words if len(looks) == 1 else f"{', '.join(names)}: {words}" for words, names in doubts.items()]
