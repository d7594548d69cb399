"""Where the bubble is, roughly: the largest patch that differs from the background, and a circle through its rim."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Array
from en4dvar_movie.outline import Circle

TILE = 2  # pixels are averaged over tiles of this side
LEAST = 6  # tiles of a patch


def patch(tiles: Array, noise: float, least_contrast: float) -> tuple[Array, float] | None:
    """The largest patch (H, W) of tiles darker than the background, and its contrast; None without any.

    ``tiles`` are zero on the background and negative in a bubble; ``noise`` is the std of a tile.
    """
    smooth = ndimage.uniform_filter(tiles, 3, mode="nearest")
    floor = max(5 * noise / 3, least_contrast)
    labels, count = ndimage.label(smooth < -floor)
    if not count:
        return None
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    largest = int(np.argmax(sizes))
    if sizes[largest] < LEAST:
        return None
    inside = labels == largest
    contrast = -float(np.percentile(smooth[inside], 10))
    core = inside & (smooth < -0.5 * contrast)
    labels, count = ndimage.label(core)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(np.argmax(sizes)), contrast


def rim(inside: Array) -> Array:
    """Outermost points (K, 2), x and y, of each row and column of a patch, without those on the frame's border."""
    height, width = inside.shape
    points = []
    rows = np.flatnonzero(inside.any(axis=1))
    left, right = inside.argmax(axis=1)[rows], width - 1 - inside[:, ::-1].argmax(axis=1)[rows]
    columns = np.flatnonzero(inside.any(axis=0))
    top, bottom = inside.argmax(axis=0)[columns], height - 1 - inside[::-1].argmax(axis=0)[columns]
    points = [
        *((x - 0.5, y) for x, y in zip(left, rows, strict=True) if x > 0),
        *((x + 0.5, y) for x, y in zip(right, rows, strict=True) if x < width - 1),
        *((x, y - 0.5) for x, y in zip(columns, top, strict=True) if y > 0),
        *((x, y + 0.5) for x, y in zip(columns, bottom, strict=True) if y < height - 1),
    ]
    return np.array(points, dtype=float).reshape(-1, 2)


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


def locate(tiles: Array, noise: float, least_contrast: float) -> tuple[Circle, float] | None:
    """A circle in pixels near the bubble's outline and the contrast inside; None where there is no patch."""
    bubble = patch(tiles, noise, least_contrast)
    if bubble is None:
        return None
    inside, contrast = bubble
    circle = circle_through(rim(inside))
    if circle is None:
        return None
    shift = (TILE - 1) / 2
    return Circle(TILE * circle.x + shift, TILE * circle.y + shift, TILE * circle.R), contrast
