"""From a movie to readings: candidates of every frame by itself, in any order, then the bubble that continues through
them, then what neighbouring frames say of the errors."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.executor import SerialExecutor, ThreadsExecutor
from en4dvar.model.state import Mask
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.background import Background, find_background
from en4dvar_movie.candidates import LIT, NO_CIRCLE, TOUCHES, Look, look_at
from en4dvar_movie.choice import Correction
from en4dvar_movie.drifting import shift_at
from en4dvar_movie.flashes import in_time
from en4dvar_movie.following import BRIEF, Chain, chains, doubts, reasons, target
from en4dvar_movie.frames import Frame, Movie
from en4dvar_movie.outline import Optics, Outline
from en4dvar_movie.uncertainty import NOTHING, Errors, errors_of

UNREAD = 3  # frames: what makes doubtful whether something beside the bubble stands still
STANDS, TELLING = 1e-3, 8  # of its radius: scatter of what never moves; readings that tell it
AWAY = 10.0  # pixels from a bubble that a point may be to mean it


@dataclass(frozen=True)
class Reading:
    """The bubble in a frame at one of its flashes: outline, radius and its errors, in pixels, ready for the table.

    ``used`` is False where ``reason`` says why; ``doubt`` is why an outline that is there is not used until a
    correction confirms it.
    """

    frame: int
    outline: Outline | None
    reason: str = ""
    flash: int = 0
    radius: float = float("nan")
    errors: Errors = NOTHING
    used: bool = False
    doubt: str = ""


@dataclass(frozen=True)
class Track:
    """The readings of a movie, in the order of time, and what its frames share.

    ``others`` are the readings of further bubbles, ``notes`` what a user should know of the choice between them.
    """

    readings: tuple[Reading, ...]
    background: Background
    optics: Optics
    others: tuple[tuple[Reading, ...], ...] = ()
    notes: tuple[str, ...] = ()


def track(
    movie: Movie,
    workers: int = 1,
    corrections: Mapping[int, Correction] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    flashes: tuple[float, ...] = (0.0,),
    point: tuple[float, ...] | None = None,
    watched: Mask | None = None,
    exposure: float = 0.0,
) -> Track:
    """Readings of a bubble in every frame, or at every flash of each; the same numbers for any number of workers.

    ``point``: x and y within the bubble, in some frame; by default the bubble is that of the laser's spot, or the one
    whose wall travels furthest. ``watched``: (H, W) the part of the frames that is looked at. ``exposure``: how long
    light falls on a frame, s; 0 if it is not known.

    Raises DataError: the movie cannot be read or shows no bubble, or none near the point.
    """
    background, optics = find_background(movie, len(flashes), watched)
    fixed = corrections or {}

    def look(number: int, frame: Frame) -> Look:
        if number in movie.damaged:
            words = "the frame is missing in the folder" if movie.path.is_dir() else "the file is damaged here"
            return Look(number, (), words)
        if number in movie.copies:
            return Look(number, (), "copy: the frame is the one before it, bit for bit")
        start = fixed[number].start if number in fixed else None
        return look_at(number, frame, background, optics, start, len(flashes))

    of_frames: dict[int, Look] = {}
    with SerialExecutor() if workers == 1 else ThreadsExecutor(workers) as executor:
        for number, of_frame in executor.results(look, enumerate(movie.frames())):
            of_frames[number] = of_frame
            progress(len(of_frames))
    looks = [of_frames[number] for number in sorted(of_frames)]
    by_hand = [number for number, correction in fixed.items() if correction.start is not None]
    bubbles = chains(looks, by_hand)
    notes: list[str] = []
    if bubbles:
        chosen, note = target(bubbles, looks, point, by_hand)
        bubbles.insert(0, bubbles.pop(chosen))
        notes = [note] * bool(note)
    if background.drift is not None:
        down, across = shift_at(background.drift, looks[-1].frame)
        notes.append(
            f"the camera drifts: the last frame shows the background {across} pixels to the right and {down} down of "
            "where the first does; a region or mask is that of the first frame and moves with it, x and y do not"
        )
    if optics.hidden:
        notes.append(
            f"{optics.hides}: where in the light's fall an edge shows is not known, and all radii may be off by "
            f"{optics.hidden:.1f} pixels alike, which R_common_um holds; if the camera saved better frames, take those"
        )
    if movie.copies:
        notes.append(
            f"the same, bit for bit, as the frame before, and so not used: {_ranges(sorted(movie.copies))}; if a "
            "conversion put them in, all later times are late by a frame each: take the movie as the camera saved it, "
            "or take them out; if they stand for frames that were lost, the times are right"
        )
    if point is not None and (not bubbles or bubbles[0].distance(*point)[0] > AWAY):
        raise DataError(f"{movie.path}: no bubble is seen near {point[0]:g},{point[1]:g} in any frame")
    share = exposure * movie.rate if len(flashes) == 1 else 0.0
    read = [
        tuple(_readings(looks, bubble, bubbles, fixed if n == 0 else {}, optics, movie.rate, flashes, share))
        for n, bubble in enumerate(bubbles or [Chain(())])
    ]
    if not background.frames and sum(r.reason in (TOUCHES, NO_CIRCLE) for r in read[0]) >= UNREAD:
        notes.append(
            "no frame is empty, and what stands still beside the bubble may have been taken for a part of it: an empty "
            "frame in front shows what that is, and a tight --mask leaves it out"
        )
    radii = [r.radius for r in read[0] if r.used]
    if not background.frames and len(radii) >= TELLING and np.std(radii) < STANDS * np.mean(radii):
        notes.append(
            f"the radius is the same in all frames, {np.mean(radii):.2f} pixels: if that is the edge of an aperture or "
            "of something else that stands still, leave it out with --mask"
        )
    return Track(read[0], background, optics, tuple(read[1:]), tuple(notes))


def _readings(
    looks: Sequence[Look],
    bubble: Chain,
    bubbles: Sequence[Chain],
    corrections: Mapping[int, Correction],
    optics: Optics,
    rate: float,
    flashes: Sequence[float],
    exposure: float,
) -> Iterator[Reading]:
    """Radii with errors, a frame's circles in the order of flashes; ``exposure`` is a share of the frames' step."""
    doubtful = doubts(bubble, [other for other in bubbles if other is not bubble])
    stays = sum(c.doubt == LIT for c in bubble.candidates) > BRIEF  # such light is not the laser's
    doubtful |= {c.frame: c.doubt for c in bubble.candidates if c.doubt and not (stays and c.doubt == LIT)}
    doubtful = {frame: words for frame, words in doubtful.items() if frame not in corrections}
    out = {frame for frame, correction in corrections.items() if correction.out}
    why = reasons(looks, bubble)
    radii = [np.array([outline.circle.R for outline in c.outlines]) for c in bubble.candidates]
    orders = in_time(radii, np.array([c.frame / rate for c in bubble.candidates]), flashes)
    seen = {
        c.frame: [Reading(c.frame, c.outlines[circle], flash=flash) for flash, circle in enumerate(order)]
        for c, order in zip(bubble.candidates, orders, strict=True)
    }
    readings = [r for look in looks for r in seen.get(look.frame) or [Reading(look.frame, None, why[look.frame])]]
    good = [None if r.frame in doubtful or r.frame in out else r.outline for r in readings]
    for reading, outline, errors in zip(readings, good, errors_of(good, optics, exposure), strict=True):
        correction, doubt = corrections.get(reading.frame), doubtful.get(reading.frame, "")
        if correction is not None and correction.out:
            yield replace(reading, reason=f"left out by hand: {correction.words}".rstrip(": "))
        elif outline is None:
            yield replace(reading, reason=doubt or reading.reason, doubt=doubt)
        else:
            words = f"by hand: {correction.words}".rstrip(": ") if correction is not None else errors.words
            yield replace(reading, radius=errors.radius, errors=errors, used=True, reason=words)


def doubted(readings: Sequence[Reading]) -> str:
    """In a line, the doubtful frames by what is doubtful: ``interlaced: 7-19; jump: 24``; "" without any."""
    kinds: dict[str, list[int]] = {}
    for reading in readings:
        if reading.doubt:
            frames = kinds.setdefault(reading.doubt.split(":")[0], [])
            frames += [reading.frame] * (reading.frame not in frames)
    return "; ".join(f"{kind}: {_ranges(frames)}" for kind, frames in kinds.items())


def _ranges(frames: Sequence[int]) -> str:
    parts = np.split(frames, 1 + np.flatnonzero(np.diff(frames) != 1))
    return ", ".join(f"{part[0]}" if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)
