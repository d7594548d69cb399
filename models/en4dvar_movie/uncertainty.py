"""The errors of readings: errors of each frame, from its own outline and from what neighbouring frames say.

Independent part, per frame: pixel noise through the fit, times the factor by which sectors of the outline scatter more
than pixels do (jagged outlines, a part of what compression does), averaged over neighbouring frames of like sharpness.

Shape: a bubble's extent along the line of sight is not seen. Were its outline an isotropic random surface of degree 2,
the mean radius over the sphere would differ from that over the outline by a normal error of variance a²/6, where a is
the amplitude of mode 2 (the mean of a degree-2 harmonic over a great circle has variance σ²/4, mode 2 itself the rest,
3σ²/4 = a²/2). Two numbers tell a², so that 90 % intervals take Student's t with 2 degrees of freedom. Where a frame's
own a does not stand out of its noise, that of neighbouring frames together may, of which one that does (a speck of
dirt at its edge, say) counts no more than the least that would. What mode 2 has in common in all frames, as a share of
the radius and with its direction, moves all radii alike by one factor; a is what is left of it.

Cut: where the frame's edge cuts an outline, a circle is fitted, which is off where the bubble is elongated; an outline
with mode 2, fitted to the same pixels, tells by how much.

Exposure: over an exposure of length T the mean radius lies T² R̈/24 from that in its middle, R̈ as three frames show it;
or, where the edge is blurred more than the steps to its neighbours explain, as its speed differs from theirs over half
a step.

Turning: an edge that moves one way during the exposure has its half level where it is in the middle of it. One that
turns there, as in a collapse, sweeps a range of √12 blurs and is at its end in the middle: √3 blurs from the half
level. The less of the radius it sweeps, the rarer that is, unless nothing else explains the blur.

Curvature: blur moves the edge fitted to a disc inwards by w²/2R, and by w⁴/2R³ less than that to the next order (found
from discs without noise, tests/movie/test_fitting.py). It is given back for a frame's own blur or, where this
is clearly more than that of the movie's sharpest frames, for theirs: what goes beyond it is the wall's motion during
the exposure, which has no such shift.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.hints import counted, percent
from en4dvar_movie.frames import Frame, steps_of
from en4dvar_movie.outline import THRESHOLD, Optics, Outline

NEIGHBOURS = 10  # frames to each side
STUDENT = 2.92 / 1.645  # 95 % quantiles of t with 2 degrees of freedom and of the normal distribution
FLOOR = 0.005  # pixels: what sampling by whole pixels leaves uncertain in the best of images
SIGNIFICANT = 3.0  # std of a mode's amplitude from which it is one
COLLAPSE = 0.15  # of the radius: blur by motion from which the bubble may have turned within the exposure
TURNING = 0.065  # the same where nothing else explains the blur
ONE_WAY, TURNED = 0.25, 3**0.5 / 2  # of that blur: std of the radius
SHARP = 0.15  # of the square of a sharp edge's width, by which it varies
LIKELY = 2.0  # std of noise beyond which a frame is blurred by motion rather than by chance
CLEARLY = 3.0  # std of noise by which a frame is blurred more than the sharpest, whose own noise made them so
BENT = 0.46  # of the exposure in steps: std of the radius in units of the blur that neighbours do not explain
CUT = 3.0  # amplitudes of mode 2, by the share unseen: circles about cut ellipses are off by 1 to 4
ASKED = 8  # frames whose grey levels are counted
CLIPPED, HALF = 0.25, 0.5  # the share saturated beside an edge that hides its place; pixels that it then may be off
COARSE = 3.0  # std of noise: steps of grey levels that are larger are not smoothed by it
RIM = 0.5  # of its level at the edge: what is not known of a rim's shape


@dataclass(frozen=True)
class Errors:
    """In pixels: the corrected ``radius``, its independent std, how far all radii move together by the edge's level;
    ``mode_std`` is the std of A_n and B_n of a mode of the shape. ``factor`` is the std of the factor, unlike 1, by
    which the lasting shape moves all radii."""

    radius: float
    std: float
    common: float
    words: str = ""
    mode_std: float = float("nan")
    factor: float = 0.0


NOTHING = Errors(float("nan"), float("nan"), float("nan"))


def with_hidden(optics: Optics, frames: Sequence[Frame], clipped: float, grey: float) -> Optics:
    """The optics with what frames hide of where in the light's fall their edges lie: ``clipped`` is the share that is
    saturated about these, ``grey`` the grey levels to a contrast of one.
    """
    step, equalised = steps_of(frames[:: -(-len(frames) // ASKED)])
    share = -step / (grey * optics.contrast)
    hidden, words = max(HALF, optics.width), ""
    if clipped > CLIPPED:
        words = "beside the bubble's edge the frames are saturated, or black and white alone"
    elif equalised:
        hidden, words = 2 * hidden, "a program has equalised the histogram of the frames"
    elif share > 2 * THRESHOLD and step > COARSE * optics.noise * grey:
        hidden *= min(1.0, (2 * np.pi) ** 0.5 * share)
        steps = counted(max(round(1 / share), 1), "step")
        words = f"the frames have few grey levels, {steps} from the bubble to the light about it"
    return replace(optics, hidden=hidden, hides=words) if words else optics


def errors_of(outlines: Sequence[Outline | None], optics: Optics, exposure: float = 0.0) -> list[Errors]:
    """Errors of each frame, of which the exposure takes a share; of those without an outline :data:`NOTHING`."""
    frames, known = np.flatnonzero([o is not None for o in outlines]), [o for o in outlines if o is not None]
    ratios, turns = _smoothed(known, frames), _turns(known)
    hidden, lasting = _hidden([o.oval or o for o in known], ratios)
    beside = hidden + _bent(known, frames, ratios, turns, optics, exposure) + _unseen(known, lasting)
    factor, errors = STUDENT * lasting / 6**0.5, [NOTHING] * len(outlines)
    for k, o, ratio, variance, turned in zip(frames, known, ratios, beside, turns, strict=True):
        errors[k] = replace(_errors(o, ratio, variance, turned, optics), factor=factor)
    return errors


def _unseen(known: Sequence[Outline], lasting: float) -> Array:
    """Variance of the radius (K,) where the frame's edge cuts an outline: how far the radius of a circle is from that
    of an oval that fits better by more than noise, and what a ``lasting`` mode 2 over R makes of it, as noise allows.
    """
    where, variance = [k for k, o in enumerate(known) if o.seen < 1], np.zeros(len(known))
    cut = [(o, o.circle.R, o.oval) for o in known if o.seen < 1]
    told = [(v.circle.R - R, v.variance * v.ratio, o.better / v.ratio) if v else (0.0, R**2, 0.0) for o, R, v in cut]
    off, noise, better = np.reshape(told, (-1, 3)).T
    elongated = np.array([(CUT * lasting * R * (1 - o.seen)) ** 2 for o, R, _ in cut])
    oval = _beyond(better, np.ones(len(cut))) > 0
    variance[where] = np.where(oval, off**2 + noise, np.minimum(elongated, noise))
    return variance


def _beyond(squares: Array, noise: Array) -> Array:
    """What squares (K,) hold beside their noise, of this mean and std: of neighbours together where it is not seen in
    their own."""
    excess, bar, weights = squares - noise, (SIGNIFICANT**2 / 2 - 1) * noise, 1 / noise**2
    beyond = np.where(excess > bar, excess, 0.0)
    for n in np.flatnonzero(excess <= bar):
        near = slice(max(0, n - NEIGHBOURS), n + NEIGHBOURS + 1)
        together = float(np.minimum(excess, bar)[near] @ weights[near])
        if together > SIGNIFICANT * weights[near].sum() ** 0.5:
            beyond[n] = together / weights[near].sum()
    return beyond


def _bent(
    known: Sequence[Outline], frames: Indices, ratios: Array, turns: Sequence[bool], optics: Optics, exposure: float
) -> Array:
    """Variance of the radius (K,) for its curvature in time over the exposure (0: unknown, at most a step)."""
    radii = np.full(frames.max(initial=-1) + 3, np.nan)
    radii[frames + 1] = [o.circle.R for o in known]
    variance = np.nan_to_num((exposure**2 * np.diff(radii, 2) / 24) ** 2)[frames]
    steps = np.abs(np.diff(radii))
    largest = np.nan_to_num(np.fmax(steps[:-1], steps[1:]), nan=np.inf)[frames]  # without neighbours it says nothing
    explained = largest * (exposure or 1.0) / 12**0.5
    sharp = max(optics.width, float(np.percentile([o.width for o in known] or [0.0], 25)))
    for k, o in enumerate(known):
        if _excess(o, sharp, ratios[k], LIKELY) > explained[k] ** 2 + SHARP * sharp**2:
            moved = _moved(o, sharp)
            swept = moved / o.circle.R
            turning = TURNED * moved * min(1.0, swept / COLLAPSE) if turns[k] and swept > TURNING else 0.0
            variance[k] += max(turning, BENT * exposure * (moved - explained[k])) ** 2
    return variance


def _excess(outline: Outline, sharp: float, ratio: float, std: float) -> float:
    """Square of the blur beyond a sharp edge's width and ``std`` times what noise makes of it, px²."""
    return float(outline.width**2 - sharp**2 - std * (8 * outline.width**2 * outline.variance * ratio) ** 0.5)


