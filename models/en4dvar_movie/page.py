"""What shows the work: the movie with its outlines, and a page with a strip of frames, radius and shape in time."""

import base64
import io
from collections.abc import Iterator
from itertools import groupby
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
        what="frames" if len(scale.flashes) == 1 else "circles",
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
    """Evenly chosen frames as pictures, each with its outlines as paths over it."""
    from PIL import Image

    pictures = []
    for number, picture, readings in _frames(movie, track, -(-(track.readings[-1].frame + 1) // SHOWN)):
        step = -(-max(picture.shape) // SIDE)
        small, png = picture[::step, ::step], io.BytesIO()
        Image.fromarray(small).save(png, format="PNG")
        outlines = [
            (" ".join(f"{x:.2f},{y:.2f}" for x, y in r.outline.points(TURN) / step + 0.5), r.doubt)
            for r in readings
            if r.outline is not None and (r.used or r.doubt)
        ]
        words = "; ".join(dict.fromkeys(r.reason for r in readings if r.reason))
        shown = {"frame": number, "png": base64.b64encode(png.getvalue()).decode(), "outlines": outlines}
        pictures.append({**shown, "height": len(small), "width": small.shape[1], "words": words})
    return pictures


def _frames(movie: Movie, track: Track, every: int = 1) -> Iterator[tuple[int, Frame, list[Reading]]]:
    """Number of every n-th frame, its picture (H, W) in grey, and its readings, one a circle."""
    full = max(1.3 * float(np.percentile(track.background.level, 95)), 1.0)
    of_frames = groupby(track.readings, key=lambda reading: reading.frame)
    for frame, (number, readings) in zip(movie.frames(), of_frames, strict=False):
        if number % every == 0:
            yield number, np.clip(255.0 * frame / full, 0, 255).astype(np.uint8), list(readings)


def outlined(movie: Movie, track: Track) -> Iterator[Frame]:
    """Coloured pictures (H, W, 3) of 8 bit, of even sides as videos need."""
    for _, small, readings in _frames(movie, track):
        scale = -(-WIDE // max(small.shape))
        large = np.kron(small, np.ones((scale, scale), np.uint8))
        picture = np.repeat(np.pad(large, [(0, side % 2) for side in large.shape])[..., None], 3, axis=2)
        for reading in readings:
            if reading.used and reading.outline is not None:
                around = np.linspace(0, 2 * np.pi, int(8 * reading.radius * scale) + 16)
                _draw(picture, (reading.outline.points(around) + 0.5) * scale)
        yield picture


def _draw(picture: Frame, points: Array) -> None:
    for shift in ((0, 0), (1, 0), (0, 1)):  # a line of two pixels, which a video with fewer colours than pixels keeps
        x, y = np.floor(points + shift).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
        picture[y[inside], x[inside]] = RED
