"""The compiled loop over pixels: the blurred outline and its derivatives.

The image near the outline is modelled as

    m(r, θ) = b + c/S Σ_s P(r − ρ(θ) + d_s) + g Φ((ρ_g − r)/w),      ρ(θ) = R + Σ_{n≥2} A_n cos nθ + B_n sin nθ,
    P(u) = Φ(−u/w) − a/v φ((u − e)/v),      v² = w² + s²,

in polar coordinates about the centre (x, y): an edge of width w (std of the blur), contrast c, with a bright rim that
holds the light of a width a of the bubble, at a distance e outside the edge, of width s before the blur, and the bright
centre of a bubble that acts as a lens, g and ρ_g. Where S flashes light one exposure, S nested circles share the
contrast; the outermost has the radius R, the others lie d_s inside it. The order of the parameters is that of
:data:`NAMES`, then A_2, B_2, A_3, … and d_2, d_3, … Pixels that are not looked at are NaN. Without a rim (a = 0) its
derivatives are zero.
"""

import math

import numpy as np

from en4dvar.plumbing.compiled import kernel

NAMES = ("x", "y", "R", "w", "b", "c", "g", "rho_g", "a", "e", "s")
SHAPE = len(NAMES)  # the first mode's place
FAR = 7.0  # widths from an edge where nothing of it is left in double precision but 1e-12
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
        k = SHAPE + 2 * (n - 2)
        row[k], row[k + 1] = cn, sn
        rho += p[k] * cn + p[k + 1] * sn
        slope += n * (p[k + 1] * cn - p[k] * sn)  # dρ/dθ
    w = p[3]
    gaps = SHAPE + 2 * (modes - 1)  # the place of d_2
    circles = 1 + len(p) - gaps
    v = math.hypot(w, p[10])
    F, edge, wider, light = 0.0, 0.0, 0.0, 0.0
    row[9] = row[10] = 0.0
    for s in range(circles):
        inside = rho - (p[gaps + s - 1] if s else 0.0) - r
        part, f = _normal(inside / w)
        f *= p[5] / circles / w
        F += part / circles
        wider += f * inside / w
        if p[8]:
            q = (inside + p[9]) / v
            g = _DENSITY * math.exp(-0.5 * q * q) / v / circles if abs(q) < FAR else 0.0
            light += g
            g *= p[5] * p[8] / v
            f += g * q
            row[9] += g * q
            row[10] += g * (1 - q * q)
        edge += f
        if s:
            row[gaps + s - 1] = -f
    zg = (p[7] - r) / w
    G, g = _normal(zg)
    glare = p[6] * g / w
    # r falls by cos as x grows, θ grows by sin/r: both move the edge
    row[0] = edge * (cos + slope * sin / r) + glare * cos
    row[1] = edge * (sin - slope * cos / r) + glare * sin
    row[2] = edge
    row[3] = -wider - glare * zg + row[10] * w / v
    row[4] = 1.0
    row[5] = F - p[8] * light
    row[6] = G
    row[7] = glare
    row[8] = -p[5] * light
    row[10] *= p[10] / v
    for k in range(SHAPE, gaps):
        row[k] *= edge
    return p[4] + p[5] * row[5] + p[6] * G


@kernel
def residuals(image, p, modes, ring):
    """Residuals (n,) of the pixels whose distance from ``ring[:2]`` lies between ``ring[2]`` and ``ring[3]``, with the
    model's derivatives (n, P), and the row and column (n, 2) of each."""
    row = np.zeros(len(p))
    (height, width), x, y, reach = image.shape, ring[0], ring[1], ring[3]
    top, bottom = max(0, math.floor(y - reach)), min(height, math.ceil(y + reach) + 1)
    left, right = max(0, math.floor(x - reach)), min(width, math.ceil(x + reach) + 1)
    most = max(0, bottom - top) * max(0, right - left)
    values, rows, places = np.empty(most), np.empty((most, len(p))), np.empty((most, 2), dtype=np.int64)
    n = 0
    for j in range(top, bottom):
        for i in range(left, right):
            far = (i - x) ** 2 + (j - y) ** 2
            if ring[2] ** 2 <= far <= reach**2 and not math.isnan(image[j, i]):
                values[n] = image[j, i] - _row(j, i, p, modes, row)
                for a in range(len(p)):
                    rows[n, a] = row[a]
                places[n, 0], places[n, 1] = j, i
                n += 1
    return values[:n], rows[:n], places[:n]
