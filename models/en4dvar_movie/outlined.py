"""The movie with its outlines: each frame enlarged, what was read drawn over it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from en4dvar.model.state import Array
from en4dvar_movie.frames import Frame, Movie
from en4dvar_movie.tracking import Reading, Track

WIDE = 512  # pixels that an outlined frame has at least
RED = (255, 90, 54)


def by_frame(readings: Sequence[Reading]) -> dict[int, list[Reading]]:
    """Frame → its readings, one a circle."""
    of_frames: dict[int, list[Reading]] = {}
    for reading in readings:
        of_frames.setdefault(reading.sighting.frame, []).append(reading)
    return of_frames


def outlined(movie: Movie, track: Track) -> Iterator[Frame]:
    """Coloured pictures (H, W, 3) of 8 bit, of even sides as videos need."""
    readings = by_frame(track.readings)
    full = brightest(track)
    for number, frame in enumerate(movie.frames()):
        scale = -(-WIDE // max(frame.shape))
        large = np.kron(grey(frame, full), np.ones((scale, scale), np.uint8))
        picture = np.repeat(np.pad(large, [(0, side % 2) for side in large.shape])[..., None], 3, axis=2)
        for reading in readings.get(number, ()):
            if reading.used and reading.sighting.outline is not None:
                around = np.linspace(0, 2 * np.pi, int(8 * reading.radius * scale) + 16)
                _draw(picture, (reading.sighting.outline.points(around) + 0.5) * scale)
        yield picture


def brightest(track: Track) -> float:
    """The brightness that is shown as white."""
    return max(1.3 * float(np.percentile(track.background.level, 95)), 1.0)


def grey(frame: Frame, full: float) -> Frame:
    """A frame of any depth in 8 bit."""
    return np.clip(255.0 * frame / full, 0, 255).astype(np.uint8)


def _draw(picture: Frame, points: Array) -> None:
    for shift in ((0, 0), (1, 0), (0, 1)):  # a line of two pixels, which a video with fewer colours than pixels keeps
        x, y = np.floor(points + shift).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
        picture[y[inside], x[inside]] = RED