def _moved(outline: Outline, sharp: float) -> float:
    """Blur beyond the width of a sharp edge, pixels."""
    return float(np.sqrt(max(outline.width**2 - sharp**2, 0.0)))


def _turns(known: Sequence[Outline]) -> list[bool]:
    """True if the radius of a frame lies below, or above, those of both neighbours."""
    steps, turns = np.diff([o.circle.R for o in known]), np.zeros(len(known), dtype=bool)
    turns[1:-1] = steps[:-1] * steps[1:] <= 0
    return turns.tolist()


def _smoothed(known: Sequence[Outline], frames: Indices) -> Array:
    """Sector scatter over pixel scatter, averaged over neighbours whose edge is as sharp and as complete."""
    each, smoothed = [(np.log(o.width), o.seen, o.ratio) for o in known], np.ones(len(known))
    first, end = np.searchsorted(frames, [frames - NEIGHBOURS, frames + NEIGHBOURS + 1])
    for k, (width, seen, _) in enumerate(each):
        near = each[first[k] : end[k]]
        alike = [np.exp(-(((w - width) / 0.2) ** 2) - ((s - seen) / 0.1) ** 2) for w, s, _ in near]
        smoothed[k] = float(np.average([ratio for *_, ratio in near], weights=alike))
    return smoothed


