"""Movies with what laboratories' movies have and a tracker trips over, for ``python benchmarks/movies.py nasty``.

Nothing here is shared with the program: bubbles are sampled discs on a grid twice as fine, the blur is a lens out of
focus convolved with the wide-winged figure of a real objective (Moffat's), the light is counted in electrons. A
history rises, collapses and rebounds to rest. Lengths are pixels.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from scipy import fft

Array = npt.NDArray[np.float64]
Frame = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
FINE = 2  # sub-pixels to a side
INSTANTS = 5  # of an exposure
LENGTH = 36  # frames with the bubble
LEAST = 4.0  # pixels: radius from which a frame counts as good
SPLIT = 0.5  # pixels between two images in a frame from which it is not


@dataclass(frozen=True)
class Kind:
    """What a movie holds beside its bubble; the defaults are a clean one."""

    shape: tuple[int, int] = (112, 144)
    ratio: tuple[float, float] = (6.0, 30.0)  # contrast over noise
    defocus: float = 0.8  # radius of the disc that a point becomes
    exposure: float = 0.1  # of the step between frames
    centre: float = 0.0  # radius of the bright centre over that of the bubble
    second: str = ""  # another bubble: near, enters, beside
    marked: str = "spot"  # how the bubble is told from others: the laser's spot, a point, or nothing
    stamp: bool = False  # a time stamp that changes
    stripes: float = 0.0  # share of light in stripes that do not move
    bar: bool = False  # a scale bar with its words
    needle: bool = False  # a dark fibre that ends beside the bubble
    split: str = ""  # two images in a frame: interlaced, flashes
    shake: float = 0.0  # std of the camera's place from frame to frame
    flicker: float = 0.0  # std of the lamp's brightness
    jpeg: int = 0  # quality of the compression; 0: none
    specks: int = 0  # dark discs that drift
    shock: bool = False  # a dark ring that runs outwards
    bits: int = 8
    gone: bool = False  # the bubble leaves the frame


KINDS: dict[str, Kind] = {
    "clean": Kind(),
    "out of focus": Kind(defocus=3.5),
    "long exposure": Kind(exposure=0.4),
    "bright centre": Kind(centre=0.5),
    "portrait, 16 bit": Kind(shape=(160, 96), bits=16),
    "compressed": Kind(jpeg=60),
    "second bubble": Kind(second="near"),
    "second enters": Kind(second="enters"),
    "side by side, spot": Kind(second="beside"),
    "side by side, pointed at": Kind(second="beside", marked="point"),
    "side by side, unmarked": Kind(second="beside", marked=""),
    "time stamp": Kind(stamp=True),
    "stripes": Kind(stripes=0.25),
    "scale bar": Kind(bar=True),
    "needle": Kind(needle=True),
    "interlaced": Kind(split="interlaced"),
    "two flashes": Kind(split="flashes"),
    "faint": Kind(ratio=(1.5, 3.0)),
    "shaking camera": Kind(shake=0.7, bar=True),
    "flicker": Kind(flicker=0.06),
    "drifting specks": Kind(specks=6),
    "shock wave": Kind(shock=True),
    "leaves the frame": Kind(gone=True),
}
CLEAN = ("clean", "out of focus", "long exposure", "bright centre", "portrait, 16 bit")


@dataclass
class Filmed:
    """Frames (H, W); radius and centre of each bubble (B, K), NaN where there is none; ``good`` (K,) frames are those
    that a tracker should keep; ``point`` is where the user points."""

    frames: list[Frame]
    radius: Array
    centre: Array
    good: npt.NDArray[np.bool_]
    point: tuple[float, float] | None


@dataclass
class _Bubble:
    """``largest`` and resting radius, periods in frames; ``born`` is its first frame."""

    x: float
    y: float
    largest: float
    rest: float
    period: float
    born: float
    velocity: tuple[float, float] = (0.0, 0.0)
    steady: bool = False

    def radius(self, t: float) -> float:
        """At an instant in frames; 0 before it is born."""
        age = t - self.born
        if age < 0:
            return 0.0
        if self.steady:
            return self.largest
        age += 0.25 * self.period  # the growth is over in a quarter of a period
        peak, period = self.largest, self.period
        while age > period and peak > 1.15 * self.rest:
            age, period, peak = age - period, 0.62 * period, self.rest + 0.55 * (peak - self.rest)
        if peak <= 1.15 * self.rest:
            return self.rest
        turn = abs(2 * age / period - 1)
        least = 0.15 * peak
        return float(least + (peak - least) * max(1 - turn**2.2, 0.0) ** 0.5)

    def centre(self, t: float) -> tuple[float, float]:
        return self.x + self.velocity[0] * (t - self.born), self.y + self.velocity[1] * (t - self.born)


def film(name: str, seed: int) -> Filmed:
    """One movie of a kind."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, list(KINDS).index(name)])
    return _Set(kind, rng).film()


