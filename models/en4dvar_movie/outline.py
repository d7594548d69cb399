"""The outline of a bubble in one image: a blurred edge fitted to every pixel near it, robustly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from en4dvar.state import Array
from en4dvar_movie.kernels import NAMES, SHAPE, influence, normal_equations, residuals

MODES = 6  # of the outline
ROUNDS = 30
RIM_SHARE = 0.45  # of the radius: where the bright centre ends, before it is fitted
LEVEL_SPREAD = 0.001  # of the background next to the bubble, in contrasts: halos are not the level of the background
FIRST_SPREAD = (0.03, 0.0, 0.0)  # of the contrast in the first turns
LOOSE = 0.1  # how much less is known of the level next to an edge that is blurred
CUTOFF = 5.0  # of Tukey's weights, in robust std
REACH = 4.0  # how far from the outline pixels are used, in widths of the edge
X, Y, R, W, LEVEL, CONTRAST, GLARE, RIM = range(SHAPE)


@dataclass(frozen=True)
class Circle:
    """A circle in pixels; the centre of the first pixel is (0, 0)."""

    x: float
    y: float
    R: float


@dataclass(frozen=True)
class Optics:
    """What the frames of one movie share: contrast of a bubble against its background, width of a sharp edge (pixels).

    ``spread`` is how well the contrast is known, as a share of it: 1 where it is not.
    """

    contrast: float
    width: float = 2.0
    spread: float = 1.0


@dataclass(frozen=True)
class Outline:
    """What one image says; pixels.

    ``width`` is the std of the edge's blur, ``modes`` (2, M−1) are A_n and B_n, ``variance`` that of R if pixels were
    independent and ``ratio`` what sectors of the outline say in units of it, ``common`` the variance that comes from
    the contrast of the movie; ``mode_std`` is the std of a mode's amplitude. ``seen`` is the share of the
    outline inside the frame.
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

    def amplitude(self, n: int) -> float:
        """Of mode n, in pixels; NaN where it was not fitted."""
        return float(np.hypot(*self.modes[:, n - 2])) if n - 2 < self.modes.shape[1] else float("nan")

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


def fit_outline(image: Array, start: Circle, optics: Optics) -> Outline | None:
    """The outline near ``start`` in an image (H, W) whose background is zero; None where nothing fits."""
    p = np.zeros(SHAPE)
    p[[X, Y, R, W, CONTRAST, RIM]] = start.x, start.y, start.R, optics.width, optics.contrast, RIM_SHARE * start.R
    noise = abs(optics.contrast)
    modes = 1
    for turn in range(3):  # the ring of pixels follows the circle; the cutoff follows the noise
        ring = _ring(p)
        if _glare_is_far(p, ring):
            p[GLARE], p[RIM] = 0.0, RIM_SHARE * p[R]
        modes = modes_for(image.shape, p)
        p = np.concatenate([p[:SHAPE], np.zeros(2 * (modes - 1))])
        fitted = _descend(image, p, modes, ring, noise, replace(optics, spread=max(optics.spread, FIRST_SPREAD[turn])))
        if fitted is None:
            return None
        p = fitted
        noise = max(1.4826 * float(np.median(np.abs(residuals(image, p, modes, ring)))), 1e-6)
    return _outline(image, p, modes, _ring(p), noise, optics)


def modes_for(shape: tuple[int, ...], p: Array) -> int:
    """The highest mode that a circle of this size shows: none where the frame cuts it."""
    if share_inside(shape, Circle(*p[:3])) < 0.9:
        return 1
    return int(np.clip(p[R] / 4.0, 2, MODES))


def share_inside(shape: tuple[int, ...], circle: Circle) -> float:
    """How much of a circle lies inside a frame (H, W)."""
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    x, y = circle.x + circle.R * np.cos(angles), circle.y + circle.R * np.sin(angles)
    return float(np.mean((x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1)))


def _ring(p: Array) -> Array:
    reach = max(REACH * p[W], 6.0)
    return np.array([p[X], p[Y], max(0.0, p[R] - reach), p[R] + reach])


def _glare_is_far(p: Array, ring: Array) -> bool:
    return bool(ring[2] > 0.75 * p[R])


