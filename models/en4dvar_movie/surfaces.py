"""The background of a movie without an empty frame: the smooth surface beside which what differs is a disc."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Array, Mask
from en4dvar_movie.frames import Frame
from en4dvar_movie.outline import LEAST_CONTRAST, MOST_PATCHES, circle_through, labelled, rim

ROUNDS, LEANINGS = 8, 30  # of a fit that leaves out what is far off, and of one that lies above most
OFTEN = 90  # per cent of the frames that are darker than what begins an envelope
FLICKER = 0.2  # of the brightness: what a lamp may change, whatever else the frame shows
NEARLY = 0.9  # of a frame: what a flash lights that is no background
WITHIN = 0.01  # weight of what lies within an envelope, as a share of that of what lies beyond it
TOPS = 98  # per cent of the pixels that lie lower over an envelope than those that tell its scatter
MEAN, DIFFERS = 3, 0.3  # pixels: side of squares that differ from a level; by which share of what differs most
LEAST = 24  # pixels of a patch
BETTER = 1 / 3  # of what no disc explains beside the usual surface: what may be left beside another that replaces it
MOST = 2  # times what no disc explains: what discs must
DISCS = 0.5  # of what discs explain beside the usual surface: what they must beside another
UNTOLD = 0.1  # of the frames: what structure that no disc explains may take
FEW = 5  # per cent of the frames: in which something may be seen, or not seen, that never, or always, is
BESIDE = 3  # pixels about what never differs: where a rim stands still
STILL = 0.1  # of a patch: how much of it lies next to such a rim where it stands still
BLURRED, SHADE = 12, 0.03  # pixels that its blur reaches at most; the share of what differs most that is no blur
SLENDER = 0.25  # of the field: what stands still before the background takes less
COVERED, BARE = 0.6, 0.5  # of a ring about its middle: what a bubble always covers of it at least; and of one beyond
ROUND, DISC = 0.5, 0.8  # of a patch and the disc through its rim that both share, if it is all that tells a bubble


def flashes_first(leading: Sequence[Frame], samples: Sequence[Frame]) -> int:
    """How many frames at the beginning of a movie a flash lights: nearly everywhere, they are brighter than most frames
    by more than a lamp flickers."""
    usual = np.percentile(np.array(samples, dtype=np.float32), OFTEN, axis=0)
    lit = [np.mean(frame > (1 + FLICKER) * np.abs(usual)) > NEARLY for frame in leading]
    return [*lit, False].index(False) % len(leading)


def surface_beside_discs(frames: Sequence[Frame], blind: Mask, unit: float) -> tuple[Array, Mask] | None:
    """A quadratic surface (H, W) through the background of frames that all hold a bubble, where it is not ``blind``,
    and what stands still before it, as a needle. None where beside each of them most of what differs is no disc.

    Of three, that beside which discs explain best what differs: the one through what the border usually shows, which a
    bubble may cover, and those that begin as a plane over the brightest and under the darkest that pixels often show.
    """
    films = np.array(frames, dtype=np.float32)
    surfaces = [smooth_surface(frames, blind, unit)]
    smooth = ndimage.uniform_filter(films, (0, MEAN, MEAN))
    terms = _terms(blind.shape)
    for side, extreme in zip((-1, 1), np.percentile(smooth, (100 - OFTEN, OFTEN), axis=0), strict=True):
        over = np.zeros_like(extreme)
        for _ in range(LEANINGS):  # asymmetric least squares
            over = side * (extreme - _fitted(terms[:3], extreme, ~blind * np.where(over >= 0, 1.0, WITHIN)))
        tops = over[~blind & (over >= np.percentile(over[~blind], TOPS))]
        surfaces.append(_trimmed(terms, extreme, np.abs(over) <= _far(tops, unit), ~blind, unit))
    extremes = np.percentile(smooth, (FEW, 50, 100 - FEW), axis=0)
    still = [_standing(extremes - surface, ~blind, surface) for surface in surfaces]
    for fields in ([~blind] * len(surfaces), [~blind & ~stands for stands in still]):
        of_each = zip(surfaces, fields, strict=True)
        discs, rest = np.array([_discs_and_rest(films - surface, field) for surface, field in of_each]).T
        told = discs > np.maximum(MOST * rest, DISCS * discs[0])
        left = np.where(told | (rest < [UNTOLD, 0, 0]), rest, np.inf)
        best = int(np.argmin(left * (BETTER, 1, 1)))
        if left[best] < np.inf:
            return surfaces[best], still[best]
    return None


def _standing(extremes: Array, field: Mask, surface: Array) -> Mask:
    """What stands still (H, W) and comes from the border: patches that differ in nearly every frame, beside a rim of
    which nothing differs in more than a few, and which are no disc. Where they are wider than there, a bubble is.

    ``extremes`` (3, H, W): what differs usually, and most in a few frames to both sides.
    """
    low, usual, high = extremes
    most = float(np.max(np.percentile(np.abs(extremes[:, field]), 99, axis=1)))
    limit = max(DIFFERS * most, LEAST_CONTRAST * float(np.median(np.abs(surface[field]))))
    whole = ndimage.binary_fill_holes(field)  # from what is written within the field nothing comes
    border = whole & ~ndimage.binary_erosion(whole, np.ones((3, 3)))
    result = np.zeros_like(field)
    for always, ever, shade in ((-high, -low, -usual), (low, high, usual)):
        never = field & (ever < limit)
        beside = ndimage.binary_dilation(never, iterations=BESIDE)
        labels, sizes = labelled(field & (always > limit))
        for number in {*labels[border]} & {*np.flatnonzero(sizes >= LEAST)}:
            patch = labels == number
            depth, nearest = ndimage.distance_transform_edt(patch, return_indices=True)
            by_still = patch & beside[tuple(nearest)]
            if by_still.sum() < STILL * patch.sum() or is_round(patch, DISC):
                continue
            core = _core(patch, by_still, field & (ever > limit), depth * border)
            stands = ndimage.binary_opening(patch & ~core, np.ones((3, 3)))
            off = ndimage.distance_transform_edt(~stands)
            rings = ((off > n) & (off <= n + 1) & never for n in range(BLURRED))
            blurred = [float(np.median(shade[ring])) > SHADE * most for ring in rings if ring.any()]
            result |= off <= [*blurred, False].index(False)
    return result & (np.mean(result[field]) < SLENDER)  # or the surface is that of the bubble


def _core(patch: Mask, by_still: Mask, ever: Mask, depth: Array) -> Mask:
    """What a bubble always covers (H, W) of a patch that stands still and reaches into it: a disc about the middle of
    what it ``ever`` does, if that is wider than what stands still is at the border, by its ``depth`` there, which the
    bubble may reach too. Its rim is seen on the side away from where the patch is ``by_still``."""
    labels, _ = labelled(ever)
    room = ndimage.distance_transform_edt(labels == np.max(labels[patch]))
    y, x = np.unravel_index(np.argmax(room), room.shape)
    down, across = np.ogrid[-y : len(patch) - y, -x : patch.shape[1] - x]
    r = np.hypot(down, across)
    width = np.max(depth[r > room[y, x] + BESIDE], initial=0) or np.max(depth)
    if room[y, x] < width + BESIDE:
        return np.zeros_like(patch)
    v, u = np.mean(np.nonzero(by_still), axis=1) - (y, x)
    away = down * v + across * u <= 0
    rings = r.astype(int)
    of_patch, of_all = (np.bincount(rings[part], minlength=rings.max() + 3) for part in (away & patch, away))
    covered = of_patch / np.maximum(of_all, 1)
    end = 2 + np.max(np.flatnonzero(covered[: int(room[y, x])] > COVERED), initial=-2)
    return np.asarray((r < end) & (covered[end] < BARE))


def smooth_surface(frames: Sequence[Frame], blind: Mask, unit: float) -> Array:
    """A quadratic surface (H, W) through what frames usually show and most of their border does."""
    field, border = ~blind, max(2, min(blind.shape) // 10)
    kept = field & ~ndimage.minimum_filter(field, 2 * border + 1, mode="constant")
    typical = np.median(np.array(frames, dtype=np.float32), axis=0)
    return _trimmed(_terms(blind.shape), typical, kept, field, unit)


def _terms(shape: tuple[int, ...]) -> Array:
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]  # within ±1, so that squares lose little
    return np.stack([np.ones_like(x), x, y, x * y, x * x, y * y]).reshape(6, -1)


def _fitted(terms: Array, values: Frame, weights: Array | Mask) -> Array:
    chosen = terms * weights.ravel()
    fitted = np.linalg.solve(chosen @ terms.T, chosen @ values.ravel().astype(float))
    return np.asarray((fitted @ terms).reshape(values.shape))


def _trimmed(terms: Array, values: Frame, kept: Mask, field: Mask, unit: float) -> Array:
    """The surface through the pixels that are ``kept`` at first, then through all of the field that lie near it."""
    for _ in range(ROUNDS):
        surface = _fitted(terms, values, kept & field)
        off = np.abs(values - surface)
        kept = field & (off <= _far(off[kept & field], unit))
    return np.asarray(surface, dtype=np.float32)


def _far(off: Array, unit: float) -> float:
    return 3 * max(1.4826 * float(np.median(np.abs(off))), 0.5 * unit)


def _discs_and_rest(differences: Array, field: Mask) -> tuple[float, float]:
    """Of images (K, H, W): the share that differs and lies in discs through the rims of what differs, and the share
    that is in either but not in both. What has no rim, as a bubble that fills the field, tells nothing.
    """
    smooth = np.abs(ndimage.uniform_filter(differences, (0, MEAN, MEAN)))
    most = float(np.max(np.percentile(smooth[:, field], 99, axis=1)))
    both = either = 0
    for differs in (smooth > DIFFERS * most) & field:
        labels, sizes = labelled(ndimage.binary_fill_holes(differs))  # bright centres are holes
        for number in np.argsort(-sizes)[: min(MOST_PATCHES, np.sum(sizes >= LEAST))]:
            patch = labels == number
            points = rim(patch)
            sides = [np.array(half(points), dtype=int).T for half in (np.floor, np.ceil)]
            circle = circle_through(points[np.all([field[v, u] for u, v in sides], axis=0)])
            if circle is None:
                continue
            disc = field & (circle.off(field.shape) < 0)
            both, either = both + np.sum(patch & disc), either + np.sum(patch | disc)
    of_all = len(differences) * np.sum(field)
    return both / of_all, (either - both) / of_all


def is_round(patch: Mask, share: float = ROUND) -> bool:
    """True of a disc and what the frame leaves of it, also of one with a bright centre; not of a stripe."""
    circle = circle_through(rim(patch))
    if circle is None:
        return False
    disc = circle.off(patch.shape) < 0
    return bool(np.sum(patch & disc) > share * np.sum(patch | disc))
