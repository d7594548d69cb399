"""The page that shows the work: a strip of frames with their outlines, radius and shape in time, what was left out."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from en4dvar.report.palette import DARK, LIGHT, css_variables
from en4dvar.report.style import inline_svg, styled
from en4dvar_movie.frames import Frame, Movie
from en4dvar_movie.outline import MODES
from en4dvar_movie.outlined import brightest, by_frame, grey
from en4dvar_movie.table import Scale
from en4dvar_movie.tracking import Reading, Track

SHOWN = 60  # frames of the strip
SIDE = 240  # pixels of a picture, at most
TURN = np.linspace(0, 2 * np.pi, 121)


def page_text(movie: Movie, found: Track, scale: Scale, command: str) -> str:
    """The page, one file without addresses."""
    environment = Environment(
        loader=PackageLoader("en4dvar_movie", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    used = [r for r in found.readings if r.used]
    return environment.get_template("page.html.j2").render(
        light=Markup(css_variables(LIGHT)),
        dark=Markup(css_variables(DARK)),
        movie=movie.path.name,
        notes=movie.notes,
        command=command,
        count=len(found.readings),
        used=len(used),
        what="frames" if len(found.flashes) == 1 else "circles",
        scale=f"{1e6 * scale.pixel:.6g} µm a pixel, {scale.rate:.6g} frames a second",
        background=found.background.frames,
        common=f"{float(np.median([r.errors.common for r in used])) * 1e6 * scale.pixel:.2g}" if used else "",
        figures=[inline_svg(draw(used, scale), name, name) for name, draw in (("radius", _radius), ("shape", _shape))],
        strip=_strip(movie, found),
        left_out=[r for r in found.readings if not r.used],
        remarks=[r for r in used if r.reason],
    )  # fmt: skip


@styled
def _radius(used: list[Reading], scale: Scale) -> Figure:
    figure = Figure(figsize=(6.8, 2.6), layout="constrained")
    ax = figure.subplots()
    um = 1e6 * scale.pixel
    ax.errorbar(
        [1e6 * scale.time(r.found) for r in used], [um * r.radius for r in used],
        yerr=[1.645 * um * r.errors.std for r in used],
        fmt="o", ms=2.5, color=LIGHT["ink"], ecolor=LIGHT["centre"], elinewidth=1, capsize=1.5,
    )  # fmt: skip
    ax.set(xlabel="time (µs)", ylabel="radius (µm), 90 %")
    return figure


@styled
def _shape(used: list[Reading], scale: Scale) -> Figure:
    figure = Figure(figsize=(6.8, 2.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    times = [1e6 * scale.time(r.found) for r in used]
    outlines = [r.found.outline for r in used]
    left.plot(times, [o.eccentricity if o else np.nan for o in outlines], ".", ms=3, color=LIGHT["ink"])
    left.set(xlabel="time (µs)", ylabel="eccentricity")
    for n in range(2, MODES + 1):
        part = [o.amplitude(n) / o.circle.R if o else np.nan for o in outlines]
        right.plot(
            times,
            part,
            lw=0.9,
            alpha=1 - 0.15 * (n - 2),
            color=LIGHT["centre"],
            ls=["-", "--", "-.", ":", "-"][n - 2],
            label=f"{n}",
        )
    right.set(xlabel="time (µs)", ylabel="mode over radius")
    right.legend(title="mode", ncols=2)
    return figure


def _strip(movie: Movie, found: Track) -> list[dict[str, Any]]:
    """Evenly chosen frames as pictures, each with its outline as a path over it."""
    circles = by_frame(found.readings)
    every = -(-len(circles) // SHOWN)
    full = brightest(found)
    return [
        _picture(number, frame, circles[number], full)
        for number, frame in enumerate(movie.frames())
        if number % every == 0 and number in circles
    ]


def _picture(number: int, frame: Frame, readings: list[Reading], full: float) -> dict[str, Any]:
    step = -(-max(frame.shape) // SIDE)
    small = grey(frame[::step, ::step], full)
    outlines = [r.found.outline.points(TURN) / step for r in readings if r.found.outline is not None and r.used]
    return {
        "frame": str(number),
        "png": png(small),
        "width": str(small.shape[1]),
        "height": str(small.shape[0]),
        "outlines": [" ".join(f"{x + 0.5:.2f},{y + 0.5:.2f}" for x, y in points) for points in outlines],
        "words": "; ".join(dict.fromkeys(r.reason for r in readings if r.reason)),
    }


def png(picture: Frame) -> str:
    """A picture of 8 bit as base64."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=False)
    return base64.b64encode(buffer.getvalue()).decode()
