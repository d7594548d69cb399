"""The compiled loop over pixels: the blurred outline and its derivatives.

The image near the outline is modelled as

    m(r, θ) = b + c/S Σ_s P(r − ρ(θ) + d_s) + g Φ((ρ_g − r)/w_g),      ρ(θ) = R + Σ_{n≥2} A_n cos nθ + B_n sin nθ,
    P(u) = Φ(−u/w) − a/v φ((u − e)/v),      v² = w² + s²,      w_g² = w² + s_g²,

in polar coordinates about the centre (x, y): an edge of width w (std of the blur), contrast c, with a bright rim that
holds the light of a width a of the bubble, at a distance e outside the edge, of width s before the blur, and the bright
centre of a bubble that acts as a lens, g and ρ_g, which ends over a width s_g before the blur. Where S flashes light
one exposure, S nested circles share the contrast; the outermost has the radius R, the others lie d_s inside it. The
order of the parameters is that of :data:`NAMES`, then A_2, B_2, A_3, …; d_2, d_3, … from ``parts[0]`` on; and from
``parts[1]`` on a, e and s, or nothing where there is no rim. Pixels that are not looked at are NaN.
"""

import math

import numpy as np

from en4dvar.plumbing.compiled import kernel

NAMES = ("x", "y", "R", "w", "b", "c", "g", "rho_g", "s_g")
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
def _rim(inside, share, p, rim, row):
    """Adds the rim of a circle with a ``share`` of the light to ``row``, and returns its part of the edge's slope."""
    v = math.hypot(p[3], p[rim + 2])
    q = (inside + p[rim + 1]) / v
    if abs(q) > FAR:
        return 0.0
    light = share * _DENSITY * math.exp(-0.5 * q * q) / v
    slope = p[5] * p[rim] * light / v
    row[5] -= p[rim] * light
    row[rim] -= p[5] * light
    row[rim + 1] += slope * q
    row[rim + 2] += slope * (1 - q * q) * p[rim + 2] / v
    row[3] += slope * (1 - q * q) * p[3] / v
    return slope * q


@kernel
def _row(j, i, p, parts, row):
    """The model at a pixel; ``row`` (P,) gets its derivatives."""
    dx, dy = i - p[0], j - p[1]
    r = math.sqrt(dx * dx + dy * dy) + 1e-9
    cos, sin = dx / r, dy / r
    rho, slope = p[2], 0.0
    cn, sn = cos, sin
    gaps, rim = parts
    for n in range(2, 2 + (gaps - SHAPE) // 2):
        k = SHAPE + 2 * (n - 2)
        cn, sn = cn * cos - sn * sin, sn * cos + cn * sin
        row[k], row[k + 1] = cn, sn
        rho += p[k] * cn + p[k + 1] * sn
        slope += n * (p[k + 1] * cn - p[k] * sn)  # dρ/dθ
    w, circles = p[3], 1 + rim - gaps
    edge = row[3] = row[5] = 0.0
    row[rim:] = 0.0
    for circle in range(circles):
        inside = rho - (p[gaps + circle - 1] if circle else 0.0) - r
        part, f = _normal(inside / w)
        f *= p[5] / circles / w
        row[5] += part / circles
        row[3] -= f * inside / w
        if len(p) > rim:
            f += _rim(inside, 1 / circles, p, rim, row)
        edge += f
        if circle:
            row[gaps + circle - 1] = -f
    wg = math.hypot(w, p[8])
    zg = (p[7] - r) / wg
    G, g = _normal(zg)
    glare = p[6] * g / wg
    # r falls by cos as x grows, θ grows by sin/r: both move the edge
    row[0] = edge * (cos + slope * sin / r) + glare * cos
    row[1] = edge * (sin - slope * cos / r) + glare * sin
    row[2] = edge
    row[3] -= glare * zg * w / wg
    row[4] = 1.0
    row[6] = G
    row[7] = glare
    row[8] = -glare * zg * p[8] / wg
    for k in range(SHAPE, gaps):
        row[k] *= edge
    return p[4] + p[5] * row[5] + p[6] * G


@kernel
def residuals(image, p, parts, ring):
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
                values[n] = image[j, i] - _row(j, i, p, parts, row)
                for a in range(len(p)):
                    rows[n, a] = row[a]
                places[n, 0], places[n, 1] = j, i
                n += 1
    return values[:n], rows[:n], places[:n]
