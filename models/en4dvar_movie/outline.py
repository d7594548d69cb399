"""The outline of a bubble in one image: a circle, its modes, what is known of the radius."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array

MODES = 6  # of the outline


@dataclass(frozen=True)
class Circle:
    """A circle in pixels; the centre of the first pixel is (0, 0)."""

    x: float
    y: float
    R: float


@dataclass(frozen=True)
class Optics:
    """Optical properties that the frames of a movie share: contrast of a bubble against its background, width of a
    sharp edge (pixels).

    ``spread`` is how well the contrast is known, as a share of it: 1 where it is not.
    """

    contrast: float
    width: float = 2.0
    spread: float = 1.0


@dataclass(frozen=True)
class Outline:
    """The outline of a bubble in one image; pixels.

    ``width`` is the std of the edge's blur, ``modes`` (2, M−1) are A_n and B_n, ``variance`` that of R if pixels were
    independent and ``ratio`` what sectors of the outline say in units of it, ``common`` the variance that comes from
    the contrast of the movie; ``mode_std`` is the std of a mode's amplitude. ``seen`` is the share of the
    outline inside the frame. ``rows`` is by how much even rows show a larger bubble than odd ones, ``rows_std`` what
    noise makes of it. ``joined`` is the std for nested circles that lie too close to be told apart, which all
    have their mean radius.
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


def share_inside(shape: tuple[int, ...], circle: Circle) -> float:
    """How much of a circle lies inside a frame (H, W)."""
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    x, y = circle.x + circle.R * np.cos(angles), circle.y + circle.R * np.sin(angles)
    return float(np.mean((x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1)))
