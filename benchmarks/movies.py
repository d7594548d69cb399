"""How good ``en4dvar track`` is: on a real movie, against a person, on rendered ones, against the truth; its speed.

python benchmarks/movies.py real          needs ../shared/data
python benchmarks/movies.py rendered 60 0 bias and coverage of 60 movies a class, from seed 0 on (and names of classes)
python benchmarks/movies.py nasty 20 0    what trips a tracker, 20 movies a kind (nasty_movies.py; and names of kinds)
python benchmarks/movies.py compressed 12 0 lossy video, 12 movies a codec
python benchmarks/movies.py speed         1000 frames of 512 × 512
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path

import numpy as np
from nasty_movies import KINDS
from nasty_movies import film as film_nasty
from scipy import ndimage

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.frames import Frame, Movie, open_movie
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import Track, track

SHARED = next((p / "shared" / "data" for p in Path(__file__).resolve().parents if (p / "shared").is_dir()), Path())
CLASSES = {
    "in focus": {},
    "blurred": {"blur": 3.0},
    "moving fast": {},
    "bright centre": {"centre": 0.45},
    "drift": {"drift": 0.4},
    "ellipse": {"ellipticity": 0.03},
    "overflow": {"shape": (64, 128)},
    "dirt": {"dirt": 24},
    "three flashes, 3 to 8 px apart": {},
    "three flashes, 0 to 3 px apart": {},
}
CODECS = [("mpeg4",), ("mjpeg",), *(("libx264", ("crf", str(crf))) for crf in (30, 23, 18))]
FRAMES = 12  # of a movie; of ellipsoids, one a movie, fewer in more movies
ELLIPSES = 3


def against_a_person() -> tuple[Track, Array]:
    """The real movie's track, and its radii minus those fitted by hand (98,), in pixels; NaN where not read."""
    import scipy.io

    by_hand = scipy.io.loadmat(SHARED / "PAstiff_xy002_RofT.mat")["Rnew"].ravel()
    found = track(open_movie(SHARED / "PAstiff_xy002.mp4"), 2)
    return found, np.array([r.radius - by_hand[r.frame] for r in found.readings if by_hand[r.frame] > 0])


