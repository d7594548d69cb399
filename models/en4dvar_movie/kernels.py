"""Compiled loops over pixels: the blurred outline, its normal equations, and what each sector of it says.

The image near the outline is modelled as

    m(r, θ) = b + c/S Σ_s Φ((ρ(θ) − d_s − r)/w) + g Φ((ρ_g − r)/w),      ρ(θ) = R + Σ_{n≥2} A_n cos nθ + B_n sin nθ,

in polar coordinates about the centre (x, y): an edge of width w (std of the blur), contrast c, and the bright centre of
a bubble that acts as a lens, g and ρ_g. Where S flashes light one exposure, S nested circles share the contrast; the
outermost has the radius R, the others lie d_s inside it. The order of the parameters is that of :data:`NAMES`, then
A_2, B_2, A_3, … and d_2, d_3, … Pixels that are not looked at are NaN.
"""

from __future__ import annotations

import math

import numpy as np

from en4dvar.plumbing.compiled import kernel, summing_kernel

NAMES = ("x", "y", "R", "w", "b", "c", "g", "rho_g")
SHAPE = len(NAMES)  # the first mode's place
FAR = 7.0  # widths from an edge where nothing of it is left in double precision but 1e-12
BLOCK = 64  # pixels
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1 / math.sqrt(2 * math.pi)


@kernel
def _normal(z):  # Φ and its derivative
    if z < -FAR or z > FAR:
        return (1.0 if z > 0 else 0.0), 0.0
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
    gaps = 8 + 2 * (modes - 1)  # the place of d_2
    circles = 1 + len(p) - gaps
    F, edge, wider = 0.0, 0.0, 0.0
    for s in range(circles):
        z = (rho - (p[gaps + s - 1] if s else 0.0) - r) / w
        part, f = _normal(z)
        f *= p[5] / circles / w
        F += part / circles
        edge += f
        wider += f * z
        if s:
            row[gaps + s - 1] = -f
    zg = (p[7] - r) / w
    G, g = _normal(zg)
    glare = p[6] * g / w
    # r falls by cos as x grows, θ grows by sin/r: both move the edge
    row[0] = edge * (cos + slope * sin / r) + glare * cos
    row[1] = edge * (sin - slope * cos / r) + glare * sin
    row[2] = edge
    row[3] = -wider - glare * zg
    row[4] = 1.0
    row[5] = F
    row[6] = G
    row[7] = glare
    for k in range(8, gaps):
        row[k] *= edge
    return p[4] + p[5] * F + p[6] * G


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
    row = np.zeros(len(p))
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    values = np.empty(max(0, bottom - top) * max(0, right - left))
    n = 0
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if ring[2] ** 2 <= far <= ring[3] ** 2 and not math.isnan(image[j, i]):
                values[n] = image[j, i] - _row(j, i, p, modes, row)
                n += 1
    return values[:n]


@summing_kernel
def _add(A, rows, weights):
    """A += Σ_k weights_k rows_k rows_kᵀ of rows (P, BLOCK), below the diagonal."""
    scaled = np.empty(BLOCK)
    for a in range(len(A)):
        for k in range(BLOCK):
            scaled[k] = rows[a, k] * weights[k]
        for b in range(a + 1):
            total = 0.0
            for k in range(BLOCK):
                total += scaled[k] * rows[b, k]
            A[a, b] += total


@kernel
def normal_equations(image, p, modes, ring, cutoff):
    """JᵀWJ (P, P), JᵀWr (P,), Σ w r², Σ w and the robust cost, W of Tukey's bisquare with ``cutoff``."""
    size = len(p)
    row = np.zeros(size)
    rows = np.zeros((size, BLOCK))  # of pixels whose products are added together, which is quicker
    weights = np.zeros(BLOCK)
    n = 0
    A = np.zeros((size, size))
    g = np.zeros(size)
    squares = total = cost = 0.0
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if far < ring[2] ** 2 or far > ring[3] ** 2 or math.isnan(image[j, i]):
                continue
            r = image[j, i] - _row(j, i, p, modes, row)
            u = min(1.0, abs(r) / cutoff)
            cost += 1 - (1 - u * u) ** 3
            w = (1 - u * u) ** 2
            if w == 0.0:
                continue
            squares += w * r * r
            total += w
            for a in range(size):
                rows[a, n] = row[a]
                g[a] += w * row[a] * r
            weights[n] = w
            n += 1
            if n == BLOCK:
                _add(A, rows, weights)
                n = 0
    weights[n:] = 0.0
    _add(A, rows, weights)
    for a in range(size):
        for b in range(a):
            A[b, a] = A[a, b]
    return A, g, squares, total, cost * cutoff * cutoff / 6


@kernel
def influence(image, p, modes, ring, cutoff, weights, sectors):
    """Influence of each pixel on the radius, u_i = (weights·J_i) ψ_i of each pixel, in its sums.

    Σ u_i by sector (K,), Σ u_i² over pixels, Σ ψ'_i / Σ w_i, and by sector JᵀWJ·weights (K, P): what a fit takes out.
    """
    row = np.zeros(len(p))
    sums = np.zeros(sectors)
    fitted = np.zeros((sectors, len(p)))
    squares = slopes = total = 0.0
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if far < ring[2] ** 2 or far > ring[3] ** 2 or math.isnan(image[j, i]):
                continue
            r = image[j, i] - _row(j, i, p, modes, row)
            u = 0.0
            for a in range(len(row)):
                u += weights[a] * row[a]
            v = min(1.0, (r / cutoff) ** 2)
            slopes += (1 - v) * (1 - 5 * v)
            total += (1 - v) ** 2
            turn = math.atan2(j - p[1], i - p[0]) / (2 * math.pi) + 0.5
            k = min(sectors - 1, int(turn * sectors))
            for a in range(len(row)):
                fitted[k, a] += (1 - v) ** 2 * row[a] * u
            u *= r * (1 - v) ** 2
            sums[k] += u
            squares += u * u
    return sums, squares, slopes / total, fitted


@kernel
def of_rows(image, p, modes, ring):
    """Of even and of odd rows (2,): Σ (dm/dR)² and Σ r dm/dR; their quotient is how much larger they show it."""
    row = np.zeros(len(p))
    squares, sums = np.zeros(2), np.zeros(2)
    top, bottom, left, right = _bounds(image.shape, ring[0], ring[1], ring[3])
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - ring[0]) ** 2 + (j - ring[1]) ** 2
            if far < ring[2] ** 2 or far > ring[3] ** 2 or math.isnan(image[j, i]):
                continue
            r = image[j, i] - _row(j, i, p, modes, row)
            squares[j % 2] += row[2] * row[2]
            sums[j % 2] += r * row[2]
    return squares, sums


@kernel
def normalise(frame, level, gain, step):
    """(frame − level) gain (H, W), and its means over tiles of ``step`` × ``step`` pixels; where the gain is NaN, NaN
    and, in the means, zero."""
    height, width = frame.shape
    image = np.empty((height, width), dtype=np.float32)
    tiles = np.zeros((height // step, width // step), dtype=np.float32)
    for j in range(height):
        for i in range(width):
            value = (np.float32(frame[j, i]) - level[j, i]) * gain[j, i]
            image[j, i] = value
            if j // step < tiles.shape[0] and i // step < tiles.shape[1] and not math.isnan(value):
                tiles[j // step, i // step] += value
    return image, tiles / np.float32(step * step)
