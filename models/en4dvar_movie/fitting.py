"""Fitting the outline: a blurred edge, or several nested ones, to every pixel near it, robustly."""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from en4dvar.model.state import Array
from en4dvar_movie.kernels import SHAPE, residuals
from en4dvar_movie.outline import MODES, Circle, Optics, Outline, share_inside

ROUNDS = 30
CLOSE = (1e-2, 1e-2, 1e-3)  # pixels: the step at which each turn ends
RIM_SHARE = 0.45  # of the radius: where the bright centre ends, before it is fitted
SOFT_SHARE = 0.1  # of the radius: over which width it ends beside the blur, before that is fitted
THIN = 0.85  # of the radius: where the bright centre ends at most
LEVEL_SPREAD = 0.001  # of the background next to the bubble, in contrasts: halos are not the level of the background
FIRST_SPREAD = (0.03, 0.0, 0.0)  # of the contrast in the first turns
LOOSE = 0.1  # how much less is known of the level next to an edge that is blurred
CUTOFF = 5.0  # of Tukey's weights, in robust std
DARKER = 3.0  # std of the contrast: no bubble is darker than the movie's clearest by more
OWN = 6.0  # widths of the edge: a bubble with a larger radius may tell its contrast itself
EVEN = 0.03  # of the contrast: what the brightness near the outline may scatter by beside noise if it does
AGAINST = 2.5  # std of the contrast from which it then does
FREE = 0.3  # of the contrast: what it may then differ by
MOST_RIM = 20.0  # pixels: what the light of a rim, its distance and its width may be
WHOLE = 0.9  # of the outline: how much is seen of one that the frame does not cut
LONG = 1.0  # of the radius: what amplitudes of modes may be
REACH = 4.0  # how far from the outline pixels are used, in widths of the edge
APART = 1.5  # widths of the edge: nested circles that are closer are not told apart
SHARP = 1.35  # widths of the movie's sharp edges: what is no wider is blurred by nothing else
TWO = 2.6  # their own widths by which two edges lie apart that are no blurred one
SURE = 0.03  # share of the squares that two edges must explain and a blurred one does not
X, Y, R, W, LEVEL, CONTRAST, GLARE, RIM, SOFT = range(SHAPE)
Parts = tuple[int, int]  # where the distances of nested circles begin, and the rim
Fit = tuple[Array, Parts, float, Optics]  # parameters (P,), the noise, and the optics as they are known for this frame


def fit_outline(
    image: Array, start: Circle, optics: Optics, circles: int = 1, ovals: bool = False
) -> list[Outline] | None:
    """The outline near ``start`` in an image (H, W) whose background is zero; None where nothing fits.

    With several ``circles``, nested about one centre, one of each, the largest first. With ``ovals``, where the frame
    cuts them, they tell what mode 2 changes.
    """
    fitted = _fit(image, start, optics, circles)
    outlines = None if fitted is None else _outlines(image, *fitted)
    if not ovals or fitted is None or not outlines or outlines[0].seen >= WHOLE:
        return outlines
    oval = _fit(image, outlines[0].circle, optics, circles, 2)
    others = None if oval is None else _outlines(image, *oval)
    if oval is None or others is None:
        return outlines
    wrong, less = _misfits(image, fitted, oval)
    return [replace(o, oval=other, better=(wrong - less) / 2) for o, other in zip(outlines, others, strict=True)]


def two_edges(image: Array, start: Circle, optics: Optics) -> float:
    """How far apart two sharp edges lie (pixels) where a blurred one was fitted; 0 if the image does not show them."""
    single, double = (_fit(image, start, optics, circles) for circles in (1, 2))
    if single is None or double is None:
        return 0.0
    wrong, less = _misfits(image, single, double)
    q, (apart, _), *_ = double
    sharp = q[W] < SHARP * optics.width and q[apart] > TWO * q[W]
    return float(q[apart]) if sharp and wrong - less > SURE * wrong else 0.0


def _misfits(image: Array, first: Fit, second: Fit) -> tuple[float, float]:
    """Sums of squares of what two fits leave about the first, in units of the noise beside the second."""
    (p, parts, *_), (q, second_parts, noise, _) = first, second
    ring = _ring(p, q[slice(*second_parts)], p[parts[1] :])
    of_first, of_second = (residuals(image, *fit[:2], ring)[0] / noise for fit in (first, second))
    return float(np.sum(np.minimum(of_first, 5) ** 2)), float(np.sum(np.minimum(of_second, 5) ** 2))


