"""The background of a movie, and the properties that its frames share: sign, noise, contrast, sharpness."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Array, Mask
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.burnt import burnt_in, margins
from en4dvar_movie.drifting import drift_of, shift_at
from en4dvar_movie.fitting import FREE, fit_outline, tells_contrast
from en4dvar_movie.frames import Frame, Movie, saturated
from en4dvar_movie.outline import THRESHOLD, TILE, Circle, Optics, Outline, labelled, locate
from en4dvar_movie.surfaces import FLICKER, flashes_first, is_round, smooth_surface, surface_beside_discs
from en4dvar_movie.uncertainty import with_hidden

DEAD = 0.25  # of the brightness about it: where a background shows nothing of a bubble, as writing does
STRUCTURE = 0.1  # of that brightness: structure that a bubble darkens as it does the rest
CORNERS = 0.01  # share of the tiles that are brighter yet, where a larger change is a bubble's or a flash's
UNLIT = -0.9  # of the brightness: what a lamp may lack before a frame is black
TOP, MANY = 90, 0.4  # per cent of the tiles that are not the brightest; the share of tiles that tells the light
ALIKE, CLOSE = 4.0, 0.05  # std of noise, or of the brightness, by which tiles in one light may differ
LAMP = 0.25  # logarithm of the ratio of brightness of two frames that differ by their lamp
LIVELY = 0.4  # share of the rim of a patch that changes in a bubble, not in what stands still
OFTEN = 0.1  # of the frames: in how many it does
RESTLESS, LEAST_PAIRS = 0.25, 5  # share and number of steps from frame to frame in which writing changes
MOST, BLANK = (5, 95), 0.25  # per cent of the pixels; share of the most contrast of writing that it has in any frame
WRITING = (24, 14, 3)  # pixels: largest height of writing; how far about its changing part the rest of it lies
LEADING, SAMPLES = 40, 24  # frames looked at for the background, and for what they share
SMOOTH = 12.0  # pixels: the brightness that contrasts are relative to varies slowly
LEAST_SPREAD = 0.002  # of the contrast
MIDDLE = 0.2  # of the light in its middle: what a dark bubble lacks about it at least
FULL = 2  # power of its radius over its edge's width with which a bubble tells the contrast: small ones show less of it
TELLING, LEAST_TELLING = 8, 4  # frames that are asked for a rim; and those that tell how much contrasts differ
ANY_RIM, ANY_RIM_STD = (0.1, 2.5, 1.0), (3.0, 2.5, 2.0)  # a rim before it is fitted, in widths of the edge
DENSITY = 1 / math.sqrt(2 * math.pi)  # of the normal distribution in its middle
LARGE = 95  # per cent of the frames: from which on bubbles count alike
NOISY = 0.1  # of a pixel's noise: what a contrast can be uncertain by for the noise
SHARPEST = 5  # per cent of the frames: those where the bubble moved least within the exposure
CLEAR = 4.0  # times the least variance of an edge's width: up to which noise does not make it a sharp one
BLOB = 120  # pixels: the smallest patch of a first frame that may be a bubble
AROUND = 5.0  # pixels beside an edge
BESIDE, EDGE = 3, 1.5  # pixels about a rim, or along the border, that are compared; std of the blur before that
FIRST = 0.25  # share of the edges of what changes that tells that the first frame shows a bubble
DRIFTS = 1.0  # noise of a pixel: means over 3 × 3 pixels that differ by more from frame to frame are dirt that drifts
SPECK = 100  # pixels: the largest change that is no bubble
BEGUN, SURE = 0.25, 2.0  # of the shade in a bubble's middle, and of a pixel's noise: what tells that it was there
HALO, STILL = 9, 0.01  # side of squares whose mean tells more than a pixel, and what it may differ by
SURELY = 1.4  # variances of noise beyond which the scatter in such a square is something else
BRIGHT = 0.25  # of the contrast: how much brighter a flash is
STEADY, CHANGED = 10_000, 0.3  # tiles that say how bright a frame is, and the share of them that a flash changes
DIM, FIELD = 0.3, 95  # of the light that most pixels (per cent) have at most: what the field of view's outside has
SWINGS = 0.015  # of the light: std beside the edge of a bright bubble that moves by half a pixel, as no aperture does
MOVES = 0.05  # of the light: std on an edge that moves
APERTURE = (2, 6, 12)  # pixels beside it: where the light is blurred, tells that it ends there, and tells the lamp


@dataclass(frozen=True)
class Background:
    """``level`` and ``gain`` (H, W): a frame becomes (frame − level) gain, zero without a bubble and negative inside.
    Where the gain is NaN nothing is looked at: writing that changes, black or saturated parts, what the user masks.

    ``noise`` is the std of a pixel so normalised; ``frames`` how many the level is made of, 0 where none is empty.
    ``drift`` is that of :func:`en4dvar_movie.drifting.drift_of`.
    """

    level: Array
    gain: Array
    noise: float
    frames: int
    relative: bool = True
    drift: Array | None = None

    def behind(self, number: int) -> "Background":
        """The background as a frame shows it, where the camera drifts."""
        if self.drift is None:
            return self
        shift = shift_at(self.drift, number)
        level, gain = (ndimage.shift(part, shift, order=0, cval=np.nan) for part in (self.level, self.gain))
        return replace(self, level=level, gain=gain)

    def normalised(self, frame: Frame) -> tuple[Array, Array]:
        """The image (H, W) and its tiles, without what the lamp flickers."""
        image = (frame.astype(np.float32) - self.level) * self.gain
        rows, columns = (TILE * (side // TILE) for side in image.shape)
        whole = np.where(np.isnan(image), np.float32(0), image)[:rows, :columns]
        tiles = np.mean([whole[j::TILE, i::TILE] for j in range(TILE) for i in range(TILE)], axis=0)
        white = frame.dtype.kind in "ui" and np.median(frame) == np.iinfo(frame.dtype).max
        change = self._light(tiles[:: -(-tiles.size // STEADY)], bool(white)) if self.relative else 0.0
        scale = np.float32(1 / (1 + change))
        return (image - np.float32(change)) * scale, np.where(tiles == 0, 0, (tiles - np.float32(change)) * scale)

    def _light(self, tiles: Array, white: bool) -> float:
        """How much brighter than the level the background is, by its brightest tiles: the others may be the bubble.

        A bubble that nearly fills the frame leaves corners that are brighter yet; a flash is brightest in its middle,
        or makes the frame ``white``.
        """
        apart = max(ALIKE * self.noise / TILE, CLOSE)
        alike = tiles > np.percentile(tiles, TOP) - apart
        change = float(np.median(tiles[alike])) if np.mean(alike) > MANY else 0.0
        brighter = np.mean((tiles > change + apart) & (tiles != 0))
        return max(change, UNLIT) if abs(change) <= FLICKER or (brighter < CORNERS and not white) else 0.0

    def steadied(self, image: Array, tiles: Array, bubble: Circle, contrast: float) -> Array:
        """The image at the background's own brightness: what the light does far from the bubble is taken out.

        What is darker than half the ``contrast`` of a bubble is another, or something else before the light.
        """
        far = Circle(bubble.x / TILE, bubble.y / TILE, (1.4 * bubble.R + 8) / TILE).off(tiles.shape) > 0
        lit = ndimage.uniform_filter(tiles, 3, mode="nearest") > contrast / 2
        outside = tiles[far & lit]
        if len(outside) < 0.05 * tiles.size:
            return image
        change = np.float32(np.median(outside[:: -(-len(outside) // STEADY)]))
        return (image - change) / (1 + change if self.relative else np.float32(1))


def find_background(movie: Movie, circles: int = 1, watched: Mask | None = None) -> tuple[Background, Optics]:
    """Background and optics of a movie, from its first frames and some along it.

    ``watched`` (H, W) is what is looked at.

    Raises DataError: no frame can be read or shows a bubble.
    """
    leading, samples, numbers = _look(movie)
    first = leading[0].astype(np.float32)
    if not any(float(np.ptp(frame)) > 0 for frame in (*leading, *samples)):
        white = leading[0].dtype.kind in "ui" and leading[0].flat[0] == np.iinfo(leading[0].dtype).max
        words = "black" if not np.any(first) else "white" if white else "of one brightness"
        raise DataError(f"{movie.path}: every frame is {words}; no bubble can be seen")
    burnt = burnt_in(samples)
    unseen = burnt | margins(samples)
    nearest = tuple(ndimage.distance_transform_edt(unseen, return_distances=False, return_indices=True))
    drift = drift_of([frame[nearest] for frame in samples], numbers)  # what is burnt in does not drift
    if drift is not None:
        back = [np.negative(shift_at(drift, n)) for n in numbers]
        unseen = np.any([ndimage.shift(unseen, shift, order=0, cval=1) for shift in back], axis=0)  # by some frames
        leading = [np.roll(f, np.negative(shift_at(drift, n)), (0, 1)) for n, f in enumerate(leading)]
        samples = [np.roll(f, shift, (0, 1)) for f, shift in zip(samples, back, strict=True)]
    of_integers = samples[0].dtype.kind in "ui"  # frames of any floats, such as shares of the light, are as if of 8 bit
    leading = leading[(flashed := flashes_first(leading, samples)) :]
    first = leading[0].astype(np.float32)
    unit = 1.0 if of_integers else max(float(np.nanmax(np.abs(f))) for f in samples) / 255  # a grey level
    noise = pixel_noise(first, unit)
    low, high = np.transpose([(f.min(), f.max()) for f in (ndimage.uniform_filter(s, 5) for s in samples)])
    if low.min() < -max(SURE * noise, np.median(high)):
        raise DataError(
            f"{movie.path}: frames are negative where they are darkest, as where a background was subtracted; take "
            "those that the camera saved, or add to all the least number by which none is (ImageJ: Process > Math)"
        )
    blind = _writing(leading, noise) | _outside(samples) | unseen
    if watched is not None:
        blind |= ~watched
    empty = 0 if _begins_with_a_bubble(first, samples, noise, blind, unit) else _quiet(leading, first, noise, blind)
    of_empty = (_without_specks(leading[:empty], noise), np.zeros_like(blind)) if empty else None
    beside = of_empty or surface_beside_discs(samples, blind, unit)
    if beside is None:
        raise DataError(
            f"{movie.path}: no frame is empty, and beside any smooth background hardly anything has a round outline, "
            "as where the bubble covers nearly all of most frames; let the movie begin with an empty frame, or leave "
            "out with --region or --mask what is neither bubble nor background"
        )
    level, stands = beside
    blind |= stands
    for part, what in (stands, "stands still"), (burnt, "is burnt into the picture, as a scale bar,"):
        patches, sizes = labelled(part)
        middles = ndimage.center_of_mass(part, patches, range(1, len(sizes)))
        at = " and ".join(f"{x:.0f},{y:.0f}" for y, x in middles)
        movie.note(f"what {what} about {at} (x,y) in all frames is no bubble and is not looked at", at != "")
    if empty > 2:
        noise = pixel_noise(np.array([f - level for f in leading[:empty]]), unit) * (empty / (empty - 1)) ** 0.5
    background = _with_sign(level, samples, noise, empty and flashed + empty, blind, unit)
    if empty:
        background = _refined(background, samples)
    return replace(background, drift=drift), _optics(background, samples, movie, circles)


def _look(movie: Movie) -> tuple[list[Frame], list[Frame], range]:
    """The leading frames, and some along the movie with their numbers: every n-th, n doubled where there are many."""
    leading: list[Frame] = []
    samples: list[Frame] = []
    every = 1
    for number, frame in enumerate(movie.frames()):
        if number < LEADING:
            leading.append(frame)
        if number % every == 0:
            samples.append(frame)
            if len(samples) == 2 * SAMPLES:
                samples, every = samples[::2], 2 * every
    return leading, samples, range(0, every * len(samples), every)


def pixel_noise(image: Frame, unit: float = 1.0) -> float:
    """Std of the noise of an image (H, W): robust, of differences between neighbours. ``unit``: a grey level."""
    return max(1.4826 * float(np.median(np.abs(np.diff(image)))) / math.sqrt(2), 0.3 * unit)


def _outside(frames: Sequence[Frame]) -> Mask:
    """The outside of a field of view (H, W), such as a round aperture: dark in two corners of the frames at least, with
    an edge that stands still, beside which are always light and no wall that moves.
    """
    films = np.array(frames, dtype=np.float32)
    usual = ndimage.uniform_filter(np.median(films, axis=0), 5)
    bright = np.percentile(usual, FIELD)
    labels, _ = ndimage.label(usual < DIM * bright)
    corners = labels[[0, 0, -1, -1], [0, -1, 0, -1]]
    dark = np.isin(labels, corners[corners > 0])
    blurred, beside, further = (ndimage.binary_dilation(dark, iterations=n) for n in APERTURE)
    about, within = beside & ~blurred, further & ~beside
    if np.sum(corners > 0) < 2 or not within.any():
        return np.zeros_like(dark)
    each = ndimage.uniform_filter(films, (0, 5, 5))
    steady = np.mean((each.min(axis=0) > 0.5 * usual)[about])
    near = bright * np.median(each[:, within] / np.maximum(usual[within], 1e-6 * bright), axis=1)
    swings, shares = [], []
    edge = blurred & ~ndimage.binary_erosion(dark, iterations=APERTURE[0], border_value=1)
    for lamp in (np.percentile(each, FIELD, axis=(1, 2)), near):  # a bubble may cover the brightest, or what is near
        relative = (f[:, about] / np.maximum(lamp, 1e-6)[:, None] for f in (films, each))
        of_pixel, swing = (np.median(part.var(axis=0)) for part in relative)
        swings.append(swing - max(of_pixel - swing, 0.0) / 24)  # without the noise in a mean of 25 pixels
        shares.append(np.mean((each[:, edge] / np.maximum(lamp, 1e-6)[:, None]).var(axis=0) > MOVES**2))
    stands = steady > 1 - LIVELY and min(swings) < SWINGS**2 and min(shares) < LIVELY
    return np.asarray(blurred & stands)


def _lit_as(frame: Frame, other: Frame) -> Frame:
    """A frame (H, W) in the light of another, where their lamp's brightness differs no more than it flickers."""
    lamp = float(np.median(np.maximum(other, 1e-6) / np.maximum(frame, 1e-6)))
    return frame * (lamp if abs(math.log(lamp)) < LAMP else 1.0)


