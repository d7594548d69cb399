"""Compiled loops over pixels: the blurred outline, its normal equations, and what each sector of it says.

The image near the outline is modelled as

    m(r, θ) = b + c Φ((ρ(θ) − r)/w) + g Φ((ρ_g − r)/w),      ρ(θ) = R + Σ_{n≥2} A_n cos nθ + B_n sin nθ,

in polar coordinates about the centre (x, y): an edge of width w (std of the blur), contrast c, and the bright centre of
a bubble that acts as a lens, g and ρ_g. The order of the parameters is that of :data:`NAMES`, then A_2, B_2, A_3, …
"""

from __future__ import annotations

import math

import numpy as np

from en4dvar.compiled import kernel

NAMES = ("x", "y", "R", "w", "b", "c", "g", "rho_g")
SHAPE = len(NAMES)  # the first mode's place
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1 / math.sqrt(2 * math.pi)


@kernel
def _normal(z):  # Φ and its derivative
    return 0.5 * math.erfc(-z * _ROOT_HALF), _DENSITY * math.exp(-0.5 * z * z)


@kernel
def _row(j, i, p, modes, row):
    """The model at a pixel; ``row`` (P,) gets its derivatives."""
    dx, dy = i - p[0], j - p[1]
    r = math.sqrt(dx * dx + dy * dy) + 1e-9
    cos, sin = dx / r, dy / r
    rho, slope = p[2], 0.0
    cn, sn = cos, sin
    for n in range(2, modes + 1):
        cn, sn = cn * cos - sn * sin, sn * cos + cn * sin
        k = 8 + 2 * (n - 2)
        row[k], row[k + 1] = cn, sn
        rho += p[k] * cn + p[k + 1] * sn
        slope += n * (p[k + 1] * cn - p[k] * sn)  # dρ/dθ
    w = p[3]
    z, zg = (rho - r) / w, (p[7] - r) / w
    F, f = _normal(z)
    G, g = _normal(zg)
    edge = p[5] * f / w
    glare = p[6] * g / w
    # r falls by cos as x grows, θ grows by sin/r: both move the edge
    row[0] = edge * (cos + slope * sin / r) + glare * cos
    row[1] = edge * (sin - slope * cos / r) + glare * sin
    row[2] = edge
    row[3] = -edge * z - glare * zg
    row[4] = 1.0
    row[5] = F
    row[6] = G
    row[7] = glare
    for k in range(8, 8 + 2 * (modes - 1)):
        row[k] *= edge
    return p[4] + p[5] * F + p[6] * G


@kernel
def _weight(u):
    """Tukey's bisquare of a residual in units of its cutoff."""
    return (1 - u * u) ** 2 if abs(u) < 1 else 0.0


@kernel
def _bounds(shape, x, y, reach):
    return (
        max(0, math.floor(y - reach)),
        min(shape[0], math.ceil(y + reach) + 1),
        max(0, math.floor(x - reach)),
        min(shape[1], math.ceil(x + reach) + 1),
    )


@kernel
def residuals(image, p, modes, ring):
    """Residuals (n,) of the pixels whose distance from ``ring[:2]`` lies between ``ring[2]`` and ``ring[3]``."""
    row = np.zeros(8 + 2 * (modes - 1))
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    found = np.empty(max(0, bottom - top) * max(0, right - left))
    n = 0
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if ring[2] ** 2 <= far <= ring[3] ** 2:
                found[n] = image[j, i] - _row(j, i, p, modes, row)
                n += 1
    return found[:n]


@kernel
def normal_equations(image, p, modes, ring, cutoff):
    """JᵀWJ (P, P), JᵀWr (P,), Σ w r², Σ w and the robust cost, W of Tukey's bisquare with ``cutoff``."""
    size = 8 + 2 * (modes - 1)
    row = np.zeros(size)
    A = np.zeros((size, size))
    g = np.zeros(size)
    squares = total = cost = 0.0
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if far < ring[2] ** 2 or far > ring[3] ** 2:
                continue
            r = image[j, i] - _row(j, i, p, modes, row)
            u = min(1.0, abs(r) / cutoff)
            cost += 1 - (1 - u * u) ** 3
            w = _weight(u)
            if w == 0.0:
                continue
            squares += w * r * r
            total += w
            for a in range(size):
                s = w * row[a]
                g[a] += s * r
                for b in range(a + 1):
                    A[a, b] += s * row[b]
    for a in range(size):
        for b in range(a):
            A[b, a] = A[a, b]
    return A, g, squares, total, cost * cutoff * cutoff / 6


@kernel
def influence(image, p, modes, ring, cutoff, weights, sectors):
    """What moves the radius: Σ of u_i = (weights·J_i) ψ_i by sector (S,), Σ u_i² over pixels, and Σ ψ'_i / Σ w_i."""
    row = np.zeros(8 + 2 * (modes - 1))
    sums = np.zeros(sectors)
    squares = slopes = total = 0.0
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if far < ring[2] ** 2 or far > ring[3] ** 2:
                continue
            r = image[j, i] - _row(j, i, p, modes, row)
            u = 0.0
            for a in range(len(row)):
                u += weights[a] * row[a]
            v = min(1.0, (r / cutoff) ** 2)
            slopes += (1 - v) * (1 - 5 * v)
            total += (1 - v) ** 2
            u *= r * (1 - v) ** 2
            turn = math.atan2(j - p[1], i - p[0]) / (2 * math.pi) + 0.5
            sums[min(sectors - 1, int(turn * sectors))] += u
            squares += u * u
    return sums, squares, slopes / total


@kernel
def normalise(frame, level, gain, step):
    """(frame − level) gain (H, W), and its means over tiles of ``step`` × ``step`` pixels."""
    height, width = frame.shape
    image = np.empty((height, width), dtype=np.float32)
    tiles = np.zeros((height // step, width // step), dtype=np.float32)
    for j in range(height):
        for i in range(width):
            value = (np.float32(frame[j, i]) - level[j, i]) * gain[j, i]
            image[j, i] = value
            if j // step < tiles.shape[0] and i // step < tiles.shape[1]:
                tiles[j // step, i // step] += value
    return image, tiles / np.float32(step * step)