def _fit(image: Array, start: Circle, optics: Optics, circles: int, least: int = 1) -> Fit | None:
    """A fit with modes up to ``least`` at least."""
    radii = nested_radii(image, start, optics, circles)
    p = np.concatenate([np.zeros(SHAPE), radii[0] - radii[1:], optics.rim])
    p[[X, Y, R, W, CONTRAST]] = start.x, start.y, radii[0], optics.width, optics.contrast
    p[[RIM, SOFT]] = RIM_SHARE * radii[-1], SOFT_SHARE * radii[-1]
    noise = abs(optics.contrast)
    parts = SHAPE, SHAPE + circles - 1
    for turn in range(3):  # the ring of pixels follows the circle; the cutoff follows the noise
        gaps, rim = p[slice(*parts)], p[parts[1] :]
        ring = _ring(p, gaps, rim)
        if _glare_is_far(p, gaps, ring):
            p[[GLARE, RIM, SOFT]] = 0.0, RIM_SHARE * _innermost(p, gaps), SOFT_SHARE * _innermost(p, gaps)
        first = SHAPE + 2 * (max(modes_for(image, p), least) - 1)
        parts = first, first + circles - 1
        p = np.concatenate([p[:SHAPE], np.zeros(first - SHAPE), gaps, rim])
        known = replace(optics, spread=max(optics.spread, FIRST_SPREAD[turn]))
        fitted = _descend(image, p, parts, ring, noise, known, CLOSE[turn])
        if fitted is None:
            return None
        p = _sorted(fitted, parts)
        noise = max(1.4826 * float(np.median(np.abs(residuals(image, p, parts, ring)[0]))), 1e-6)
    against = abs(p[CONTRAST] / optics.contrast - 1) > AGAINST * (optics.spread + optics.differs)
    if against and optics.even and optics.differs < FREE and p[R] > OWN * p[W]:
        own = _fit(image, Circle(*p[:W]), replace(optics, differs=FREE), circles, least)
        if own is not None and tells_contrast(own[0][R], own[0][W], own[2], optics):
            return own
    return p, parts, noise, optics


def tells_contrast(radius: float, width: float, noise: float, optics: Optics) -> bool:
    """True of a bubble that is much larger than its edge's width and evenly dark, but for the noise of a pixel."""
    return radius > OWN * width and noise**2 < optics.noise**2 + (EVEN * optics.contrast) ** 2


def nested_radii(image: Array, start: Circle, optics: Optics, circles: int) -> Array:
    """First radii (S,), the largest first: where the mean brightness about the centre passes each step's middle."""
    if circles == 1:
        return np.array([start.R])
    y, x = np.indices(image.shape)
    r = np.hypot(x - start.x, y - start.y).astype(int).ravel()
    profile = np.bincount(r, np.nan_to_num(image.ravel())) / np.maximum(np.bincount(r), 1) / optics.contrast
    dark = np.maximum.accumulate(profile[: int(2 * start.R) + 20][::-1])  # from outside
    at = [len(dark) - 1 - int(np.argmax(dark > (s + 0.5) / circles)) for s in range(circles)]
    radii = np.array([a if dark[-1] > (s + 0.5) / circles else np.nan for s, a in enumerate(at)]) + 0.5
    radii[np.isnan(radii)] = np.nanmin(np.append(radii, start.R)) - 2.0
    return np.maximum(radii - 1e-3 * np.arange(circles), 1.0)


def modes_for(image: Array, p: Array) -> int:
    """The highest mode that a circle of this size shows: none where a part of it is not seen."""
    if share_inside(image, Circle(*p[:3])) < WHOLE:
        return 1
    return int(np.clip(p[R] / 4.0, 2, MODES))


def _innermost(p: Array, gaps: Array) -> float:
    return float(p[R] - max(gaps, default=0.0))


def _sorted(p: Array, parts: Parts) -> Array:
    """The largest radius as R, the others inside it by growing distances."""
    radii = np.sort(p[R] - np.append(0.0, p[slice(*parts)]))[::-1]
    return np.concatenate([p[:R], radii[:1], p[W : parts[0]], radii[0] - radii[1:], p[parts[1] :]])


def _ring(p: Array, gaps: Array, rim: Array) -> Array:
    reach = max(REACH * p[W], 6.0)
    beside = rim[1] + 2 * np.hypot(p[W], rim[2]) if rim.any() else 0.0
    return np.array([p[X], p[Y], max(0.0, _innermost(p, gaps) - reach), p[R] + max(reach, beside)])


def _glare_is_far(p: Array, gaps: Array, ring: Array) -> bool:
    return bool(ring[2] > 0.75 * _innermost(p, gaps))