def _changed(frame: Frame, other: Frame, noise: float, side: int = 5) -> Mask:
    """Where two frames differ by more than noise, in means over squares, whatever the lamp does (H, W)."""
    off = ndimage.uniform_filter(frame - _lit_as(other, frame), side)
    return np.asarray(np.abs(off) > max(7 * noise / side, 0.06 * float(np.median(other))))


def _writing(leading: Sequence[Frame], noise: float) -> Mask:
    """Where something low changes all the time (H, W), brighter here and darker there at once: time stamps."""
    none = np.zeros(leading[0].shape, dtype=bool)
    if len(leading) <= LEAST_PAIRS:
        return none
    frames = [frame.astype(np.float32) for frame in leading]
    changes = [_changed(b, a, noise, 3) for a, b in pairwise(frames)]
    often = np.mean(changes, axis=0) > RESTLESS
    height, across, down = WRITING
    labels, _ = ndimage.label(ndimage.binary_dilation(often, np.ones((3, across))))
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        rows, columns = np.nonzero(often[box] & (labels[box] == number))
        born_later = not changes[0][box].any()  # a bubble; a time stamp runs from the first frame on
        shown = np.ptp(np.percentile([f[box][rows, columns] for f in frames], MOST, axis=1), axis=0)
        blank = shown.min() < BLANK * shown.max()  # a bubble before or when larger; a stamp always shows
        if np.ptp(rows) + 1 > height or born_later or blank or _one_way(frames, changes, box):
            continue
        top, left = box[0].start + rows.min() - down, box[1].start + columns.min() - across
        none[max(top, 0) : box[0].start + rows.max() + down + 1,
             max(left, 0) : box[1].start + columns.max() + across + 1] = True  # fmt: skip
    return none


