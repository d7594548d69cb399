"""What shows the work: the movie with its outlines, and a page with a strip of frames, radius and shape in time."""

import base64
import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from en4dvar.model.state import Array
from en4dvar.report.chart import PAGE, Chart, Panel, Row
from en4dvar.report.html import render
from en4dvar.report.svg import svg
from en4dvar.report.text import plain_number
from en4dvar_movie.frames import Frame, Movie
from en4dvar_movie.outline import MODES
from en4dvar_movie.table import Scale
from en4dvar_movie.tracking import Reading, Track

WIDE = 512  # pixels that a frame of the outlined movie has at least
RED = (255, 90, 54)
SHOWN = 60  # frames of the strip
SIDE = 240  # pixels of a picture, at most
TURN = np.linspace(0, 2 * np.pi, 121)
COLOURS = ("centre", "posterior", "background", "ink", "muted")  # of the modes of the shape
DASHES = ("", "--", ":", "", "--")
FELT = 5e-4  # of a radius: a tenth of what is taken for granted of a scale; less of a lasting shape is not told


def page_text(movie: Movie, track: Track, scale: Scale, command: str) -> str:
    """The page, one file without addresses."""
    used = [r for r in track.readings if r.used]
    return render(
        "page.html.j2",
        "en4dvar_movie",
        movie=movie.path.name,
        notes=[*movie.notes, *track.notes],
        command=command,
        count=len(track.readings),
        used=len(used),
        what="frames" if len(track.flashes) == 1 else "circles",
        scale=f"{1e6 * scale.pixel:.6g} µm a pixel, {plain_number(scale.rate, 7)} frames a second",
        background=track.background.frames,
        common=f"{float(np.median([r.errors.common for r in used])) * 1e6 * scale.pixel:.2g}" if used else "",
        factor=f"{100 * used[0].errors.factor:.2g}" if used and used[0].errors.factor > FELT else "",
        figures=[svg(draw(used, scale), name, name) for name, draw in (("radius", _radius), ("shape", _shape))],
        strip=_strip(movie, track),
        left_out=[r for r in track.readings if not r.used],
        remarks=[r for r in used if r.reason],
    )  # fmt: skip


def _radius(used: list[Reading], scale: Scale) -> Chart:
    um = 1e6 * scale.pixel
    times = 1e6 * np.array([scale.time(r) for r in used])
    radius, reach = um * np.array([r.radius for r in used]), 1.645 * um * np.array([r.errors.std for r in used])
    panel = Panel("time (µs)", "radius (µm), 90 %")
    panel.bars(times, radius - reach, radius + reach, "centre", 1.0)
    panel.dots(times, radius, "ink", 2.5)
    return Chart([Row(187.0, [panel])], PAGE)


def _shape(used: list[Reading], scale: Scale) -> Chart:
    times = [1e6 * scale.time(r) for r in used]
    outlines = [r.outline for r in used]
    left, right = Panel("time (µs)", "eccentricity"), Panel("time (µs)", "mode over radius", legend=True)
    left.dots(times, [o.eccentricity if o else np.nan for o in outlines], "ink", 1.8)
    for n, colour, dash in zip(range(2, MODES + 1), COLOURS, DASHES, strict=False):
        part = [o.amplitude(n) / o.circle.R if o else np.nan for o in outlines]
        right.line(times, part, colour, 0.9, dash, f"mode {n}")
    return Chart([Row(173.0, [left, right])], PAGE)


def _strip(movie: Movie, track: Track) -> list[dict[str, Any]]:
    """Evenly chosen frames as pictures, each with its outline as a path over it."""
    circles = by_frame(track.readings)
    every = -(-len(circles) // SHOWN)
    full = brightest(track)
    return [
        _picture(number, frame, circles[number], full)
        for number, frame in enumerate(movie.frames())
        if number % every == 0 and number in circles
    ]


def _picture(number: int, frame: Frame, readings: list[Reading], full: float) -> dict[str, Any]:
    step = -(-max(frame.shape) // SIDE)
    small = grey(frame[::step, ::step], full)
    shown = [(r.outline, r.doubt) for r in readings if r.used or r.doubt]
    outlines = [(outline.points(TURN) / step, doubt) for outline, doubt in shown if outline is not None]
    return {
        "frame": str(number),
        "png": png(small),
        "width": str(small.shape[1]),
        "height": str(small.shape[0]),
        "outlines": [
            (" ".join(f"{x + 0.5:.2f},{y + 0.5:.2f}" for x, y in points), "doubtful" if doubt else "")
            for points, doubt in outlines
        ],
        "words": "; ".join(dict.fromkeys(r.reason for r in readings if r.reason)),
    }


def png(picture: Frame) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=False)
    return base64.b64encode(buffer.getvalue()).decode()


def by_frame(readings: Sequence[Reading]) -> dict[int, list[Reading]]:
    """Frame → its readings, one a circle."""
    of_frames: dict[int, list[Reading]] = {}
    for reading in readings:
        of_frames.setdefault(reading.frame, []).append(reading)
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
            if reading.used and reading.outline is not None:
                around = np.linspace(0, 2 * np.pi, int(8 * reading.radius * scale) + 16)
                _draw(picture, (reading.outline.points(around) + 0.5) * scale)
        yield picture


def brightest(track: Track) -> float:
    return max(1.3 * float(np.percentile(track.background.level, 95)), 1.0)


def grey(frame: Frame, full: float) -> Frame:
    return np.clip(255.0 * frame / full, 0, 255).astype(np.uint8)


def _draw(picture: Frame, points: Array) -> None:
    for shift in ((0, 0), (1, 0), (0, 1)):  # a line of two pixels, which a video with fewer colours than pixels keeps
        x, y = np.floor(points + shift).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
        picture[y[inside], x[inside]] = RED