def _known(p: Array, parts: Parts, ring: Array, noise: float, optics: Optics) -> tuple[Array, Array]:
    """The prior knowledge: contrast; the bright centre, which may be missing. Centre (P,) and precision (P,)."""
    centre, precision = np.zeros(len(p)), np.zeros(len(p))
    gaps = p[slice(*parts)]
    inner = _innermost(p, gaps)
    centre[[RIM, SOFT, CONTRAST]] = RIM_SHARE * inner, SOFT_SHARE * inner, optics.contrast
    tight = 1e12 if _glare_is_far(p, gaps, ring) else 1.0
    precision[[RIM, SOFT]] = noise**2 * tight / (0.1 * inner) ** 2
    precision[SHAPE : parts[0]] = noise**2 / (LONG * p[R]) ** 2
    precision[GLARE] = noise**2 * tight / optics.contrast**2
    chance = 2 * (8 / np.pi**0.5 * p[W] / p[R]) ** 0.5 * p[W] * noise / abs(p[CONTRAST])  # 2 std of the width's square
    moved = max(p[W] ** 2 - optics.width**2 - chance, 0.0) ** 0.5
    loose = max(0.0, moved / p[R] - 0.1)  # a bubble that collapses within the exposure is fainter, its halo blurred
    precision[LEVEL] = noise**2 / (max(LEVEL_SPREAD, optics.spread / 3, LOOSE * loose) * optics.contrast) ** 2
    precision[CONTRAST] = noise**2 / ((optics.spread + optics.differs + loose) * optics.contrast) ** 2
    centre[parts[1] :] = optics.rim
    precision[parts[1] :] = noise**2 / np.maximum(optics.rim_std, 1e-6) ** 2
    precision[slice(*parts)] = noise**2 / p[R] ** 2  # of circles that cannot be told apart
    return centre, precision


def _descend(
    image: Array, p: Array, parts: Parts, ring: Array, noise: float, optics: Optics, close: float
) -> Array | None:
    """Levenberg–Marquardt; None where it leaves what an outline can be."""
    damping, cutoff = 1e-3, CUTOFF * noise
    centre, precision = _known(p, parts, ring, noise, optics)
    nested = parts[1] > parts[0]
    bright = 0.0, -optics.contrast  # what the centre can be between
    darkest = (1 + DARKER * (optics.spread + optics.differs)) * optics.contrast
    A, g, total, cost = normal_equations(image, p, parts, ring, cutoff)
    if total < 3 * len(p):
        return None
    cost += 0.5 * float(precision @ (p - centre) ** 2)
    for _ in range(ROUNDS):
        H = A + np.diag(precision)
        step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12), g - precision * (p - centre))
        trial = p + step
        trial[W] = np.clip(trial[W], 0.3, max(2 * p[W], 1.0))
        trial[GLARE] = np.clip(trial[GLARE], min(bright), max(bright))
        trial[parts[1] :] = np.clip(trial[parts[1] :], 0.0, MOST_RIM)
        trial[CONTRAST] = max(trial[CONTRAST], darkest)
        inner = _innermost(trial, trial[slice(*parts)])
        trial[RIM] = np.clip(trial[RIM], 0.1 * inner, THIN * inner)
        trial[SOFT] = np.clip(trial[SOFT], 1e-3 * inner, 0.5 * inner)
        gone = not np.all(np.isfinite(trial)) or inner < 1 or trial[R] > 3 * max(image.shape)
        if gone and (not nested or damping > 1e6):  # a single circle that shrinks to nothing is a speck of dirt
            return None
        if gone:
            damping *= 10
            continue
        equations = normal_equations(image, trial, parts, ring, cutoff)
        better = equations[3] + 0.5 * float(precision @ (trial - centre) ** 2)
        if better <= cost and equations[2] > 0:
            done = np.max(np.abs(step[:W])) < close and cost - better <= max(close**2, 1e-7) * cost
            p, (A, g), cost, damping = trial, equations[:2], better, max(damping / 10, 1e-7)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return p


def normal_equations(
    image: Array, p: Array, parts: Parts, ring: Array, cutoff: float
) -> tuple[Array, Array, float, float]:
    """JᵀWJ (P, P), JᵀWr (P,), Σ w and the robust cost, W of Tukey's bisquare with ``cutoff``."""
    off, rows, _ = residuals(image, p, parts, ring)
    left = np.maximum(1 - (off / cutoff) ** 2, 0.0)  # of Tukey's weights the roots
    rows *= left[:, None]
    return rows.T @ rows, (left * off) @ rows, float(left @ left), float(np.sum(1 - left**3)) * cutoff**2 / 6


