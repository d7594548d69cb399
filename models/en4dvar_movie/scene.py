"""Movies of a bubble whose radius is known: what ``track`` is measured against.

A frame is light on a sensor: an uneven background, darkened inside the bubble except in its bright centre, averaged
over the exposure and over a pixel, blurred by the optics, with dirt, shot noise and read noise, in whole grey levels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from en4dvar.state import Array

FINE = 3  # sub-pixels to a side


@dataclass(frozen=True)
class Scene:
    """Lengths in pixels, brightness in grey levels of 8 bit.

    ``blur`` is the std of the optics, ``contrast`` the share of light that a bubble takes, ``uneven`` that by which the
    background varies; ``noise`` the std of the camera at the background's brightness, half of its variance shot noise;
    ``centre`` the bright centre's share of the radius (0: none); ``drift`` the way of the centre in a frame;
    ``ellipticity`` the std of a random surface of degree 2 over the radius; ``dirt`` the number of specks, a quarter
    of them moving with the frame; ``bubble`` where the centre is (x, y); ``before`` frames are without a bubble.
    """

    shape: tuple[int, int] = (128, 128)
    level: float = 150.0
    contrast: float = 0.5
    blur: float = 1.2
    noise: float = 3.0
    uneven: float = 0.1
    centre: float = 0.0
    drift: float = 0.0
    ellipticity: float = 0.0
    dirt: int = 0
    bubble: tuple[float, float] = (63.3, 64.2)
    before: int = 3


def render(radii: Array, scene: Scene, rng: np.random.Generator) -> Iterator[Array]:
    """Frames (H, W), 8 bit, of radii (K, S) in pixels at S instants within each exposure."""
    light = _background(scene, rng)
    surface = _surface(scene, rng)
    heading = rng.uniform(0, 2 * np.pi)
    for k in range(-scene.before, len(radii)):
        frame = light if k < 0 else light * (1 - scene.contrast * _shade(radii[k], k, surface, heading, scene))
        if scene.dirt:
            frame = frame * _specks(scene, np.random.default_rng([k + scene.before, scene.dirt]), scene.dirt // 4)
        yield _exposed(frame, scene, rng)


def _background(scene: Scene, rng: np.random.Generator) -> Array:
    height, width = scene.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    a, b, c = rng.uniform(-1, 1, 3)
    light = scene.level * (1 + scene.uneven * (a * x + b * y + c * x * y) / 2)
    return np.asarray(light * _specks(scene, rng, scene.dirt - scene.dirt // 4))


def _specks(scene: Scene, rng: np.random.Generator, count: int) -> Array:
    """What small dark discs anywhere leave of the light (H, W)."""
    y, x = np.indices(scene.shape)
    left = np.ones(scene.shape)
    for _ in range(count):
        r = np.hypot(x - rng.uniform(0, scene.shape[1]), y - rng.uniform(0, scene.shape[0]))
        left *= 1 - rng.uniform(0.2, 0.7) / (1 + np.exp((r - rng.uniform(1, 2.5)) / 0.5))
    return left


def _surface(scene: Scene, rng: np.random.Generator) -> Array:
    """A symmetric matrix (3, 3) without trace: the radius over its mean is 1 + nᵀMn in the direction n."""
    A = rng.normal(size=(3, 3)) * scene.ellipticity
    M = (A + A.T) / 2
    return np.asarray(M - np.eye(3) * np.trace(M) / 3)


def _shade(radii: Array, k: int, M: Array, heading: float, scene: Scene) -> Array:
    """How much of a pixel (H, W) the bubble covers, blurred."""
    height, width = scene.shape
    y, x = np.indices((height * FINE, width * FINE))
    at = (FINE - 1) / 2
    dx = (x - at) / FINE - scene.bubble[0] - k * scene.drift * np.cos(heading)
    dy = (y - at) / FINE - scene.bubble[1] - k * scene.drift * np.sin(heading)
    r = np.hypot(dx, dy) + 1e-9
    cos, sin = dx / r, dy / r
    form = 1 + M[0, 0] * cos**2 + M[1, 1] * sin**2 + 2 * M[0, 1] * cos * sin
    covered = np.zeros(r.shape)
    for radius in radii:
        covered += np.clip((radius * form - r) * FINE + 0.5, 0, 1)
        if scene.centre:
            covered -= 0.7 * np.clip((scene.centre * radius - r) * FINE + 0.5, 0, 1)
    smooth = ndimage.gaussian_filter(covered / len(radii), scene.blur * FINE, mode="nearest", truncate=5)
    return np.asarray(smooth.reshape(height, FINE, width, FINE).mean(axis=(1, 3)))


def _exposed(light: Array, scene: Scene, rng: np.random.Generator) -> Array:
    shot = 0.5 * scene.noise**2 * np.clip(light / scene.level, 0, None)
    noisy = light + rng.normal(size=light.shape) * np.sqrt(shot + 0.5 * scene.noise**2)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
