"""Bubbles in one image: where they may be, roughly, and the outline of one, a circle, its modes, what is known."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Array, Indices, Mask

MODES = 6  # of the outline
TILE = 2  # pixels are averaged over tiles of this side
LEAST_TILES = 6  # tiles of a patch
MOST_PATCHES = 4  # patches of a frame
THRESHOLD = 0.05  # of the contrast: what the level of the edge can be off by in all frames alike
LEAST_CONTRAST = 0.08  # of the background's brightness


@dataclass(frozen=True)
class Circle:
    """A circle in pixels; the centre of the first pixel is (0, 0)."""

    x: float
    y: float
    R: float

    def off(self, shape: tuple[int, ...]) -> Array:
        """How far the pixels of an image (H, W) lie outside the circle, negative inside."""
        squares = np.add.outer((np.arange(shape[0]) - self.y) ** 2, (np.arange(shape[1]) - self.x) ** 2)
        return np.asarray(np.sqrt(squares) - self.R)


@dataclass(frozen=True)
class Optics:
    """Optical properties that the frames of a movie share: contrast of a bubble against its background, width of a
    sharp edge (pixels).

    ``spread`` is how well the contrast is known, as a share of it: 1 where it is not; ``differs`` the share by which
    that of a frame differs from it, ``noise`` the std of a pixel, and ``even`` that bubbles are evenly dark, so that a
    frame may tell a contrast of its own. ``rim`` is that of :mod:`en4dvar_movie.kernels`: light, distance and width in
    pixels, () without a rim, and ``rim_std`` how well a frame's are known. ``hidden`` is by how many pixels all edges
    may be off where grey levels tell little of the light, as ``hides`` says.
    """

    contrast: float
    width: float = 2.0
    spread: float = 1.0
    differs: float = 0.0
    noise: float = 0.0
    even: bool = False
    rim: tuple[float, ...] = ()
    rim_std: tuple[float, ...] = ()
    hidden: float = 0.0
    hides: str = ""


@dataclass(frozen=True)
class Outline:
    """The outline of a bubble in one image; pixels.

    ``width`` is the std of the edge's blur, ``modes`` (2, M−1) are A_n and B_n, ``variance`` that of R if pixels were
    independent and ``ratio`` what sectors of the outline say in units of it, ``common`` the variance that comes from
    the contrast of the movie; ``mode_std`` is the std of a mode's amplitude. ``seen`` is the share of the
    outline that can be seen. ``rows`` is by how much even rows show a larger bubble than odd ones, ``rows_std`` what
    noise makes of it. ``joined`` is the std for nested circles that lie too close to be told apart, which all
    have their mean radius. ``oval`` is the outline of which mode 2 is fitted too, where the frame
    cuts it, and ``better`` by how much its −log likelihood is less.
    """

    circle: Circle
    width: float
    contrast: float
    noise: float
    modes: Array
    variance: float
    ratio: float
    common: float
    mode_std: float
    seen: float
    rows: float = 0.0
    rows_std: float = 1.0
    joined: float = 0.0
    rim: tuple[float, ...] = ()
    oval: "Outline | None" = None
    better: float = 0.0

    def amplitude(self, n: int) -> float:
        """Amplitude of mode n, in pixels; NaN where it was not fitted."""
        return float(np.hypot(*self.modes[:, n - 2])) if n - 2 < self.modes.shape[1] else float("nan")

    @property
    def angle(self) -> float:
        """From the x axis towards the y axis to the long axis of mode 2, within ±90 degrees; NaN where not fitted."""
        return float(np.rad2deg(np.arctan2(*self.modes[::-1, 0]) / 2)) if self.modes.shape[1] else float("nan")

    @property
    def eccentricity(self) -> float:
        """That of the ellipse of mode 2; NaN where it was not fitted."""
        part = self.amplitude(2) / self.circle.R
        if not part < 1:
            return float("nan")
        return float(np.sqrt(1 - ((1 - part) / (1 + part)) ** 2))

    def points(self, angles: Array) -> Array:
        """Points (K, 2) of the outline, x and y, at angles (K,)."""
        n = np.arange(2, 2 + self.modes.shape[1])[:, None]
        rho = self.circle.R + self.modes[0] @ np.cos(n * angles) + self.modes[1] @ np.sin(n * angles)
        return np.stack([self.circle.x + rho * np.cos(angles), self.circle.y + rho * np.sin(angles)], axis=1)


def share_inside(image: Array, circle: Circle) -> float:
    """How much of a circle lies inside a frame (H, W), where it is not NaN."""
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    x, y = circle.x + circle.R * np.cos(angles), circle.y + circle.R * np.sin(angles)
    inside = (x >= 0) & (x <= image.shape[1] - 1) & (y >= 0) & (y <= image.shape[0] - 1)
    at = np.rint(y[inside]).astype(int), np.rint(x[inside]).astype(int)
    return float(np.sum(~np.isnan(image[at]))) / len(angles)


def locate(tiles: Array, noise: float) -> list[tuple[Circle, float]]:
    """Circles in pixels near the outlines of what may be bubbles, and the contrast inside; the largest patch first.

    ``tiles`` (h, w) are zero on the background and negative in a bubble; ``noise`` is the std of a tile.
    """
    smooth = ndimage.uniform_filter(tiles, 3, mode="nearest")
    labels, sizes = labelled(smooth < -max(5 * noise / 3, LEAST_CONTRAST))
    largest = np.argsort(-sizes, kind="stable")[:MOST_PATCHES]
    boxes = ndimage.find_objects(labels) if sizes[largest[:1]].sum() else []
    shift = (TILE - 1) / 2
    result = []
    for label in largest[sizes[largest] >= LEAST_TILES]:
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


def labelled(mask: Mask) -> tuple[Any, Indices]:
    """The connected patches of a mask, and the size of each by its number; 0 of what belongs to none."""
    labels, _ = ndimage.label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels, sizes


def rim(inside: Mask) -> Array:
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