def _one_way(frames: Sequence[Frame], changes: Sequence[Frame], box: tuple[slice, slice]) -> bool:
    """True if, from frame to frame, all that changes becomes darker or all becomes brighter, as about a bubble."""
    mixed: list[float] = []
    for (a, b), changed in zip(pairwise(frames), changes, strict=True):
        step = (b[box] - a[box])[changed[box]]
        if len(step):
            mixed.append(float(min(np.mean(step > 0), np.mean(step < 0))))
    return float(np.median(mixed or [0.0])) < 0.15


def _begins_with_a_bubble(first: Frame, samples: Sequence[Frame], noise: float, blind: Mask, unit: float) -> bool:
    """True if the first frame has edges, or a shade over most of its border, that most frames lack; or if it differs
    from a smooth surface in large patches whose rims other frames show elsewhere.
    """
    lit = [_lit_as(frame.astype(np.float32), first) for frame in samples]
    changed = np.array([_changed(frame, first, noise) & ~blind for frame in lit])
    border = ~blind & ~ndimage.binary_erosion(np.ones_like(blind), iterations=BESIDE)
    bared = [np.sum((c & (f > first))[border]) / max(np.sum(border), 1) for f, c in zip(lit, changed, strict=True)]
    shares = [s for f, c in zip(lit, changed, strict=True) if (s := _edges_of_first(first, f, c, noise)) is not None]
    if np.median(bared) > 0.5 or np.median(shares or [0.0]) > FIRST:
        return True
    surface = smooth_surface([first], blind, unit)
    usual = float(np.median(np.abs(surface[~blind])))
    far = np.abs(ndimage.uniform_filter(first - surface, 5)) > max(4 * noise, 0.25 * usual)
    labels, sizes = labelled(far & ~blind)
    large = [n for n in range(1, len(sizes)) if sizes[n] > max(BLOB, 2e-4 * first.size) and is_round(labels == n)]
    if not large:
        return False
    if not changed.any():
        return True  # nothing moves in the movie: what is there must be the bubble
    moved = changed.mean(axis=0) > OFTEN
    patches = np.isin(labels, large)
    edge = ndimage.binary_dilation(patches, iterations=2) & ~ndimage.binary_erosion(patches, iterations=2)
    return bool(np.mean(moved[edge]) > LIVELY)