@dataclass
class _Set:
    kind: Kind
    rng: np.random.Generator
    before: int = 0
    level: float = 0.0
    depth: float = 0.0
    bubbles: list[_Bubble] = field(default_factory=list)

    def film(self) -> Filmed:
        kind, rng = self.kind, self.rng
        self.before = int(rng.integers(3, 7))
        self.level = rng.uniform(110, 180)
        self.depth = rng.uniform(0.4, 0.7)
        self.bubbles = self._bubbles()
        count = self.before + LENGTH
        self.light = self._lamp()
        self.kernel = self._spread()
        self.noise = self.depth * self.level / float(np.exp(rng.uniform(*np.log(kind.ratio))))
        self.specks = rng.uniform(0, 1, (kind.specks, 6))
        self.stamp_at = rng.uniform(0.02, 0.3)
        self.boxed = bool(rng.random() < 0.5)
        frames = [self._frame(k) for k in range(count)]
        images = (0.0, 0.5) if kind.split else (0.0,)  # a frame of two images is of their mean
        radius = np.array(
            [[np.mean([b.radius(k + s) for s in images]) or np.nan for k in range(count)] for b in self.bubbles]
        )
        centre = np.array([[b.centre(k) for k in range(count)] for b in self.bubbles])
        first = self.bubbles[0]
        point = (first.x, first.y) if kind.marked == "point" else None
        return Filmed(frames, radius, centre, self._good(radius, centre), point)

    def _bubbles(self) -> list[_Bubble]:
        kind, rng = self.kind, self.rng
        height, width = kind.shape
        largest = rng.uniform(15, 22) if kind.second == "beside" else rng.uniform(18, min(34, 0.4 * min(kind.shape)))
        if kind.second:
            largest = min(largest, 27.0)
        x, y = (width - 1) / 2 + rng.uniform(-4, 4), (height - 1) / 2 + rng.uniform(-4, 4)
        if kind.second:
            x = width * 0.3 + rng.uniform(-2, 2)
        first = _Bubble(
            x,
            y,
            largest,
            rng.uniform(0.25, 0.5) * largest,
            rng.uniform(9, 15),
            self.before - (0.2 if kind.split else 0.6),
        )
        if kind.gone:
            first.velocity = (rng.uniform(1.8, 2.6), rng.uniform(-0.3, 0.3))
        bubbles = [first]
        if kind.second == "near":
            bubbles.append(_Bubble(x + rng.uniform(57, 63), y + rng.uniform(-15, 15), rng.uniform(9, 16), 1, 1,
                                   self.before - 0.6, steady=True))  # fmt: skip
        elif kind.second == "enters":
            born = self.before + rng.uniform(8, 20)
            bubbles.append(_Bubble(width + 12, y + rng.uniform(-25, 25), rng.uniform(8, 15), 1, 1, born,
                                   (-rng.uniform(1.5, 3), 0.0), steady=True))  # fmt: skip
        elif kind.second == "beside":
            size = rng.uniform(15, 22)
            bubbles.append(_Bubble(x + rng.uniform(54, 62), y + rng.uniform(-8, 8), size, rng.uniform(0.25, 0.5) * size,
                                   rng.uniform(9, 15), self.before - 0.6))  # fmt: skip
        return bubbles

    def _good(self, radius: Array, centre: Array) -> npt.NDArray[np.bool_]:
        """Whole, not too small, apart from the other bubble, and still within the frame."""
        height, width = self.kind.shape
        r, (x, y) = radius[0], centre[0].T
        with np.errstate(invalid="ignore"):
            good = (r > LEAST) & (np.minimum.reduce([x, y, width - 1 - x, height - 1 - y]) > r + 2)
            for other, place in zip(radius[1:], centre[1:], strict=True):
                apart = np.hypot(*(place - centre[0]).T)
                good &= ~(apart < r + other + 6)
        if self.kind.split:
            b = self.bubbles[0]
            good &= [abs(b.radius(k) - b.radius(k + 0.5)) < SPLIT for k in range(len(r))]
        return good

    def _lamp(self) -> Array:
        height, width = self.kind.shape
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        a, b, c = self.rng.uniform(-0.08, 0.08, 3)
        light = 1 + a * x + b * y - abs(c) * (x * x + y * y)
        if self.kind.stripes:
            angle, pitch = self.rng.uniform(0, np.pi), self.rng.uniform(9, 22)
            j, i = np.indices(self.kind.shape)
            light *= 1 + self.kind.stripes * np.sign(
                np.sin(2 * np.pi * (i * np.cos(angle) + j * np.sin(angle)) / pitch)
            )
        if self.kind.needle:
            first, (j, i) = self.bubbles[0], np.indices(self.kind.shape)
            dark = (np.abs(i - first.x - 3) < self.rng.uniform(2, 4)) & (j < first.y - 0.75 * first.largest)
            light *= np.where(dark, 0.3, 1.0)
        return np.asarray(light)

    def _spread(self) -> Array:
        """The image of a point, as a transfer function of the fine grid."""
        height, width = (FINE * side for side in self._padded())
        y = np.minimum(np.arange(height), height - np.arange(height))[:, None] / FINE
        x = np.minimum(np.arange(width), width - np.arange(width)) / FINE
        r2 = x * x + y * y
        moffat = (1 + r2 / 1.1**2) ** -3.0
        disc = np.clip((self.kind.defocus - np.sqrt(r2)) * FINE + 0.5, 0, 1) + 1e-9 * (r2 == 0)
        return np.asarray(
            fft.rfft2(moffat / moffat.sum()) * fft.rfft2(disc / disc.sum()) if self.kind.defocus else fft.rfft2(moffat)
        )

    def _padded(self) -> tuple[int, int]:
        return self.kind.shape[0] + 24, self.kind.shape[1] + 24

    def _shade(self, t: float, moved: Array) -> Array:
        """Share of the light that all bubbles take at one instant (fine grid), without blur."""
        height, width = self._padded()
        left = np.ones((FINE * height, FINE * width))
        y = (np.arange(FINE * height)[:, None] - (FINE - 1) / 2) / FINE - 12
        x = (np.arange(FINE * width) - (FINE - 1) / 2) / FINE - 12
        for bubble in self.bubbles:
            R, (cx, cy) = bubble.radius(t), bubble.centre(t)
            if R <= 0:
                continue
            r = np.hypot(x - cx - moved[0], y - cy - moved[1])
            cover = np.clip((R - r) * FINE + 0.5, 0, 1)
            if self.kind.centre:
                cover -= 0.7 * np.clip((self.kind.centre * R - r) * FINE + 0.5, 0, 1)
            left *= 1 - self.depth * cover
        if self.kind.shock and 0 <= t - self.before < 6:
            first = self.bubbles[0]
            ring = np.hypot(x - first.x, y - first.y) - first.largest - 14 * (t - self.before + 0.3)
            left *= 1 - 0.35 * np.exp(-0.5 * (ring / 1.5) ** 2)
        for at in self.specks:
            px = at[0] * width - 12 + (t - 15) * 3 * (at[2] - 0.5)
            py = at[1] * height - 12 + (t - 15) * 3 * (at[3] - 0.5)
            left *= 1 - (0.3 + 0.5 * at[4]) * ((x - px) ** 2 + (y - py) ** 2 < (1 + 2 * at[5]) ** 2)
        return 1 - left

    def _seen(self, begin: float, length: float, moved: Array) -> Array:
        """Share of the light that is left (H, W) over an exposure."""
        total = np.mean([self._shade(begin + length * s, moved) for s in np.linspace(-0.5, 0.5, INSTANTS)], axis=0)
        blurred = fft.irfft2(fft.rfft2(total) * self.kernel, total.shape)
        height, width = self._padded()
        return np.asarray(1 - blurred.reshape(height, FINE, width, FINE).mean(axis=(1, 3))[12:-12, 12:-12])

    def _frame(self, k: int) -> Frame:
        kind, rng = self.kind, self.rng
        moved = kind.shake * rng.standard_normal(2)
        left = self._seen(k, kind.exposure, moved)
        if kind.split:
            later = self._seen(k + 0.5, kind.exposure, moved)
            if kind.split == "interlaced":
                left[1::2] = later[1::2]
            else:
                left = (left + later) / 2
        lamp = np.roll(self.light, tuple(np.rint(moved[::-1]).astype(int)), (0, 1)) if kind.shake else self.light
        light = self.level * lamp * left * (1 + kind.flicker * rng.standard_normal())
        if kind.marked == "spot" and k == self.before - 1:
            j, i = np.indices(kind.shape)
            spot = np.hypot(i - self.bubbles[0].x, j - self.bubbles[0].y)
            light = light + 400 * np.exp(-0.5 * (spot / 4) ** 2) + 60 * np.exp(-spot / 15)
        light = light + self.noise * np.sqrt(np.maximum(0.5 + 0.5 * light / self.level, 0)) * rng.standard_normal(
            light.shape
        )
        whole = np.clip(np.rint(light), 0, 255)
        if kind.stamp or kind.bar:
            whole = self._written(whole, k)
        if kind.jpeg:
            buffer = io.BytesIO()
            Image.fromarray(whole.astype(np.uint8)).save(buffer, format="JPEG", quality=kind.jpeg)
            whole = np.asarray(Image.open(buffer), dtype=float)
        if kind.bits == 8:
            return whole.astype(np.uint8)
        return np.clip(np.rint(200 * light), 0, 65535).astype(np.uint16)

    def _written(self, whole: Array, k: int) -> Array:
        picture = Image.fromarray(whole.astype(np.uint8))
        pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=11)
        height, width = whole.shape
        if self.kind.stamp:
            x = int(self.stamp_at * width)
            if self.boxed:
                pen.rectangle((x - 2, 0, x + 76, 14), fill=0)
            pen.text((x, 1), f"{37e-7 * (k + 9734):.7f} s", fill=255 if self.boxed else 10, font=font)
        if self.kind.bar:
            pen.rectangle((width - 56, height - 8, width - 10, height - 5), fill=255 if self.boxed else 0)
            pen.text((width - 52, height - 21), "100 um", fill=255 if self.boxed else 0, font=font)
        return np.asarray(picture, dtype=float)
