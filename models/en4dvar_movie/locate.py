"""Where bubbles may be, roughly: the patches that differ from the background, and a circle through the rim of each."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from en4dvar.model.state import Array
from en4dvar_movie.outline import Circle

TILE = 2  # pixels are averaged over tiles of this side
LEAST = 6  # tiles of a patch
MOST = 4  # patches of a frame
LEAST_CONTRAST = 0.08  # of the background's brightness


def locate(tiles: Array, noise: float) -> list[tuple[Circle, float]]:
    """Circles in pixels near the outlines of what may be bubbles, and the contrast inside; the largest patch first.

    ``tiles`` (h, w) are zero on the background and negative in a bubble; ``noise`` is the std of a tile.
    """
    smooth = ndimage.uniform_filter(tiles, 3, mode="nearest")
    labels, sizes = labelled(smooth < -max(5 * noise / 3, LEAST_CONTRAST))
    largest = np.argsort(-sizes, kind="stable")[:MOST]
    boxes = ndimage.find_objects(labels) if sizes[largest[:1]].sum() else []
    shift = (TILE - 1) / 2
    result = []
    for label in largest[sizes[largest] >= LEAST]:
        box = boxes[label - 1]
        inside = labels[box] == label
        contrast = -float(np.percentile(smooth[box][inside], 10))
        cores, core_sizes = labelled(inside & (smooth[box] < -0.5 * contrast))
        whole = np.zeros(tiles.shape, dtype=bool)
        whole[box] = cores == int(np.argmax(core_sizes))
        circle = circle_through(rim(whole))
        if circle is not None:
            result.append((Circle(TILE * circle.x + shift, TILE * circle.y + shift, TILE * circle.R), contrast))
    return result


def labelled(mask: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[np.intp]]:
    """The connected patches of a mask, and the size of each by its number; 0 of what belongs to none."""
    labels, _ = ndimage.label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels, sizes


def rim(inside: npt.NDArray[Any]) -> Array:
    """Outermost points (K, 2), x and y, of each row and column of a patch, without those on the frame's border."""
    points = []
    for part in (inside, inside.T):
        lines, last = np.flatnonzero(part.any(axis=1)), part.shape[1] - 1
        first, end = part.argmax(axis=1)[lines], last - part[:, ::-1].argmax(axis=1)[lines]
        points += [np.stack([first - 0.5, lines], axis=1)[first > 0], np.stack([end + 0.5, lines], axis=1)[end < last]]
    return np.concatenate([*points[:2], *(of_columns[:, ::-1] for of_columns in points[2:])])


def circle_through(points: Array) -> Circle | None:
    """Kåsa's circle through points (K, 2), those far off left out by turns; None with too few."""
    kept = points
    circle = None
    for _ in range(6):
        if len(kept) < 6:
            return circle
        middle = kept.mean(axis=0)  # about which the sums of squares lose no digits
        x, y = (kept - middle).T
        matrix = np.stack([x, y, np.ones(len(x))])
        try:
            a, b, c = np.linalg.solve(matrix @ matrix.T, matrix @ (x * x + y * y))
        except np.linalg.LinAlgError:  # all on one line
            return circle
        square = c + (a * a + b * b) / 4
        if square <= 0:
            return circle
        circle = Circle(float(a / 2 + middle[0]), float(b / 2 + middle[1]), float(np.sqrt(square)))
        off = np.abs(np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) - circle.R)
        kept = points[off <= max(2.5 * float(np.median(off)), 0.75)]
    return circle