def _known(p: Array, ring: Array, noise: float, optics: Optics) -> tuple[Array, Array]:
    """Of what is known before: contrast; the bright centre, which may be missing. Centre (P,) and precision (P,)."""
    centre, precision = np.zeros(len(p)), np.zeros(len(p))
    centre[RIM], centre[CONTRAST] = RIM_SHARE * p[R], optics.contrast
    tight = 1e12 if _glare_is_far(p, ring) else 1.0
    precision[RIM] = noise**2 * tight / (0.1 * p[R]) ** 2
    precision[GLARE] = noise**2 * tight / optics.contrast**2
    loose = max(0.0, p[W] / p[R] - 0.1)  # a bubble that collapses within the exposure is fainter, its halo blurred
    precision[LEVEL] = noise**2 / (max(LEVEL_SPREAD, optics.spread / 3, LOOSE * loose) * optics.contrast) ** 2
    precision[CONTRAST] = noise**2 / ((optics.spread + loose) * optics.contrast) ** 2
    return centre, precision


def _descend(image: Array, p: Array, modes: int, ring: Array, noise: float, optics: Optics) -> Array | None:
    """Levenberg–Marquardt; None where it leaves what an outline can be."""
    damping, cutoff = 1e-3, CUTOFF * noise
    centre, precision = _known(p, ring, noise, optics)
    bright = 0.0, -optics.contrast  # what the centre can be between
    A, g, _, total, cost = normal_equations(image, p, modes, ring, cutoff)
    if total < 3 * len(p):
        return None
    cost += 0.5 * float(precision @ (p - centre) ** 2)
    for _ in range(ROUNDS):
        H = A + np.diag(precision)
        try:
            step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12), g - precision * (p - centre))
        except np.linalg.LinAlgError:
            return None
        trial = p + step
        trial[W] = np.clip(trial[W], 0.3, max(2 * p[W], 1.0))
        trial[GLARE] = np.clip(trial[GLARE], min(bright), max(bright))
        trial[RIM] = np.clip(trial[RIM], 0.1 * trial[R], 0.75 * trial[R])
        if not np.all(np.isfinite(trial)) or trial[R] < 1 or trial[R] > 3 * max(image.shape):
            return None
        found = normal_equations(image, trial, modes, ring, cutoff)
        better = found[4] + 0.5 * float(precision @ (trial - centre) ** 2)
        if better <= cost and found[3] > 0:
            done = np.max(np.abs(step[:W])) < 1e-4 and cost - better <= 1e-7 * cost
            p, (A, g), cost, damping = trial, found[:2], better, max(damping / 10, 1e-7)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return p


def _outline(image: Array, p: Array, modes: int, ring: Array, noise: float, optics: Optics) -> Outline | None:
    cutoff = CUTOFF * noise
    A, _, squares, total, _ = normal_equations(image, p, modes, ring, cutoff)
    _, precision = _known(p, ring, noise, optics)
    try:
        inverse = np.linalg.inv(A + np.diag(precision))
    except np.linalg.LinAlgError:
        return None
    sectors = int(np.clip(2 * np.pi * p[R] / max(4.0, 2 * p[W]), 8, 256))
    sums, spread, slope = influence(image, p, modes, ring, cutoff, inverse[R], sectors)
    seen = share_inside(image.shape, Circle(*p[:3]))
    free = len(p) - 2 * _glare_is_far(p, ring)
    used = max(1.0, seen * sectors)
    lost = min(0.8, (3 + 2 * (modes - 1)) / used)  # what the fit of the circle and its modes takes out of the sums
    # the step of robust weights is the M-estimator's, its error that of Huber (1981): ψ' in the place of the weights
    variance = spread / max(slope, 0.3) ** 2 * total / max(total - free, 1.0)
    shape = p[SHAPE:].reshape(-1, 2).T if modes > 1 else np.zeros((2, 0))
    mode_std = float(np.sqrt(max(np.diag(inverse)[SHAPE:].mean(), 0) * squares / total)) if modes > 1 else 0.0
    common = noise**2 * inverse[R, CONTRAST] ** 2 * precision[CONTRAST]  # of the contrast that all frames share
    ratio = float(np.sum(sums**2) / (1 - lost) / max(spread, 1e-30))
    return Outline(
        Circle(*map(float, p[:3])),
        float(p[W]),
        float(p[CONTRAST]),
        noise,
        shape,
        float(variance),
        ratio,
        float(common),
        mode_std,
        seen,
    )


__all__ = ["MODES", "NAMES", "Circle", "Optics", "Outline", "fit_outline", "share_inside"]
