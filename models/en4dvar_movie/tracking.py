"""From a movie to readings: every frame by itself, in any order, then what neighbouring frames say of the errors."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from en4dvar_movie.background import CHANGED, LEAST_CONTRAST, Background, find_background, share_changed
from en4dvar_movie.corrections import Correction
from en4dvar_movie.fitting import fit_outline
from en4dvar_movie.flashes import in_time
from en4dvar_movie.frames import Frame, Movie
from en4dvar_movie.locate import TILE, locate
from en4dvar_movie.outline import Circle, Optics, Outline
from en4dvar_movie.uncertainty import NEIGHBOURS, Errors, errors_of

LEAST_SEEN = 0.12  # share of the outline inside the frame
LEAST_RADIUS = 2.5  # pixels
ROUGH = 0.08  # of the contrast: scatter about a real outline, beside the noise of the camera
MOST_BLUR = 0.12  # of the radius, of an outline that the frame cuts


@dataclass(frozen=True)
class Sighting:
    """The bubble in a frame at one of its flashes: its outline, or the ``reason`` why there is none."""

    frame: int
    outline: Outline | None
    reason: str
    flash: int = 0


@dataclass(frozen=True)
class Reading:
    """A frame's radius and its errors, in pixels, ready for the table; ``used`` False where ``reason`` says why."""

    sighting: Sighting
    radius: float
    errors: Errors
    used: bool
    reason: str


@dataclass(frozen=True)
class Track:
    """The readings of a movie, in the order of time, and what its frames share; ``flashes`` (S,) of a frame, s."""

    readings: tuple[Reading, ...]
    background: Background
    optics: Optics
    flashes: tuple[float, ...] = (0.0,)


def track(
    movie: Movie,
    workers: int = 1,
    corrections: Mapping[int, Correction] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    flashes: tuple[float, ...] = (0.0,),
) -> Track:
    """Readings of every frame, or of every flash of each; the same numbers for any number of workers.

    Raises
    ------
    DataError: the movie cannot be read or shows no bubble.
    """
    background, optics = find_background(movie, len(flashes))
    fixed = corrections or {}

    def look(numbered: tuple[int, Frame]) -> list[Sighting]:
        number, frame = numbered
        if number in movie.damaged:
            return [Sighting(number, None, "the file is damaged here")]
        return find_bubble(number, frame, background, optics, fixed.get(number), len(flashes))

    sightings = []
    for of_frame in in_order(look, enumerate(movie.frames()), workers):
        sightings.append(of_frame)
        progress(len(sightings))
    if len(flashes) > 1:
        sightings = ordered(sightings, movie.rate, flashes)
    flat = [circle for of_frame in sightings for circle in of_frame]
    return Track(tuple(readings_of(flat, optics, fixed)), background, optics, flashes)


def find_bubble(
    number: int,
    frame: Frame,
    background: Background,
    optics: Optics,
    correction: Correction | None = None,
    circles: int = 1,
) -> list[Sighting]:
    """The bubble's outline in one frame, or its nested ones, the largest first; one entry where there is none."""
    image, tiles = background.normalised(frame)
    if correction is not None and correction.start is not None:
        place: tuple[Circle, float] | None = (correction.start, -optics.contrast)
    elif number < background.frames:
        return [Sighting(number, None, "no bubble: the frame is one of the background's")]
    else:
        if share_changed(tiles, background.noise) > CHANGED:
            return [Sighting(number, None, "flash: much of the frame is brighter than the background")]
        place = locate(tiles, background.noise / TILE, LEAST_CONTRAST)
    if place is None:
        return [Sighting(number, None, "no bubble: nothing differs from the background")]
    outlines = fit_outline(background.steadied(image, tiles, place[0]), place[0], optics, circles)
    if outlines is None:
        return [Sighting(number, None, "no circle fits the outline")]
    return [Sighting(number, o, _fault(o, optics, background.noise)) for o in outlines]