def from_the_steepest(found: Track, first: int = 60) -> Array:
    """The real movie's radii in frames of rest minus those where the mean brightness about the outline grows fastest,
    in pixels: blur moves no edge's steepest place, and no contrast is needed for it."""
    shown, off = list(open_movie(SHARED / "PAstiff_xy002.mp4").frames()), np.arange(-7, 7.01, 0.1)
    angles, differ = np.linspace(0, 2 * np.pi, 360, endpoint=False), []
    for reading in found.readings[first:]:
        if reading.outline is None:
            continue
        at = reading.outline.points(angles) + off[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        light = ndimage.map_coordinates(shown[reading.frame].astype(float), at.T[::-1], order=3).mean(axis=0)
        slope = np.gradient(ndimage.gaussian_filter1d(light, 4))
        near = np.abs(off - off[np.argmax(slope)]) < 1
        bend, lean, _ = np.polyfit(off[near], slope[near], 2)
        differ.append(lean / (2 * bend))
    return np.array(differ)


def movie_of(frames: list[Frame]) -> Movie:
    """A movie in memory."""

    def read() -> Iterator[Frame]:
        yield from frames

    return Movie(Path("rendered"), read, len(frames), 1e-6, 1e5)


def film(kind: str, number: int) -> tuple[Array, list[Frame]]:
    """Radii (K,) in the middle of the exposures, (K, 3) at three flashes, and the frames, empty ones first."""
    rng = np.random.default_rng([number, list(CLASSES).index(kind)])
    scene = Scene(**CLASSES[kind])  # type: ignore[arg-type]
    ratio = float(np.exp(rng.uniform(np.log(3), np.log(30))))
    centre = (np.array(scene.shape[::-1]) - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
    scene = replace(scene, noise=scene.contrast * scene.level / ratio, bubble=tuple(centre))
    count = ELLIPSES if kind == "ellipse" else FRAMES
    low, high = (36, 58) if kind == "overflow" else (8 if kind != "blurred" else 12, 42)
    middle = rng.uniform(low, high, count)
    speed = rng.uniform(2, 5, count) if kind == "moving fast" else np.zeros(count)
    if kind.startswith("three"):  # of one frame, each of a flash so short that it does not move
        apart = rng.uniform(*((3, 8) if "8" in kind else (0, 3)), (count, 2))
        middle = middle[:, None] + np.cumsum(np.column_stack([np.zeros(count), apart]), axis=1)
        return middle, list(render(middle, scene, rng))
    radii = middle[:, None] + np.minimum(speed, 0.2 * middle)[:, None] * np.linspace(-0.5, 0.5, 9)
    return middle, list(render(radii, scene, rng))


def rendered(kind: str, number: int) -> tuple[Array, Array]:
    """Errors of the radii of one rendered movie in stated std, that of a lasting shape included, and in pixels; NaN
    where a frame was not read."""
    truth, frames = film(kind, number)
    flashes = (0.0, 0.25, 0.5) if truth.ndim == 2 else (0.0,)
    found = track(replace(movie_of(frames), rate=1.0), flashes=flashes)
    readings = [sorted(f, key=lambda r: r.radius) for _, f in groupby(found.readings, key=lambda r: r.frame)]
    read = [f if len(f) == len(flashes) else f * len(flashes) for f in readings[Scene.before :]]
    wrong = np.array([[r.radius for r in f] for f in read]) - np.sort(truth.reshape(len(truth), -1), axis=1)
    stated = np.array([[np.hypot(r.errors.std, r.errors.factor * r.radius) for r in f] for f in read])
    return (wrong / stated).ravel(), wrong.ravel()


def tell_rendered(movies: int, first: int, kinds: Iterable[str]) -> None:
    for kind in kinds:
        count = movies * (FRAMES // ELLIPSES if kind == "ellipse" else 1)
        pairs = [rendered(kind, number) for number in range(first, first + count)]
        scores, wrong = (np.concatenate(part) for part in zip(*pairs, strict=True))
        read = np.isfinite(scores)
        held = np.mean(np.abs(scores[read]) < 1.6449)
        print(
            f"{kind:30s} read {read.mean():6.1%}  bias {np.mean(wrong[read]):+.3f} px  "
            f"rms {np.sqrt(np.mean(wrong[read] ** 2)):.3f} px  90 % intervals hold {held:.1%} of {read.sum()}",
            flush=True,
        )


def nasty(kind: str, number: int) -> dict[str, Array]:
    """Of the frames of one movie (K,): error in pixels (NaN: not used), the same in stated std, whether it is good.

    ``own`` is the error in std without what all frames of the movie share, which is no independent error.
    """
    filmed = film_nasty(kind, number)
    try:
        movie, kind_of = replace(movie_of(filmed.frames), rate=1.0), KINDS[kind]
        readings = track(movie, point=filmed.point, exposure=kind_of.exposure).readings
    except DataError:
        nothing = np.full(len(filmed.frames), np.nan)
        return {"wrong": nothing, "score": nothing, "own": nothing, "good": filmed.good}
    radius, std = np.array([(r.radius, r.errors.std) if r.used else (np.nan, np.nan) for r in readings]).T
    candidates = [np.where(np.isnan(truth), 1e3, radius - truth) for truth in filmed.radius]
    at_most = 1 if kind_of.marked else len(candidates)  # without a mark any bubble will do, if it is the same one
    wrong = min(candidates[:at_most], key=lambda off: float(np.nansum(np.abs(off))))
    wrong[np.isnan(radius)] = np.nan
    near = (np.abs(wrong) <= np.maximum(5 * std, 2)) & filmed.good
    weight = np.where(near, 1 / std**2, 0.0)
    shared = np.nansum(weight * wrong) / max(np.nansum(weight), 1e-30)
    left = np.sqrt(np.maximum(1 - weight / max(np.nansum(weight), 1e-30), 1e-3))
    return {
        "wrong": wrong,
        "score": wrong / std,
        "own": np.where(near, (wrong - shared) / std / left, np.nan),
        "good": filmed.good,
    }


def tell_nasty(movies: int, first: int, kinds: Iterable[str]) -> None:
    print(
        f"{'kind':26s} {'used':>5s} {'wrong':>6s} {'of good kept':>12s} {'rms px':>7s} {'std of z':>8s} {'worst z':>7s}"
    )
    bad = used = kept = good = 0
    for kind in kinds:
        parts = [nasty(kind, number) for number in range(first, first + movies)]
        of = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
        read = np.isfinite(of["wrong"])
        fell = read & (np.abs(of["wrong"]) > 2) & (np.abs(of["score"]) > 5)
        keep = read & ~fell & of["good"].astype(bool)
        z = of["own"][np.isfinite(of["own"])]
        print(
            f"{kind:26s} {read.sum():5d} {fell.sum():6d} {keep.sum() / of['good'].sum():12.1%} "
            f"{np.sqrt(np.mean(of['wrong'][keep] ** 2)):7.3f} {np.std(z):8.2f} {np.abs(z).max(initial=0):7.1f}",
            flush=True,
        )
        bad, used, kept, good = bad + fell.sum(), used + read.sum(), kept + keep.sum(), good + of["good"].sum()
    print(f"{used} frames used, {bad} ({bad / used:.2%}) beyond 5 std and 2 px; {kept / good:.1%} of good frames kept")


def tell_compressed(movies: int, first: int) -> None:
    """The std of z of a collapse and its rebounds, of noise of 1.5 and 4 of 150 grey levels, and the size of a file."""
    import av

    radii = 5 + 30 * np.abs(np.cos(np.arange(40) * np.pi / 26)) ** 0.7
    with tempfile.TemporaryDirectory() as folder:
        for (codec, *options), noise in product(CODECS, (1.5, 4.0)):
            path = Path(folder) / f"m{'.mp4' if codec == 'libx264' else '.avi'}"
            scores, bits = [], 0.0
            for number in range(first, first + movies):
                frames = list(render(radii[:, None], Scene(noise=noise), np.random.default_rng(number)))
                with av.open(str(path), "w") as file:
                    stream = file.add_stream(codec, rate=25, options=dict(options))
                    stream.height, stream.width = frames[0].shape
                    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
                    for frame in frames:
                        file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
                    file.mux(stream.encode())
                bits += 8 * path.stat().st_size / (len(frames) * frames[0].size * movies)
                read = track(open_movie(path), 2).readings[Scene.before :]
                scores += [(r.radius - R) / r.errors.std for r, R in zip(read, radii, strict=True)]
            z = np.array(scores)[np.isfinite(scores)]
            held = np.mean(np.abs(z) < 1.6449)
            name = " ".join((codec, *map(" ".join, options)))
            print(f"{name:16} noise {noise}: {bits:.2f} bit a pixel, std of z {z.std():.2f}, 90 % hold {held:.0%}")


def tell_speed(count: int = 1000) -> None:
    import tifffile

    rng = np.random.default_rng(1)
    radii = 60 + 40 * np.sin(np.arange(20) / 3)
    few = list(render(radii[:, None], Scene(shape=(512, 512), bubble=(255.2, 256.1)), rng))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "movie.tif"
        for frames, n in ((count // 5, 2), (count, 2), (count, 1)):
            with tifffile.TiffWriter(path) as file:
                for k in range(frames):
                    file.write(few[k if k < 3 else 3 + (k - 3) % 20], contiguous=True)
            begun, busy = time.perf_counter(), time.process_time()
            track(open_movie(path), n)
            took, busy = time.perf_counter() - begun, time.process_time() - busy
            most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # KiB on Linux
            print(f"{frames} frames, {n} workers: {took:.1f} s, {busy:.1f} s of CPU; {most:.0f} MiB at most")


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else "rendered"
    if what == "real":
        found, off = against_a_person()
        size = np.abs(off)
        print(f"{len(off)} frames: median difference {np.median(off):+.3f} px, of its size {np.median(size):.3f} px")
        print(f"within 1 px {np.mean(size < 1):.1%}, within 2 px {np.mean(size < 2):.2%}, worst {size.max():.1f} px")
        print(f"at rest, median from where the light grows fastest: {np.median(from_the_steepest(found)):+.3f} px")
    elif what == "speed":
        tell_speed()
    elif what == "compressed":
        tell_compressed(*map(int, sys.argv[2:4] or ("12", "0")))
    elif what == "nasty":
        movies, first = (*map(int, sys.argv[2:4]), *(20, 0)[len(sys.argv[2:4]) :])
        tell_nasty(movies, first, sys.argv[4:] or KINDS)
    else:
        movies, first = (*map(int, sys.argv[2:4]), *(60, 0)[len(sys.argv[2:4]) :])
        tell_rendered(movies, first, sys.argv[4:] or CLASSES)