def _errors(outline: Outline, ratio: float, hidden: float, turned: bool, optics: Optics) -> Errors:
    sharp = min(outline.width, optics.width)
    optical = optics.width if _excess(outline, optics.width, ratio, CLEARLY) > 0 else outline.width
    radius = outline.circle.R + 0.5 * optical**2 / outline.circle.R
    radius -= 0.5 * optical**4 / radius**3
    variance = outline.variance * ratio + outline.common + hidden + outline.joined**2 + FLOOR**2
    words = ""
    moved = _moved(outline, sharp)
    if moved > COLLAPSE * outline.circle.R and _excess(outline, sharp, ratio, LIKELY) > 0:
        variance += ((TURNED if turned else ONE_WAY) * moved) ** 2
        words = f"the bubble {'turned' if turned else 'moved over much of its radius'} within the exposure"
    elif outline.joined:
        words = "nested circles too close to be told apart: their mean"
    elif outline.seen < 0.9:
        words = f"{percent(outline.seen)} of the outline lies in the frame"
    # the edge's profile has the slope 1/(√(2π) w) at its half level
    light, beside, wide = outline.rim or (0.0, 0.0, 0.0)
    blurred = np.hypot(outline.width, wide)
    there = light * np.exp(-0.5 * (beside / blurred) ** 2) / blurred / np.sqrt(2 * np.pi)  # the rim's level at the edge
    common = float(np.hypot(np.hypot(THRESHOLD, RIM * there) * np.sqrt(2 * np.pi) * outline.width, optics.hidden))
    return Errors(radius, float(np.sqrt(variance)), common, words, outline.mode_std * float(np.sqrt(ratio)))


def _hidden(outlines: Sequence[Outline], ratios: Array) -> tuple[Array, float]:
    """For the extent along the line of sight: the variance of each radius (K,), by what its own mode 2 or that of its
    neighbours has beside the one that all frames share, and the amplitude over R of the latter.
    """
    where = [k for k, o in enumerate(outlines) if o.amplitude(2) >= 0 and o.mode_std > 0]
    known, hidden = [outlines[k] for k in where], np.zeros(len(outlines))
    if not known:
        return hidden, 0.0
    radii = np.array([o.circle.R for o in known])
    noise = 2 * np.array([o.mode_std**2 for o in known]) * ratios[where]  # mean and std of a² where there is no mode 2
    noise /= radii**2
    shape = np.array([o.modes[:, 0] @ (1, 1j) for o in known]) / radii
    lasting, amplitude = _lasting(shape, noise)
    hidden[where] = STUDENT**2 * radii**2 / 6 * _beyond(np.abs(shape - lasting) ** 2, noise)
    return hidden, amplitude


def _lasting(shape: npt.NDArray[np.complex128], noise: Array) -> tuple[complex, float]:
    """The mode 2 (A + iB over R) that frames share and its amplitude; 0 where it does not stand out of their scatter.

    ``shape`` (K,) with the variances ``noise`` (K,) of a frame's own.
    """
    shares = 1 / noise / np.sum(1 / noise)
    mean = complex(shares @ shape)
    of_mean = float(shares**2 @ np.maximum(np.abs(shape - mean) ** 2, noise))
    if abs(mean) ** 2 <= SIGNIFICANT**2 / 2 * of_mean:
        return 0.0, 0.0
    return mean, (abs(mean) ** 2 - of_mean) ** 0.5
