"""A camera that drifts over a background with structure: by how many pixels frames along a movie show it elsewhere."""

from collections.abc import Sequence

import numpy as np
from scipy import fft, ndimage

from en4dvar.model.state import Array
from en4dvar_movie.frames import Frame

FINE, COARSE = 1.0, 8.0  # std in pixels of the blur below and beyond which structure is not compared
CLIPPED = 3.0  # median differences: what an edge of a bubble, or its shade, counts as at most
ALIKE = 0.85  # of the median difference that is left where a shift is one
OFTEN = 0.25  # of the frames: in how many it is
FEW = 6  # frames that show whether all are to be compared
UNEVEN = 2.0  # pixels that a shift may lie off those of the frames about it


def drift_of(frames: Sequence[Frame], numbers: Sequence[int]) -> Array | None:
    """Number of a frame, pixels down and pixels across (K, 3) that it shows the first one's background elsewhere.

    None where most frames fit the first as they are. By the peak of the correlation with the first frame, after
    Kuglin and Hines, Proc. IEEE Int. Conf. Cybernetics and Society, 163 (1975), of structure of a few pixels; such a
    shift must leave less of the difference in most pixels, which that of a bubble before a still background does not.
    """
    every = -(-len(frames) // FEW)
    if every > 1 and drift_of(frames[::every], numbers[::every]) is None:
        return None
    first, *others = [_structure(frame) for frame in frames]
    spectrum = np.conj(fft.rfft2(_clipped(first)))
    shifts, moved = [(numbers[0], 0, 0)], 0
    for number, image in zip(numbers[1:], others, strict=True):
        peak = np.argmax(fft.irfft2(fft.rfft2(_clipped(image)) * spectrum, first.shape))
        down, across = (
            int(at) - side * (at > side // 2)
            for at, side in zip(np.unravel_index(peak, first.shape), first.shape, strict=True)
        )
        there = np.median(np.abs(np.roll(image, (-down, -across), (0, 1)) - first))
        if (down or across) and there > ALIKE * np.median(np.abs(image - first)):
            continue  # of no shift that is sure
        shifts.append((number, down, across))
        moved += bool(down or across)
    drift = np.array(shifts, dtype=float)
    if not moved or moved < OFTEN * len(others):
        return None
    between = [np.interp(drift[1:-1, 0], drift[::2, 0], drift[::2, k]) for k in (1, 2)]
    uneven = np.max(np.abs(np.transpose(between) - drift[1:-1, 1:]), initial=0) > UNEVEN
    far = np.any(np.ptp(drift[:, 1:], axis=0) > np.array(first.shape) / 2)
    return None if uneven or far else drift


def shift_at(drift: Array, number: int) -> tuple[int, int]:
    """Pixels down and across by which a frame is shifted, also beyond the last one that was compared."""
    down, across = (
        float(np.interp(number, drift[:, 0], drift[:, k]))
        + max(number - drift[-1, 0], 0.0) * (drift[-1, k] - drift[0, k]) / (drift[-1, 0] - drift[0, 0])
        for k in (1, 2)
    )
    return round(down), round(across)


def _structure(frame: Frame) -> Array:
    image = frame.astype(np.float32)
    return np.asarray(ndimage.gaussian_filter(image, FINE) - ndimage.gaussian_filter(image, COARSE))


def _clipped(image: Array) -> Array:
    most = CLIPPED * float(np.median(np.abs(image)))
    return np.clip(image, -most, most)
