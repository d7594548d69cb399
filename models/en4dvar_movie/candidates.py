"""What may be the bubble in a frame: patches with the outline of a bubble, and what is doubtful in them."""

from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.hints import percent
from en4dvar_movie.background import BRIGHT, CHANGED, Background, share_changed
from en4dvar_movie.fitting import SHARP, fit_outline, two_edges
from en4dvar_movie.frames import Frame, saturated
from en4dvar_movie.merged import two_circles
from en4dvar_movie.outline import TILE, Circle, Optics, Outline, locate

LEAST_SEEN = 0.12  # share of the outline inside the frame
LEAST_RADIUS = 2.5  # pixels
ROUGH = 0.08  # of the contrast: scatter about a real outline, beside the noise of the camera
MOST_BLUR = 0.12  # of the radius, of an outline that the frame cuts, where it is no sharp edge of the movie's
ROWS, ROWS_STD = 0.5, 6.0  # pixels and std by which even and odd rows must differ in an interlaced frame
BLURS = 3.0  # widths of the movie's sharp edges that another bubble's blur reaches
TOUCHES = "two bubbles: the outline of another, or of something else as dark, touches it"
NO_CIRCLE = "no circle fits the outline"
LIT = "light: a part of the outline is saturated, as by the laser's plasma"
OUTSIDE, SURELY, GLARING = 3.0, 5.0, 0.05  # pixels outside the outline; std of noise; the share of it that is saturated
WIDER = 1.4  # widths of the movie's sharp edges from which an edge may be two


@dataclass(frozen=True)
class Candidate:
    """Outlines in a frame, the largest first, of as many flashes; ``fault``: why they are no bubble, ``doubt``: why
    they may mislead."""

    frame: int
    outlines: tuple[Outline, ...]
    fault: str = ""
    doubt: str = ""

    @property
    def circle(self) -> Circle:
        return self.outlines[0].circle


@dataclass(frozen=True)
class Look:
    """The candidates of a frame, the largest patch first, or the ``reason`` why there is none; ``spot`` is the place
    (x, y) and brightness of light that the background lacks, as the laser's."""

    frame: int
    candidates: tuple[Candidate, ...] = ()
    reason: str = ""
    spot: tuple[float, float, float] | None = None


def look_at(
    number: int, frame: Frame, background: Background, optics: Optics, start: Circle | None = None, circles: int = 1
) -> Look:
    """The candidates of a frame, or the outlines near ``start`` alone."""
    background = background.behind(number)
    image, tiles = background.normalised(frame)
    spot = _spot(tiles, background.noise / TILE)
    if start is not None:
        places = [start]
    elif share_changed(tiles, background.noise) > CHANGED:
        return Look(number, (), "flash: much of the frame is brighter than the background", spot)
    elif number < background.frames:
        return Look(number, (), "no bubble: the frame is one of the background's", spot)
    else:
        places = [place for place, _ in locate(tiles, background.noise / TILE)]
    if not places:
        return Look(number, (), "no bubble: nothing that has an outline differs from the background", spot)
    candidates: list[Candidate] = []
    for place in places:
        steady = background.steadied(image, tiles, place, optics.contrast)
        pair = None if start is not None else two_circles(steady, place, optics.contrast, background.noise)
        for near, other in ((place, None),) if pair is None else (pair, pair[::-1]):
            seen = steady if other is None else _without(steady, other, optics)
            outlines = fit_outline(seen, near, optics, circles, ovals=True)
            if outlines is None or any(_same(outlines[0].circle, c.circle) for c in candidates):
                continue
            fault = next((words for o in outlines if (words := _fault_of(o, optics, background.noise))), "")
            doubt = "" if fault else TOUCHES if pair else _doubt(steady, outlines[0], optics, circles)
            if not fault and background.relative and _lit_outside(frame, steady, outlines[0].circle, background.noise):
                doubt = LIT
            candidates.append(Candidate(number, tuple(outlines), fault, doubt))
    return Look(number, tuple(candidates), "" if candidates else NO_CIRCLE, spot)


def _without(image: Array, other: Circle, optics: Optics) -> Array:
    """The image without another bubble and its blur."""
    return np.where(other.off(image.shape) < BLURS * optics.width, np.float32(np.nan), image)


def _same(a: Circle, b: Circle) -> bool:
    return bool(np.hypot(a.x - b.x, a.y - b.y) < 0.5 * max(a.R, b.R))


def _spot(tiles: Array, noise: float) -> tuple[float, float, float] | None:
    """The middle of the brightest part of a frame, and its brightness, where light is that the background lacks."""
    most = float(tiles.max())
    if most < max(8 * noise, BRIGHT):
        return None
    y, x = np.nonzero(tiles > 0.7 * most)
    return float(TILE * np.median(x) + 0.5), float(TILE * np.median(y) + 0.5), most


def _fault_of(outline: Outline, optics: Optics, noise: float) -> str:
    if outline.circle.R < LEAST_RADIUS:
        return f"too small: the radius is below {LEAST_RADIUS:g} pixels"
    if outline.seen < LEAST_SEEN:
        return f"cut: {percent(outline.seen)} of the outline lies in the frame"
    if outline.seen < 0.9 and outline.width > max(MOST_BLUR * outline.circle.R, SHARP * optics.width):
        return f"cut and blurred: {percent(outline.seen)} of the outline lies in the frame, and it is no edge"
    if outline.noise > 2.5 * noise + ROUGH * abs(optics.contrast):
        return "the brightness next to the outline is not that of a bubble"
    if outline.contrast > 0.25 * optics.contrast:
        return "faint: the outline has no contrast"
    return ""


def _lit_outside(frame: Frame, image: Array, circle: Circle, noise: float) -> bool:
    """True if a part of what lies next to a dark bubble is saturated, and brighter than the background."""
    off = circle.off(image.shape)
    lit = (frame > saturated([frame])) & (image > SURELY * noise)
    return bool(np.mean(lit[(off > 0) & (off < OUTSIDE)]) > GLARING)


def _doubt(image: Array, outline: Outline, optics: Optics, circles: int) -> str:
    if abs(outline.rows) > max(ROWS, ROWS_STD * outline.rows_std):
        return f"interlaced: even and odd rows show radii {abs(outline.rows):.1f} pixels apart"
    if circles == 1 and outline.width > WIDER * optics.width and (apart := two_edges(image, outline.circle, optics)):
        return f"two edges {apart:.1f} pixels apart: several flashes that --flashes does not announce?"
    return ""
