"""A simulated bubble as a movie: ``en4dvar simulate CONFIG --movie FILE --movie-set KEY=VALUE …``.

The settings are the fields of :class:`Camera` and of :class:`Scene`, which hold their words and defaults.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.units import UnitError, parse_quantity
from en4dvar_movie.flashes import parse_flashes
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.writing import require_suffix, write_movie

if TYPE_CHECKING:
    from en4dvar.config import Config

INSTANTS = 9  # of an exposure


@dataclass(frozen=True)
class Camera:
    """The camera, which turns metres and seconds into pixels and frames."""

    pixel: Annotated[float, "m", "size of a pixel"] = 2e-6
    exposure: Annotated[float, "s", "how long light falls on a frame, or how long a flash is"] = 0.0
    jitter: Annotated[float, "s", "std of the error of each frame's instant"] = 0.0
    flashes: Annotated[tuple[float, ...], "flashes of a frame after its instant, such as 0 us, 2 us"] = (0.0,)


def film(config: Config, times: Array | None, out: Path, settings: Mapping[str, str], seed: int) -> str:
    """Also write a movie of the bubble (.tif, .mp4 or .avi) with one frame per instant.

    Parameters
    ----------
    times: (K,) instants of the frames, evenly spaced; default those of the configuration.
    settings: text values of fields of :class:`Camera` and :class:`Scene`.

    Raises
    ------
    ConfigError: a setting is unknown or wrong, or the observable is no length. DataError: the file cannot be written.
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
    return (
        f"movie: {out}, {scene.before + len(at)} frames of {scene.shape[1]} × {scene.shape[0]} pixels of "
        f"{1e6 * camera.pixel:g} um; the first {scene.before} are empty, so that frame {scene.before} is at "
        f"{1e6 * at[0]:g} us; radii from {radii.min():.1f} to {radii.max():.1f} pixels"
    )


def exposures(times: Array, camera: Camera) -> Array:
    """Instants (K, S) at which each frame is exposed: all of a flash or of the exposure, in equal parts."""
    within = camera.exposure * np.linspace(-0.5, 0.5, INSTANTS) if camera.exposure else np.zeros(1)
    return np.asarray(times[:, None] + np.add.outer(np.array(camera.flashes), within).ravel())


def parse_settings(settings: Mapping[str, str]) -> tuple[Camera, Scene]:
    """Camera and scene of text values. Raises :class:`ConfigError` that says what there is."""
    camera, scene = Camera(), Scene()
    for key, text in settings.items():
        for target in (camera, scene):
            if key in {f.name for f in fields(target)}:
                break
        else:
            known = [f.name for kind in (Camera, Scene) for f in fields(kind)]
            raise ConfigError(f"movie: no setting {key!r}{suggest(key, known)}; there are:\n" + "\n".join(described()))
        with retold((ValueError, UnitError), ConfigError, f"movie: {key}={text}: "):
            changed = {key: _read(key, text, target)}
        camera = replace(camera, **changed) if target is camera else camera
        scene = replace(scene, **changed) if target is scene else scene
    return camera, _checked(scene)


def described() -> Iterator[str]:
    """A line for each setting: name, what it is, default."""
    for kind in (Camera, Scene):
        hints = get_type_hints(kind, include_extras=True)
        for f in fields(kind):
            default = "x".join(map(str, f.default)) if isinstance(f.default, tuple) else f.default
            unit = {"m": " m", "s": " s"}.get(hints[f.name].__metadata__[0], "")
            yield f"  {f.name}: {hints[f.name].__metadata__[-1]} (default {default}{unit})"


def _read(key: str, text: str, target: Any) -> Any:
    """A value of a field from text. Raises ValueError, UnitError."""
    hint = get_type_hints(type(target), include_extras=True)[key]
    if len(hint.__metadata__) == 2:  # a quantity
        value = parse_quantity(text, hint.__metadata__[0])
        if not value >= 0 or (key == "pixel" and not value > 0):
            raise ValueError("must be positive")
        return value
    if key == "flashes":
        return parse_flashes(text)
    if key in ("shape", "bubble"):
        kind, sign = (int, "x") if key == "shape" else (float, ",")
        parts = tuple(kind(part) for part in text.split(sign))
        if len(parts) != 2:
            raise ValueError(f"two numbers with {sign!r} between them")
        return parts[::-1] if key == "shape" else parts  # WIDTHxHEIGHT, as --raw
    return hint.__origin__(text)


def _checked(scene: Scene) -> Scene:
    """The scene, where it can be filmed. Raises :class:`ConfigError`."""
    faults = {
        "shape": min(scene.shape) < 16 or max(scene.shape) > 8192,
        "bits": scene.bits not in (8, 16),
        "contrast": not 0 < scene.contrast <= 1,
        "centre": not 0 <= scene.centre < 1,
        "shot": not 0 <= scene.shot <= 1,
        "level": not 0 < scene.level < 2**16,
        **{name: not 0 <= getattr(scene, name) < 1e3 for name in ("blur", "noise", "uneven", "drift", "ellipticity")},
        **{name: not 0 <= getattr(scene, name) < 100_000 for name in ("dirt", "before")},
    }
    wrong = [name for name, fault in faults.items() if fault]
    if wrong:
        raise ConfigError(f"movie: {wrong[0]}={getattr(scene, wrong[0])} cannot be filmed")
    return scene
