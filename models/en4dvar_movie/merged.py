"""Two bubbles whose images are one dark patch: arcs of two circles, with concave corners between them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from en4dvar.model.state import Array
from en4dvar_movie.outline import Circle, labelled

GRID = 20  # samples to a radius, at most
QUIET = 2.8  # std of the smoothing that leaves a tenth of the contrast as noise, per noise over contrast
CENTRE = 0.95  # of the radius: what is bright within is the bubble's own centre
BRIDGE = 2  # pixels to each side of a gap that is too narrow to part two outlines
SMALLEST = 0.2  # of the larger radius: a smaller disc is a speck, which a robust fit leaves out
LONG = 2.0  # samples by which the patch reaches out of the larger disc
DEEP, DEEP_SHARE = 1.0, 0.035  # samples, and share of the larger radius, by which a corner reaches inwards
BRIGHT = 0.4  # share of what lies between two discs and their common tangents that is no bubble


def two_circles(image: Array, near: Circle, contrast: float, noise: float) -> tuple[Circle, Circle] | None:
    """The discs of two bubbles that are one patch about ``near``, roughly, the larger first; None where it is one.

    They are the largest disc within the patch and the one that reaches furthest out of it. Of one bubble, however long,
    what lies between them and their common tangents is dark, to one side of them at least. ``image`` (H, W) is zero on
    the background, ``contrast`` in a bubble; what is NaN is not looked at. ``noise`` is the std of a pixel.
    """
    step, reach = max(1, int(near.R / GRID)), 3 * near.R + 10
    first = [max(0, int(at - reach)) for at in (near.y, near.x)]
    part = image[first[0] : int(near.y + reach) + 1 : step, first[1] : int(near.x + reach) + 1 : step] / contrast
    if min(part.shape) < 3:
        return None
    seen, spread = ~np.isnan(part), max(1.0, QUIET * noise / abs(contrast))
    sums, weights = (ndimage.gaussian_filter(a, spread) for a in (np.nan_to_num(part), seen.astype(part.dtype)))
    dark = np.where(seen, sums / np.maximum(weights, 1e-6), 0) > 0.5
    y, x = np.indices(part.shape)
    from_centre = np.hypot(x - (near.x - first[1]) / step, y - (near.y - first[0]) / step)
    holes, sizes = labelled(~dark)
    furthest = ndimage.maximum(from_centre, holes, np.arange(len(sizes)))
    dark |= (furthest < CENTRE * near.R / step)[holes] & seen
    patches, _ = labelled(ndimage.binary_dilation(dark, iterations=-(-BRIDGE // step)))
    inside = np.bincount(patches[(from_centre < near.R / step) & dark], minlength=1)
    inside[0] = 0
    if not inside.any():
        return None
    room = ndimage.distance_transform_edt(np.pad(dark & (patches == np.argmax(inside)), 1))[1:-1, 1:-1] - 0.5
    at = np.unravel_index(np.argmax(room), room.shape)
    r1 = float(room[at])
    off = np.hypot(x - at[1], y - at[0])
    out = np.where(room > max(SMALLEST * r1, 1.0), off + room, 0.0)
    to = np.unravel_index(np.argmax(np.where(out >= out.max() - 1, room, 0.0)), room.shape)
    if out.max() < r1 + LONG:
        return None
    r2 = float(room[to])
    way = np.linspace(0, 1, 17)[:, None, None]
    deep = np.hypot(x - (at[1] + way * (to[1] - at[1])), y - (at[0] + way * (to[0] - at[0]))) - (r1 + way * (r2 - r1))
    within = (np.minimum(deep[0], deep[-1]) > 0.7) & (deep.min(axis=0) < -0.5) & seen
    light = within & ~dark
    side = (x - at[1]) * (to[0] - at[0]) - (y - at[0]) * (to[1] - at[1])
    corners = (deep.min(axis=0)[light & (sign * side > 0)] for sign in (1, -1))  # one alone may be a glint at the rim
    depth = min(-float(np.min(corner, initial=0.0)) for corner in corners)
    if depth < max(DEEP, DEEP_SHARE * r1) or light.sum() < BRIGHT * within.sum():
        return None
    large, small = (
        Circle(float(first[1] + step * j), float(first[0] + step * i), step * r) for (i, j), r in ((at, r1), (to, r2))
    )
    return large, small
