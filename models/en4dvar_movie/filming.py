"""A simulated bubble as a movie: ``en4dvar simulate CONFIG --movie FILE --movie-set KEY=VALUE …``.

The settings are the fields of :class:`Camera` and of :class:`Scene`, which hold their words and defaults.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_type_hints

import numpy as np
from annotated_types import Ge, Gt
from pydantic import BeforeValidator, TypeAdapter, ValidationError

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.units import Quantity
from en4dvar_movie.flashes import parse_flashes
from en4dvar_movie.frames import require_suffix, write_movie
from en4dvar_movie.scene import Scene, render

if TYPE_CHECKING:
    from en4dvar.config import Config

INSTANTS = 9  # of an exposure
Instants = Annotated[tuple[float, ...], BeforeValidator(parse_flashes)]


@dataclass(frozen=True)
class Camera:
    """The camera, which turns metres and seconds into pixels and frames."""

    pixel: Annotated[float, "size of a pixel", Quantity("m"), Gt(0)] = 2e-6
    exposure: Annotated[float, "how long light falls on a frame, or how long a flash is", Quantity("s"), Ge(0)] = 0.0
    jitter: Annotated[float, "std of the error of each frame's instant", Quantity("s"), Ge(0)] = 0.0
    flashes: Annotated[Instants, "flashes of a frame after its instant, such as 0 us, 2 us"] = (0.0,)


def film(config: "Config", times: Array | None, out: Path, settings: Mapping[str, str], seed: int) -> str:
    """Also write a movie of the bubble (.tif, .mp4 or .avi) with one frame per instant.

    ``times``: (K,) instants of the frames, evenly spaced; default those of the configuration. ``settings``: text values
    of fields of :class:`Camera` and :class:`Scene`.

    Raises ConfigError: a setting is unknown or wrong, or the observable is no length. DataError: the file cannot be
    written.
    """
    from en4dvar.runs.simulation import simulate

    camera, scene = parse_settings(settings)
    if config.observable.unit != "m":
        raise ConfigError(f"a movie shows a radius; {config.observable.name} is in {config.observable.unit}")
    at = simulate(config, None).times if times is None else times
    steps = np.diff(at)
    if len(at) < 2 or np.ptp(steps) > 1e-6 * steps.mean():
        raise ConfigError("the frames of a movie are evenly spaced: give --times FROM:TO:STEP")
    require_suffix(out)
    rng = np.random.default_rng(seed)
    exposed = exposures(at + camera.jitter * rng.standard_normal(len(at)), camera)
    instants, where = np.unique(np.maximum(exposed, at[0]), return_inverse=True)  # before the first the bubble rests
    radii = simulate(config, instants).values[where].reshape(exposed.shape) / camera.pixel
    frames = render(radii, scene, rng)
    write_movie(out, frames, scene.before + len(at), camera.pixel, 1 / float(steps.mean()))
    empty, (height, width), first = scene.before, scene.shape, 1e6 * (at[0] - scene.before * steps.mean())
    cut = "; the frame cuts the outline, a larger shape or pixel shows it" * bool(2 * radii.max() > min(scene.shape))
    return (
        f"movie: {out}, {empty + len(at)} frames of {width} × {height} pixels of {1e6 * camera.pixel:g} um; the first "
        f"{empty} are empty, so that frame {empty} is at {1e6 * at[0]:g} us and frame 0, from which 'track' counts, "
        f"at {round(first, 6) + 0:g} us; radii from {radii.min():.1f} to {radii.max():.1f} pixels{cut}"
    )


def exposures(times: Array, camera: Camera) -> Array:
    """Instants (K, S) at which each frame is exposed: all of a flash or of the exposure, in equal parts."""
    within = camera.exposure * np.linspace(-0.5, 0.5, INSTANTS) if camera.exposure else np.zeros(1)
    return np.asarray(times[:, None] + np.add.outer(np.array(camera.flashes), within).ravel())


def parse_settings(settings: Mapping[str, str]) -> tuple[Camera, Scene]:
    """Camera and scene of text values. Raises :class:`ConfigError` that says what there is."""
    kinds = {f.name: kind for kind in (Camera, Scene) for f in fields(kind)}
    for key in settings:
        if key not in kinds:
            raise ConfigError(f"movie: no setting {key!r}{suggest(key, kinds)}; there are:\n" + "\n".join(described()))
    of_camera, of_scene = ({k: v for k, v in settings.items() if kinds[k] is kind} for kind in (Camera, Scene))
    try:
        return TypeAdapter(Camera).validate_python(of_camera), TypeAdapter(Scene).validate_python(of_scene)
    except ValidationError as error:
        fault = error.errors()[0]
        key, words = str(fault["loc"][0]), fault["msg"].removeprefix("Value error, ")
        raise ConfigError(f"movie: {key}={settings[key]} cannot be filmed: {words}") from None


def described() -> Iterator[str]:
    """A line for each setting: name, what it is, default."""
    for kind in (Camera, Scene):
        hints = get_type_hints(kind, include_extras=True)
        for f in fields(kind):
            default = "x".join(map(str, f.default)) if isinstance(f.default, tuple) else f.default
            about = hints[f.name].__metadata__
            words = next(part for part in about if isinstance(part, str))
            unit = next((f" {part.unit}" for part in about if isinstance(part, Quantity)), "")
            yield f"  {f.name}: {words} (default {default}{unit})"
