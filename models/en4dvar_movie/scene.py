"""Movies of a bubble whose radius is known: what ``track`` is measured against, and ``en4dvar simulate --movie``.

A frame is light on a sensor: an uneven background, darkened inside the bubble except in its bright centre, averaged
over the exposure (or over flashes) and over a pixel, blurred by the optics, with dirt, shot noise and read noise, in
whole grey levels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval, MultipleOf
from pydantic import BeforeValidator
from scipy import ndimage

from en4dvar.model.state import Array
from en4dvar_movie.frames import Frame

FINE = 3  # sub-pixels to a side
GLARE = 0.7  # how much of a bubble's shade its bright centre lacks
TRUNCATE = 5.0  # std of the blur


SHARE, PART = Interval(ge=0, le=1), Interval(ge=0, lt=1)
SIZE, COUNT = Interval(ge=0, lt=1e3), Interval(ge=0, lt=100_000)


def split(text: str, sign: str = ",") -> list[str]:
    """The two numbers of ``4.5,3``. Raises :class:`ValueError`."""
    if text.count(sign) != 1:
        raise ValueError(f"two numbers with {sign!r} between them")
    return text.split(sign)


Side = Annotated[int, Interval(ge=16, le=8192)]
Shape = Annotated[tuple[Side, Side], BeforeValidator(lambda text: split(text, "x")[::-1])]  # WIDTHxHEIGHT, as --raw
Place = Annotated[tuple[float, float], BeforeValidator(split)]


@dataclass(frozen=True)
class Scene:
    """The scene that is filmed, and the camera; lengths in pixels. Each field's annotation says what it is."""

    shape: Annotated[Shape, "WIDTHxHEIGHT of a frame"] = (128, 128)
    level: Annotated[float, "grey level of the background", Interval(gt=0, lt=2**16)] = 150.0
    contrast: Annotated[float, "share of the light that the bubble takes", Interval(gt=0, le=1)] = 0.5
    blur: Annotated[float, "std of the blur by the optics", SIZE] = 1.2
    noise: Annotated[float, "std of the noise where the background is, in grey levels", SIZE] = 3.0
    shot: Annotated[float, "share of the noise's variance that is shot noise, growing with the light", SHARE] = 0.5
    uneven: Annotated[float, "share by which the background's light varies over a frame", SIZE] = 0.1
    centre: Annotated[float, "radius of the bright centre over that of the bubble; 0: none", PART] = 0.0
    drift: Annotated[float, "distance the bubble's centre moves from frame to frame", SIZE] = 0.0
    ellipticity: Annotated[float, "std of a random ellipsoid's surface over its radius", SIZE] = 0.0
    dirt: Annotated[int, "number of specks, a quarter of which moves from frame to frame", COUNT] = 0
    bubble: Annotated[Place | None, "x and y of the bubble's centre; default the frame's middle"] = None
    before: Annotated[int, "empty frames before the bubble", COUNT] = 3
    bits: Annotated[int, "of a grey level: 8 or 16", Interval(ge=8, le=16), MultipleOf(8)] = 8


def render(radii: Array, scene: Scene, rng: np.random.Generator) -> Iterator[Frame]:
    """Frames (H, W) of radii (K, S) in pixels at S instants within each exposure, of equal light."""
    light = _background(scene, rng)
    surface = _surface(scene, rng)
    heading = rng.uniform(0, 2 * np.pi)
    seed = int(rng.integers(2**31))  # of what moves
    for k in range(-scene.before, len(radii)):
        frame = light.copy()
        if k >= 0:
            _darken(frame, radii[k], k * scene.drift * np.array([np.cos(heading), np.sin(heading)]), surface, scene)
        if scene.dirt:
            frame *= _specks(scene, np.random.default_rng([seed, k + scene.before]), scene.dirt // 4)
        yield _exposed(frame, scene, rng)


def _background(scene: Scene, rng: np.random.Generator) -> Array:
    height, width = scene.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    a, b, c = rng.uniform(-1, 1, 3)
    light = scene.level * (1 + scene.uneven * (a * x + b * y + c * x * y) / 2)
    return np.asarray(light * _specks(scene, rng, scene.dirt - scene.dirt // 4))


def _specks(scene: Scene, rng: np.random.Generator, count: int) -> Array:
    """The share of the light (H, W) that small dark discs leave."""
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


def _darken(frame: Array, radii: Array, moved: Array, M: Array, scene: Scene) -> None:
    """Take the bubble's shade from a frame (H, W) and its surroundings, whose light is blurred into the frame."""
    height, width = scene.shape
    x0, y0 = (scene.bubble or ((width - 1) / 2, (height - 1) / 2)) + moved
    margin = int(np.ceil(TRUNCATE * scene.blur)) + 2
    reach = float(radii.max()) * (1 + float(np.abs(M).sum())) + margin
    left, right = max(-margin, int(x0 - reach)), min(width + margin, int(x0 + reach) + 2)
    top, bottom = max(-margin, int(y0 - reach)), min(height + margin, int(y0 + reach) + 2)
    if right <= left or bottom <= top:
        return
    at = (np.arange(max(right - left, bottom - top) * FINE) - (FINE - 1) / 2) / FINE
    dx, dy = at[: (right - left) * FINE] + left - x0, (at[: (bottom - top) * FINE] + top - y0)[:, None]
    r = np.hypot(dx, dy) + 1e-9
    cos, sin = dx / r, dy / r
    form = 1 + M[0, 0] * cos**2 + M[1, 1] * sin**2 + 2 * M[0, 1] * cos * sin
    shade = _cover(r / form, radii) - (GLARE * _cover(r / form, scene.centre * radii) if scene.centre else 0.0)
    smooth = ndimage.gaussian_filter(shade, scene.blur * FINE, mode="nearest", truncate=TRUNCATE)
    whole = smooth.reshape(bottom - top, FINE, right - left, FINE).mean(axis=(1, 3))
    about = np.pad(frame, margin)
    about[top + margin : bottom + margin, left + margin : right + margin] *= 1 - scene.contrast * whole
    frame[:] = about[margin:-margin, margin:-margin]


def _cover(r: Array, radii: Array) -> Array:
    """Mean over radii (S,) of how much of a sub-pixel at r the disc covers: linear between its edges."""
    edges = np.sort(np.concatenate([radii - 0.5 / FINE, radii + 0.5 / FINE]))
    values = np.clip((radii[:, None] - edges) * FINE + 0.5, 0, 1).mean(axis=0)
    return np.asarray(np.interp(r, edges, values))


def _exposed(light: Array, scene: Scene, rng: np.random.Generator) -> Frame:
    shot = scene.shot * scene.noise**2 * np.clip(light / scene.level, 0, None)
    noisy = light + rng.normal(size=light.shape) * np.sqrt(shot + (1 - scene.shot) * scene.noise**2)
    return np.clip(np.rint(noisy), 0, 2**scene.bits - 1).astype(np.uint16 if scene.bits > 8 else np.uint8)