def _outlines(image: Array, p: Array, parts: Parts, noise: float, optics: Optics) -> list[Outline] | None:
    gaps, rim = p[slice(*parts)], p[parts[1] :]
    ring = _ring(p, gaps, rim)
    off, rows, places = residuals(image, p, parts, ring)
    left = np.maximum(1 - (off / (CUTOFF * noise)) ** 2, 0.0)  # of Tukey's weights the roots
    total = np.sum(left**2)
    A = rows.T @ (left[:, None] ** 2 * rows)
    _, precision = _known(p, parts, ring, noise, optics)
    try:
        inverse = np.linalg.inv(A + np.diag(precision))
    except np.linalg.LinAlgError:
        return None
    shape = p[SHAPE : parts[0]].reshape(-1, 2).T
    mode_variance = float(np.diag(inverse)[SHAPE : parts[0]].mean()) if shape.size else 0.0
    free = len(p) - 3 * _glare_is_far(p, gaps, ring)
    # how much larger even and odd rows show the radius: Σ r dm/dR / Σ (dm/dR)²
    slopes, product = (np.bincount(places[:, 0] % 2, rows[:, R] * part, 2) for part in (rows[:, R], off))
    slopes = np.maximum(slopes, 1e-30)
    angles = np.arctan2(places[:, 0] - p[Y], places[:, 1] - p[X]) / (2 * np.pi) + 0.5
    slope = np.sum(left * (5 * left - 4)) / total  # ψ' of all pixels over their weights
    outlines: list[Outline] = []
    every = np.append(0.0, gaps)
    # nested circles by their places, the largest first; those that are closer to the next are together
    for group in np.split(np.arange(len(every)), 1 + np.flatnonzero(np.diff(every) >= APART * p[W])):
        # of the radius, or of the mean of radii that cannot be told apart
        weights = inverse[R] - np.mean([inverse[parts[0] + s - 1] if s else 0 * p for s in group], axis=0)
        inside = every[group]
        circle = Circle(float(p[X]), float(p[Y]), float(p[R] - inside.mean()))
        sectors = int(np.clip(2 * np.pi * circle.R / max(4.0, 2 * p[W]), 8, 256))
        sector = np.minimum((angles * sectors).astype(int), sectors - 1)
        moved = left**2 * (rows @ weights)  # the influence of a pixel on the radius, over its residual
        by_sector = csr_array((moved, (sector, np.arange(len(off)))), (sectors, len(off)))
        sums, fitted = by_sector @ off, by_sector @ rows  # the latter is JᵀWJ·weights of each
        spread = np.sum((moved * off) ** 2)
        # the step of robust weights is the M-estimator's, its error that of Huber (1981): ψ' instead of the weights
        variance = spread / max(slope, 0.3) ** 2 * total / max(total - free, 1.0)
        common = noise**2 * weights[CONTRAST] ** 2 * precision[CONTRAST]  # of the contrast that all frames share
        outline = Outline(
            circle=circle,
            width=float(p[W]),
            contrast=float(p[CONTRAST]),
            noise=noise,
            modes=shape,
            variance=float(variance),
            ratio=float(np.sum(sums**2) / _left(fitted, weights, A, inverse) / max(spread, 1e-30)),
            common=float(common),
            mode_std=float(np.sqrt(max(mode_variance, 0) * np.sum((left * off) ** 2) / total)),
            seen=share_inside(image, circle),
            rows=float(np.subtract(*(product / slopes))),
            rows_std=float(noise * np.sqrt(np.sum(1 / slopes))),
            rim=tuple(rim),
            # as if evenly spread over the distance from which they are told apart
            joined=float(np.hypot(APART * p[W] / 12**0.5, np.std(inside))) if len(group) > 1 else 0.0,
        )
        outlines += [outline] * len(group)
    return outlines


def _left(fitted: Array, weights: Array, A: Array, inverse: Array) -> float:
    """The part that a fit leaves of the scatter of sums over sectors, as a share of that of the sums themselves.

    Residuals are (I − H) times the errors, H = J A⁻¹ Jᵀ; a sum over a sector is mᵀ(I − H)ε, of variance
    mᵀm − 2 gᵀA⁻¹g + gᵀA⁻¹(JᵀJ)A⁻¹g with g = Jᵀm: ``fitted`` (K, P) holds g of each sector, Σ mᵀm is g·weights.
    """
    back = fitted @ inverse
    lost = 2 * np.sum(back * fitted) - np.sum((back @ A) * back)
    return float(max(1 - lost / max(np.sum(fitted @ weights), 1e-30), 0.2))
