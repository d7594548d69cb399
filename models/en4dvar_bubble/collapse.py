"""The collapse of a bubble beside Rayleigh's, and whether the scales of a radius history can be what they say.

The collapse time is that of Rayleigh's solution in the closed form of Obreschkow, Bruderer & Farhat (2012), Phys. Rev.
E 85, 066303, for an empty bubble in a liquid:

    R(t) = R_max [1 − ((t − t_max)/t_c)²]^{2/5},        t_c = 0.9147 R_max √(ρ/p_∞),

so that R^{5/2} is a parabola in t: three numbers by linear least squares from the samples between the maximum and 40 %
of it, less far down where a thick gel lets it creep, whether the collapse itself was seen or fell between two frames
(2 % late, as Rayleigh's exact solution tells). Where the lowest reading lies above 40 %, it may be the first of the
rebound: it is left out where it is later than the collapse that those before it tell.

In a gel the ratio r = t_c/(0.9147 R_max √(ρ/p_∞)) differs from one: elasticity and surface tension shorten the
collapse, viscosity, gas and vapour prolong it. The energy of an incompressible liquid bounds it from below: a
neo-Hookean spring adds G/2 (5 − 4/λ − 1/λ⁴) < 5/2 G to the pressure, surface tension over the whole collapse at most
3 S/R_max, and what adds at most q to p_∞ cannot shorten the collapse by more than √(1 + q/p_∞):

    r > [1 + (5/2 G + 3 S/R_max)/p_∞]^{−1/2}.

From above it is bounded by r < 1.1 + 2.2/(Re − 3), Re = R_max √(ρ p_∞)/μ (none below Re = 3), an envelope of forward
runs (20 to 500 µm, R_max/R_eq of 5 to 12, G from 0.1 to 42 kPa; tests/bubble/test_collapse.py holds it to them).

How stiff or thick a gel can be no formula says. :data:`COMMON` is what is taken for granted, well above what has been
published of gels that bubbles were used on; beyond it a history is doubted and its estimate printed, beyond
:data:`EXTREME` it cannot be right. A prior that expects more is believed; so are prior members within ``COMMON`` that
come as far, for a law that stiffens, or a pulse, does what no neo-Hookean spring can.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from en4dvar.data.extrema import maxima
from en4dvar.model.state import Array, Mask
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import DataError
from en4dvar_bubble.medium import Medium

RAYLEIGH = 0.914681  # of the empty bubble: Rayleigh (1917)
LOWEST = (0.4, 0.6, 0.75)  # of R_max: R^{5/2} is fitted to what lies above, to less where a thick gel lets it creep
KNOWN = "write a configuration whose priors say what is known of it (en4dvar init --start laser, without --data)"
WILD = "delete the line of that reading if it is wild"
BEFORE = 1.0  # of the time that is fitted to: a parabola whose top lies further before the first sample shows none
TOLD = 0.6  # of R_max: a window that ends above does not tell the collapse time
SOFT = 1.02  # r of a large bubble in a soft gel, whose gas and viscosity prolong its collapse a little
APART = 1.05  # noise and physics that the model lacks move r by less than this
TAILS = 0.5  # of the range of the members' ln r: 48 of a Gaussian reach 2.2 standard deviations, with tails twice that
SURE = 0.99  # one-sided probability, by the scatter of the samples
REBOUND = 0.5  # of the collapse time: a rebound that has no top by then is not seen, or there is none
SLIGHT = 0.03  # of the range of the radii: by so much the top of a slight rebound stands out
FAR = 30.0  # a ratio beyond this factor is that of a wrong unit, whatever drives or damps a bubble
SAME_FACTOR = 1.12  # a factor that is this close to that of a known mistake may be it


class Gel(NamedTuple):
    """Modulus (Pa) and viscosity (Pa s)."""

    G: float
    mu: float


COMMON = Gel(20e3, 0.3)  # published: 7.7 kPa (Estrada et al. 2018), stiff polyacrylamide; 0.19 Pa s (Yang et al. 2020)
EXTREME = Gel(100e3, 1.0)  # no bubble was used on more
SINGLE = (
    "the window ends before the top of the first rebound, so every other loss of energy in that collapse "
    "(sound, fragments, jets, a shape that is no sphere) counts as viscosity and stiffness: measured bubbles gave 2 "
    "to 28 times the viscosity, and up to 4 times the modulus, of a window with the rebound",
    "let the window (data.window) include the rebound until its top is past; if the recording ends before, film "
    "longer; otherwise do not quote these values, not even as limits",
)  # words and advice of a warning


@dataclass(frozen=True)
class Lobe:
    """The bubble's largest excursion; SI. ``t_c`` is from the maximum to the collapse.

    ``margin``: t_c/R_max lies within this factor less one, by the scatter of the samples about the parabola (99 % to
    either side).
    """

    R_max: float
    t_max: float
    t_c: float
    margin: float = 0.0

    def rayleigh_ratio(self, medium: Medium) -> float:
        return self.t_c / (RAYLEIGH * self.R_max * math.sqrt(medium.rho / medium.p_inf))


def lobe(times: Array, radius: Array) -> Lobe:
    """Maximum and collapse time, see the head of the module. Raises :class:`DataError`."""
    turning = None
    for lowest in LOWEST:
        where = _falling(radius, lowest)
        count = where.stop - where.start
        if count < 4:
            break
        view, near = _fitted(times, radius, where)
        if count > 4 and not np.any(radius[where.stop : where.stop + 1] <= lowest * radius.max()):
            before, turns = _fitted(times, radius, slice(where.start, where.stop - 1))
            if before is not None and times[where.stop - 1] > before.t_max + before.t_c:
                view, near = before, turns  # the lowest reading is one of the rebound
        turning = view if near else turning or view
        if near:
            break
    if turning is None:
        largest = int(np.argmax(radius))
        top = f"its maximum at {1e6 * times[largest]:.6g} us, reading {largest + 1} of {len(radius)}"
        if where.stop - where.start < 4 and lowest == LOWEST[0]:
            words = f"fewer than four samples from {top}, down to its collapse; is this a radius history?"
            raise DataError(f"{words} Where it is, {WILD}, or {KNOWN}")
        raise DataError(
            f"the radius does not turn at {top}, but creeps from there as in a thick gel, where G, mu and the time of "
            f"the true maximum make up for each other; {WILD}, give the readings before it as well, or, where there "
            f"are none, {KNOWN}"
        )
    return turning


def _fitted(times: Array, radius: Array, where: slice) -> tuple[Lobe | None, bool]:
    """What the parabola through the readings ``where`` tells, None without a maximum; whether that is near them."""
    begun, r = times[int(np.argmax(radius))], radius[where]
    scale = max(float(np.ptp(times[where])), 1e-300)
    z, y = (times[where] - begun) / scale, np.clip(r / radius.max(), 1e-3, None)
    # an error of R is one of 5/2 R^{3/2} in R^{5/2}
    (c, b, a), covariance = np.polyfit(z, y**2.5, 2, w=y**-1.5, cov=True)
    if not c < 0:
        return None, False
    middle, peak = -b / (2 * c), a - b**2 / (4 * c)
    slope = np.array([middle**2, middle, 1.0]) * 0.1 / peak  # of ln t_c/R_max = ln √(−peak/c)/peak^{2/5}
    slope[0] -= 0.5 / c
    margin = float(stdtrit(len(z) - 3, SURE) * np.sqrt(slope @ covariance @ slope))
    times_of = float(begun + scale * middle), float(scale * np.sqrt(-peak / c))
    return Lobe(float(radius.max() * peak**0.4), *times_of, margin), middle > z[0] - BEFORE


def _falling(radius: Array, lowest: float) -> slice:
    """From just before the maximum down to ``lowest`` of it, or to the lowest reading before the radius rises."""
    top = int(np.argmax(radius))
    largest, after = radius[top], radius[top + 1 :]
    rising = np.flatnonzero(radius[:top] <= 0.95 * largest)
    following = np.minimum(after, np.append(after[1:], np.inf))  # one reading alone may be high
    least = np.minimum.accumulate(radius[top:-1])
    least = np.where(least < LOWEST[-1] * largest, least, radius[top:-1])  # where it is flat only noise adds up
    below, rises = after <= lowest * largest, following > least + 0.1 * largest
    ends = np.flatnonzero(below | rises)
    first, last = (rising[-1] + 1 if len(rising) else 0), top + (ends[0] if len(ends) else len(after))
    if len(ends) and not below[ends[0]]:
        last = top + int(np.argmin(radius[top : last + 1]))
    return slice(int(first), int(last) + 1)


def bounds(R_max: float, medium: Medium, gel: Gel = COMMON) -> tuple[float, float]:
    """Least and largest ratio of collapse time and Rayleigh time up to this ``gel``; ``R_max`` in m."""
    least = (1 + (2.5 * gel.G + 3 * medium.S / R_max) / medium.p_inf) ** -0.5
    reynolds = R_max * math.sqrt(medium.rho * medium.p_inf) / gel.mu
    return least, 1.1 + 2.2 / (reynolds - 3) if reynolds > 3 else math.inf


@dataclass(frozen=True)
class Expected:
    """Ratios (M,) of the prior members, and whether each is a ``common`` gel, no stiffer or thicker than granted."""

    ratios: Array
    common: Mask

    def like(self, ratio: float, short: bool) -> bool:
        """True if a common gel comes as far to that side."""
        r = self.ratios[self.common]
        return bool(np.any(r <= ratio) if short else np.any(r >= ratio))

    def reaches(self, ratio: float, apart: float) -> bool:
        """True if the prior, members and the tails beyond them, brings a ratio about up to the factor ``apart``."""
        low, high = np.log([self.ratios.min(), self.ratios.max()])
        more = TAILS * (high - low)
        return math.exp(low - more) / apart <= ratio <= math.exp(high + more) * apart


NOTHING = Expected(np.empty(0), np.empty(0, dtype=bool))


def doubt(view: Lobe, medium: Medium, expected: Expected = NOTHING) -> str:
    """Why the scales of a history cannot be right, and what would explain it; "" where they can.

    A ratio that lies beyond what the prior members and their tails reach is doubted, and one outside :func:`bounds`,
    beyond its margin, unless half of the members are there as well, or a common gel comes as far.
    """
    ratio, (least, largest) = view.rayleigh_ratio(medium), bounds(view.R_max, medium)
    sure, ratios, largest = 1 + view.margin, expected.ratios, min(largest, FAR)
    apart = max(APART, sure)
    short, long = ratio * sure < least, ratio > largest * sure
    half = 2 * np.sum(ratios < least if short else ratios > largest) > len(ratios)
    if (short or long) and not half and not expected.like(ratio * apart if short else ratio / apart, short):
        limit = f"; a gel of {COMMON.G / 1e3:g} kPa allows no less than {least:.2f}"
        if long:
            limit = f"; a gel of {COMMON.mu:g} Pa s allows no more than {largest:.2f}" if largest < FAR else ""
        more = f", or the gel is {'thicker' if long else 'stiffer'}" if conceivable(view, medium) else ""
        return f"{_measured(ratio)}{limit}: {explained(SOFT / ratio)}{more}"
    if len(ratios) and not expected.reaches(ratio, apart):
        usual = float(np.median(ratios))
        span = f"{min(ratios):.2f} to {max(ratios):.2f}"
        return f"{_measured(ratio)}; the prior expects {span}: {explained(usual / ratio)}, or the prior is wrong"
    return ""


def conceivable(view: Lobe, medium: Medium) -> bool:
    """True if a gel up to :data:`EXTREME` collapses like this, and no diameters given as radii do."""
    least, largest = bounds(view.R_max, medium, EXTREME)
    sure, ratio = 1 + view.margin, view.rayleigh_ratio(medium)
    return least / sure <= ratio <= largest * sure and not _twice(SOFT / ratio)


def _measured(ratio: float) -> str:
    return f"the collapse takes {float(f'{ratio:.2g}'):g} of the Rayleigh time 0.915 R_max √(ρ/p∞)"


def _twice(factor: float) -> bool:
    return 2 / SAME_FACTOR < factor < 2 * SAME_FACTOR


def explained(factor: float) -> str:
    """What would make the history that of a usual bubble; ``factor`` is what its collapse time falls short by."""
    if _twice(factor):
        return "diameters given as radii? Or a time step, a pixel or a unit is wrong by a factor of 2"
    by = float(f"{max(factor, 1 / factor):.3g}")
    size, step = ("large", "short") if factor > 1 else ("small", "long")
    asked = "are the units of both columns right?" if by > FAR else "pixel size, frame rate, units"
    return f"radii {by:g} times too {size}, or the time step {by:g} times too {step} ({asked})"


def single(times: Array, radius: Array) -> bool:
    """True if the readings end with their first collapse or before its rebound has a top: what took the energy of that
    collapse, viscosity or sound, fragments, jets and a shape that is no sphere, is then told by nothing.
    """
    falling = slice(int(np.argmax(radius)), None)
    if radius[falling].min() > TOLD * radius.max() or len(maxima(radius[falling], SLIGHT)):
        return False
    try:
        view = lobe(times, radius)
    except DataError:
        return False
    return bool(times[-1] < view.t_max + (1 + REBOUND) * view.t_c)


def doubts(
    times: Array, radius: Array, predicted: Array, members: Mapping[str, Array], medium: Medium
) -> tuple[Caution, ...]:
    """:func:`doubt` of a window ``times`` (K,) s, ``radius`` (K,) m; serious where only a wrong scale explains it.

    ``predicted`` (N, K) m are the prior members, ``members`` their parameters by name, (N,) each, SI.
    """
    if radius[int(np.argmax(radius)) :].min() > TOLD * radius.max():
        return ()
    try:
        view = lobe(times, radius)
    except DataError:
        return ()
    ratios, common = [], []
    for path, usual in zip(predicted, _common(members, len(predicted)), strict=True):
        if path[int(np.argmax(path)) :].min() > (1 - SLIGHT) * path.max():
            continue  # of a bubble that rests, or grows to the end, any time may be told
        try:
            ratios.append(lobe(times, path).rayleigh_ratio(medium))
        except DataError:
            continue
        common.append(usual)
    expected = Expected(np.array(ratios), np.array(common, dtype=bool))
    words = doubt(view, medium, expected)
    if not words:
        return ()
    told = len(ratios) > 0 and expected.reaches(view.rayleigh_ratio(medium), max(APART, 1 + view.margin))
    return (caution("implausible-data", words, "caution" if told and conceivable(view, medium) else None),)


def _common(members: Mapping[str, Array], count: int) -> Mask:
    """Of members, whether neither G nor μ, where the law has one, is beyond what is granted."""
    within = np.ones(count, dtype=bool)
    for name, most in COMMON._asdict().items():
        within &= members.get(name, np.zeros(1)) <= most
    return within