def _edges_of_first(first: Frame, frame: Frame, changed: Mask, noise: float) -> float | None:
    """The share of the edges about what changed in a frame (H, W) that the first frame shows, 1/2 of a disc that shrank
    a little; None where nothing large changed. In logarithms: a shade that falls on structure adds none of it.
    """
    labels, sizes = labelled(changed)
    large = np.isin(labels, np.flatnonzero(sizes > max(BLOB, 2e-4 * first.size)))
    inner = ndimage.binary_erosion(large, iterations=BESIDE, border_value=1)
    about = ndimage.binary_dilation(large, iterations=BESIDE) & ~inner
    if not about.any():
        return None
    smooth = [np.maximum(ndimage.gaussian_filter(image, EDGE), noise) for image in (first, frame)]
    before, after = (np.array(np.gradient(np.log(image)))[:, about] for image in smooth)
    own, other = (np.sum((noise / image[about]) ** 2) / (4 * np.pi * EDGE**4) for image in smooth)  # by noise alone
    change = after - before
    return -float(np.sum(change * before) + own) / max(float(np.sum(change**2) - own - other), float(own + other))


def _quiet(leading: Sequence[Frame], first: Frame, noise: float, blind: Mask) -> int:
    """How many leading frames look like the first; most of those after them show the shade in a bubble's middle."""
    for number, frame in enumerate(leading):
        labels, sizes = labelled(_changed(frame.astype(np.float32), first, noise) & ~blind)
        if sizes.max() > SPECK:  # larger than dirt that drifts
            y, x = np.mean(np.nonzero(labels == np.argmax(sizes)), axis=1).round().astype(int)
            middle = np.s_[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            frames = (_lit_as(f.astype(np.float32), first) for f in leading[: number + 1])
            shade = np.array([float(np.mean((f - first)[middle])) for f in frames])
            begun = shade * np.sign(shade[-1]) > max(BEGUN * abs(shade[-1]), SURE * noise)
            return min((n for n in range(1, number) if begun[n] and np.mean(begun[n:number]) > 0.5), default=number)
    return len(leading)


def _without_specks(empty: Sequence[Frame], noise: float) -> Array:
    """Mean (H, W) of empty frames, in their mean light, without what few of them show, such as dirt that drifts."""
    mean = np.mean(np.array(empty, dtype=np.float32), axis=0)
    frames = np.array([_lit_as(frame.astype(np.float32), mean) for frame in empty])
    off = frames - np.median(frames, axis=0)
    kept = np.abs(ndimage.uniform_filter(off, (0, 3, 3))) < DRIFTS * noise
    return np.asarray(np.mean(frames, axis=0, where=kept | ~kept.any(axis=0)), dtype=np.float32)


def _with_sign(
    level: Array, samples: Sequence[Frame], noise: float, empty: int, blind: Mask, unit: float
) -> Background:
    """Dark on bright, relative to the background; or bright on dark, as it is: by what differs most in most frames, of
    which what is bright within what is dark is a bubble's middle.
    """
    votes = []
    for frame in samples:
        off = np.where(blind, np.float32(0), _lit_as(frame, level) - level)
        least, most = np.percentile(off[~blind], (0.5, 99.5))
        within = ndimage.binary_fill_holes(off < least / 2)[off > most / 2]
        middle = -least > max(4 * noise, MIDDLE * most) and np.sum(within) > 0.5 * len(within)
        votes.append(float(least if middle else least + most))
    if float(np.median([v for v in votes if abs(v) > 4 * noise] or [-1.0])) > 0:
        full = max(float(np.median([np.percentile(f - level, 99.5) for f in samples])), unit)
        gain = np.full_like(level, -1.0 / full)
        return Background(level, np.where(blind, np.float32(np.nan), gain), noise / full, empty, relative=False)
    nearest = tuple(ndimage.distance_transform_edt(blind, return_distances=False, return_indices=True))
    lit = ndimage.median_filter(level[nearest], HALO)  # what is not looked at tells nothing of the light beside it
    smooth = ndimage.gaussian_filter(lit, SMOOTH)  # the light itself, without dirt
    smooth = np.maximum(smooth, max(float(np.median(smooth)) * 0.05, unit))
    if empty:  # what stands still is in the level, and a bubble takes its share of that light
        sharp = ndimage.gaussian_filter(level, 1.0)
        full = np.iinfo(samples[0].dtype).max if samples[0].dtype.kind in "ui" else np.inf
        blind = blind | (level < DEAD * smooth) | ((level > 0.99 * full) & (level > (1 + STRUCTURE) * smooth))
        smooth = np.where(np.abs(sharp / smooth - 1) > STRUCTURE, np.maximum(sharp, DEAD * smooth), smooth)
    gain = np.where(blind, np.nan, 1 / smooth).astype(np.float32)
    return Background(level, gain, noise * float(np.nanmedian(gain)), empty)


def _refined(background: Background, samples: Sequence[Frame]) -> Background:
    """The background's level with the parts of later frames that lie outside the bubble: less noise.

    What is left of it, all frames of a bubble at rest would share: where a square of the level scatters no more than
    its noise does, it is its mean (Lee's filter, IEEE Trans. Pattern Anal. Mach. Intell. 2, 165, 1980).
    """
    total = background.level * background.frames
    count = np.full(total.shape, float(background.frames), dtype=np.float32)
    for _, image, places in _steadied(background, samples):
        near = ndimage.uniform_filter(image, HALO)  # the halo of a light is no background
        quiet = (np.abs(image) < 5 * background.noise) & (np.abs(near) < max(5 * background.noise / HALO, STILL))
        for circle, _ in places:
            quiet &= circle.off(quiet.shape) > 0.3 * circle.R + 10
        total[quiet] += (background.level + image / background.gain)[quiet]  # at the lamp's brightness of the level
        count[quiet] += 1
    level = total / count
    mean = ndimage.uniform_filter(level, HALO)
    own = SURELY * np.nan_to_num(background.noise / background.gain) ** 2 / count
    share = np.clip(1 - own / np.maximum(ndimage.uniform_filter((level - mean) ** 2, HALO), 1e-30), 0, 1)
    return replace(background, level=(mean + share * (level - mean)).astype(np.float32))


def _steadied(
    background: Background, samples: Sequence[Frame]
) -> Iterator[tuple[Frame, Array, list[tuple[Circle, float]]]]:
    """Frames that show a circle, and no flash, the image of each in the light of the level, and the circles."""
    for frame in samples:
        image, tiles = background.normalised(frame)
        places = locate(tiles, background.noise / TILE)
        if places and share_changed(tiles, background.noise) <= CHANGED:
            yield frame, background.steadied(image, tiles, places[0][0], -places[0][1]), places


def share_changed(tiles: Array, noise: float) -> float:
    """The share of tiles much brighter than the background, as those of a flash."""
    return float(np.mean(tiles > max(4 * noise, BRIGHT)))


def _optics(background: Background, samples: Sequence[Frame], movie: Movie, circles: int) -> Optics:
    """What the sampled frames say of contrast, sharpness and rim. Raises :class:`DataError` where none has a bubble."""
    shown: list[tuple[Frame, Outline]] = []
    clipped: list[float] = []
    full = saturated(samples)
    for frame, image, ((place, contrast), *_) in _steadied(background, samples):
        outlines = fit_outline(image, place, Optics(-contrast), circles)
        if outlines is not None and outlines[0].seen > 0.15 and outlines[0].contrast < 0:
            shown.append((image, outlines[0]))
            clipped.append(float(np.mean(frame[np.abs(outlines[0].circle.off(frame.shape)) < AROUND] > full)))
    if not shown:
        raise DataError(
            f"{movie.path}: no frame shows a bubble that differs from the background; where the frames show more than "
            "the field about it, such as a holder or a screen, leave that out with --region or --mask"
        )
    optics = _shared([o for _, o in shown], background.noise)
    clearest = sorted(shown, key=lambda of: -of[1].seen * of[1].circle.R / of[1].width)[:TELLING]
    rim, rim_std = (tuple(float(optics.width * n) for n in of) for of in (ANY_RIM, ANY_RIM_STD))
    rims = _again(clearest, replace(optics, differs=FREE, rim=rim, rim_std=rim_std), circles)
    values = np.array([o.rim for o in rims]).reshape(-1, 3)
    heights = values[:, 0] * DENSITY / np.hypot([o.width for o in rims], values[:, 2])
    if rims and np.median(heights) - _scatter(heights) >= THRESHOLD:
        rim, rim_std = tuple(np.median(values, axis=0)), tuple(_scatter(values))
        if rimmed := _again(shown, replace(optics, differs=FREE, rim=rim, rim_std=rim_std), circles):
            optics = replace(_shared(rimmed, background.noise), rim=rim, rim_std=rim_std)
    grey = float(np.nanmedian(np.abs(1 / background.gain)))
    return with_hidden(optics, samples, float(np.median(clipped)), grey)


def _again(shown: Sequence[tuple[Frame, Outline]], optics: Optics, circles: int) -> list[Outline]:
    fitted = [fit_outline(image, outline.circle, optics, circles) for image, outline in shown]
    return [outlines[0] for outlines in fitted if outlines is not None]


def _scatter(values: Array) -> Array:
    """Robust std of values (K, …) over K."""
    return np.asarray(1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0))


