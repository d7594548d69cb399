"""The compiled loops over pixels, used on a movie of a few small frames."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from en4dvar_movie.frames import Movie
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    return {f"movie of {bits} bit": partial(_track, bits) for bits in (8, 16)}


def _track(bits: int) -> None:
    frames = list(render(np.full((2, 1), 8.0), Scene(shape=(32, 32), bits=bits), np.random.default_rng(0)))
    track(Movie(Path("rendered"), lambda: iter(frames), len(frames)))