def ordered(sightings: list[list[Sighting]], rate: float, flashes: Sequence[float]) -> list[list[Sighting]]:
    """The nested circles of each frame in the order of the flashes; frames without all of them keep theirs."""
    whole = [
        k
        for k, of_frame in enumerate(sightings)
        if len(of_frame) == len(flashes) and not any(c.reason for c in of_frame)
    ]
    radii = [np.array([c.outline.circle.R for c in sightings[k] if c.outline is not None]) for k in whole]
    at = np.array([sightings[k][0].frame / rate for k in whole])
    result = list(sightings)
    for k, order in zip(whole, in_time(radii, at, flashes), strict=True):
        result[k] = [replace(sightings[k][circle], flash=flash) for flash, circle in enumerate(order)]
    return result


def _fault(outline: Outline, optics: Optics, noise: float) -> str:
    """Why an outline is none; "" where it is one."""
    if outline.circle.R < LEAST_RADIUS:
        return f"too small: the radius is below {LEAST_RADIUS:g} pixels"
    if outline.seen < LEAST_SEEN:
        return f"cut: {outline.seen:.0%} of the outline lies in the frame"
    if outline.seen < 0.9 and outline.width > MOST_BLUR * outline.circle.R:
        return f"cut and blurred: {outline.seen:.0%} of the outline lies in the frame, and it is no edge"
    if outline.noise > 2.5 * noise + ROUGH * abs(optics.contrast):
        return "the brightness next to the outline is not that of a bubble"
    if outline.contrast > 0.25 * optics.contrast:
        return "faint: the outline has no contrast"
    return ""


def in_order(
    look: Callable[[tuple[int, Frame]], list[Sighting]], frames: Iterable[tuple[int, Frame]], workers: int
) -> Iterator[list[Sighting]]:
    """``look`` at each frame in threads; a few frames are held at a time."""
    if workers == 1:
        yield from map(look, frames)
        return
    waiting: deque[Future[list[Sighting]]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for numbered in frames:
            waiting.append(pool.submit(look, numbered))
            if len(waiting) > 3 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def elsewhere(sightings: Sequence[Sighting]) -> list[Sighting]:
    """The same, with a reason for outlines that lie outside the bubble of the frames about them: specks of dirt."""
    good = [k for k, sighting in enumerate(sightings) if sighting.outline is not None and not sighting.reason]
    circles = np.array([(c.x, c.y, c.R) for k in good if (o := sightings[k].outline) is not None for c in [o.circle]])
    result = list(sightings)
    for n, k in enumerate(good):
        near = circles[max(0, n - NEIGHBOURS) : n + NEIGHBOURS + 1]
        x, y = np.median(near[:, :2], axis=0)
        if np.hypot(circles[n, 0] - x, circles[n, 1] - y) > max(near[:, 2].max(), 2 * circles[n, 2]):
            result[k] = replace(sightings[k], reason="elsewhere: the outline lies outside the bubble of other frames")
    return result


def readings_of(sightings: list[Sighting], optics: Optics, corrections: Mapping[int, Correction]) -> Iterator[Reading]:
    """Radii with their errors, and what is left out by hand or for the neighbours' sake."""
    sightings = elsewhere(sightings)
    good = [sighting.outline if not sighting.reason else None for sighting in sightings]
    errors = errors_of(good, optics)
    for sighting, outline, error in zip(sightings, good, errors, strict=True):
        correction = corrections.get(sighting.frame)
        if correction is not None and correction.out:
            yield Reading(sighting, float("nan"), error, False, f"left out by hand: {correction.words}".rstrip(": "))
        elif outline is None:
            yield Reading(sighting, float("nan"), error, False, sighting.reason)
        else:
            words = f"by hand: {correction.words}".rstrip(": ") if correction is not None else error.words
            yield Reading(sighting, error.radius, error, True, words)