def _shared(outlines: Sequence[Outline], noise: float) -> Optics:
    """Contrast and sharpness that outlines share."""
    contrasts = np.array([o.contrast for o in outlines])
    clear = np.array([o.circle.R / o.width for o in outlines])
    weights = np.minimum(clear, np.percentile(clear, LARGE)) ** FULL
    weights /= weights.sum()
    order = np.argsort(contrasts)
    contrast = float(contrasts[order][np.searchsorted(np.cumsum(weights[order]), 0.5)])
    spread = float(np.sqrt(weights @ (contrasts - contrast) ** 2))
    scatter = 1.2533 * spread / max(1 / float(weights @ weights) - 1, 1) ** 0.5  # of a median
    scatter = min(scatter, NOISY * noise)  # more is not noise: bubbles differ in how bright their centre is
    clearest = CLEAR * min(o.variance * o.ratio for o in outlines)
    width = float(np.percentile([o.width for o in outlines if o.variance * o.ratio <= clearest], SHARPEST))
    optics = Optics(contrast, width, max(scatter / -contrast, LEAST_SPREAD), noise=noise)
    telling = np.array([tells_contrast(o.circle.R, o.width, o.noise, optics) for o in outlines])
    if telling.sum() >= LEAST_TELLING:  # what those differ by beside noise, bubbles do
        differ = 1.4826 * float(np.median(np.abs(contrasts[telling] - contrast)))
        differs = max(differ**2 - (2 * NOISY * noise) ** 2, 0.0) ** 0.5 / -contrast
        optics = replace(optics, differs=differs, even=True)
    return optics
