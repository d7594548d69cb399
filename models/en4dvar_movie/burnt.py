"""What programs have added to the frames of a camera: scale bars, and margins about the picture."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Mask
from en4dvar_movie.frames import Frame
from en4dvar_movie.outline import labelled
from en4dvar_movie.surfaces import is_round

WHITE, SMALL, SHARP = 0.95, 0.1, 0.15  # of the brightest, and of a frame: what is burnt in; of its step: what is blur
BURNT = ((0, 1), (3, 6), 2)  # pixels from it: where no lens shows a step, where the light is its own, what is left out
STEP = 0.1  # of the light about it: by how much brighter what is burnt in is
SAME, MOSTLY = 0.05, 0.5  # of the brightest: what margins vary by; share of the first row beside them that differs


def burnt_in(frames: Sequence[Frame]) -> Mask:
    """What is written into all frames (H, W), such as a scale bar: white, and sharper than a lens shows anything, and
    apart from the frame's border, from which overexposed needles and walls come.
    """
    films = np.array(frames, dtype=np.float32)
    top = films.max()
    white: Mask = films.min(axis=0) > WHITE * top
    if not white.any():
        return white
    usual = np.median(films, axis=0)
    labels, sizes = labelled(ndimage.binary_dilation(white, np.ones((3, 3))))
    rim = np.pad(np.zeros(np.subtract(white.shape, 2), dtype=bool), 1, constant_values=True)
    inside = ~np.isin(np.arange(1, len(sizes)), labels[rim & white])
    off, nearest = ndimage.distance_transform_edt(~white, return_indices=True)
    of, numbers = labels[tuple(nearest)], np.arange(1, len(sizes))
    *rings, about = BURNT
    beside, light = (ndimage.median(usual, of * ((off > a) & (off <= b)), numbers) for a, b in rings)
    sharp = (top > (1 + STEP) * light) & (beside - light < SHARP * (top - light))
    sharp &= inside & (sizes[1:] < SMALL * white.size)
    return np.asarray(np.isin(of, [n for n in numbers[sharp] if not is_round(labels == n)]) & (off <= about))


def margins(frames: Sequence[Frame]) -> Mask:
    """Rows and columns of one brightness that stand about the picture in all frames (H, W), as a canvas does."""
    films = np.array(frames, dtype=np.float32)
    added, may_vary = np.zeros(films.shape[1:], dtype=bool), SAME * films.max()
    for turn in range(4):  # each side as the upper one
        turned = np.rot90(films, turn, (1, 2))
        if np.ptp(turned[:, 0]) > may_vary:
            continue
        other = np.mean(np.abs(turned - turned[0, 0, 0]) > may_vary, axis=2).T  # of each row and frame
        rows = int(np.argmax(other.any(axis=1)))
        if rows and other[rows].min() > MOSTLY:
            np.rot90(added, turn)[: rows + BURNT[2]] = True
    return added
