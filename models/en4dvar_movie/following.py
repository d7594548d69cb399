"""Following one bubble from frame to frame: of all candidates those that continue each other, as a bubble can.

A chain is the sequence of candidates, at most one a frame, with the largest sum of 1 − cost over its steps, where the
cost of a step grows with how far the centre moves and how much the radius changes (dynamic programming over all
candidates at once). Further bubbles are the next best chains of what is left. Then what does not fit the frames about
it is doubtful: a bubble does not jump.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar_movie.candidates import TOUCHES, Candidate, Look

GAP = 12  # frames in which a bubble may be out of sight
MOST = 8  # bubbles that are followed
DRIFT = 3.0  # pixels a frame that a bubble may travel
LOOSE = 0.3  # of the radius: how far centres of neighbouring frames lie apart for the fit's sake
LEAST = 3  # frames of a bubble that is followed beside the first
BLURRED = 0.25  # widths of an edge: what its place may be off by
SAME = 0.5  # of the best bubble's score: from which another could be meant as well
FAINT = 0.1  # of it: below which light says nothing, such as that where dirt of the background was
BRIEF = 4  # frames that the laser's light lasts at most
NEAR = 3  # frames in which another bubble's outline counts as touching
TOUCH = 5.0  # pixels between outlines that blur together
ABOUT = 3  # frames to each side that say where the bubble is
JUMP, JUMP_SHARE = 3.0, 0.35  # pixels, and share of the radius, that a centre may be off
LEAP, LEAP_SHARE = 2.0, 0.12  # the same of a radius above both its neighbours
MOVES, STANDS = 1.0, 0.03  # pixels that a radius changes by before and after, and their share that is no change
RISE, FALL = 2.0, 4.0  # neighbouring speeds by which a radius may lie above, or below, both its neighbours
FALL_SHARE = 0.6  # of the smaller neighbour


@dataclass(frozen=True)
class Chain:
    """A bubble's candidates in the order of their frames."""

    candidates: tuple[Candidate, ...]

    @property
    def circles(self) -> Array:
        """x, y and radius (K, 3)."""
        return np.array([(c.circle.x, c.circle.y, c.circle.R) for c in self.candidates])

    @property
    def score(self) -> float:
        """How far its wall travels from frame to frame, beyond what errors make of it, and a little of its size."""
        radii = self.circles[:, 2]
        widths = np.array([c.outlines[0].width for c in self.candidates])
        widths[widths < 0.5 * radii] = 0
        travel = np.maximum(np.abs(np.diff(radii)) - np.maximum(0.3, BLURRED * np.hypot(widths[1:], widths[:-1])), 0)
        frames = np.diff([c.frame for c in self.candidates])
        return float(np.sum(np.minimum(travel, 0.5 * np.maximum(radii[1:], radii[:-1])) / frames) + 0.02 * radii.sum())

    def distance(self, x: float, y: float) -> tuple[float, float]:
        """From a point to the nearest that its outline comes; and to its centre."""
        circles = self.circles
        far = np.hypot(circles[:, 0] - x, circles[:, 1] - y)
        return float(np.max(np.append(0.0, np.min(far - circles[:, 2])))), float(np.median(far))


def chains(looks: Sequence[Look], confirmed: Iterable[int] = ()) -> list[Chain]:
    """All bubbles, the longest first; the candidate of a ``confirmed`` frame counts as much as many."""
    left = [c for look in looks for c in look.candidates if not c.fault]
    firm = set(confirmed)
    result: list[Chain] = []
    while left and len(result) < MOST:
        best = _best(left, firm)
        if result and len(best) < LEAST:
            break
        result.append(Chain(tuple(left[n] for n in best)))
        taken = set(best)
        left = [c for n, c in enumerate(left) if n not in taken]
    return result


def _best(nodes: Sequence[Candidate], firm: set[int]) -> list[int]:
    """The best path through candidates in the order of frames, by their numbers."""
    frames = np.array([c.frame for c in nodes])
    circles = np.array([(c.circle.x, c.circle.y, c.circle.R) for c in nodes])
    worth = np.array([20.0 if c.frame in firm else 1.0 for c in nodes])
    total, came = worth.copy(), np.full(len(nodes), -1)
    first = np.searchsorted(frames, frames - GAP)
    end = np.searchsorted(frames, frames)
    for n in range(len(nodes)):
        before = slice(first[n], end[n])
        if first[n] == end[n]:
            continue
        through = total[before] - _cost(circles[before], circles[n], frames[n] - frames[before])
        best = int(np.argmax(through))
        if through[best] > 0:
            total[n], came[n] = worth[n] + through[best], first[n] + best
    path = [int(np.argmax(total))]
    while came[path[-1]] >= 0:
        path.append(int(came[path[-1]]))
    return path[::-1]


def _cost(before: Array, after: Array, steps: Array) -> Array:
    """Of the step from circles (K, 3) to another, ``steps`` (K,) frames later; infinite where they do not overlap."""
    moved = np.hypot(before[:, 0] - after[0], before[:, 1] - after[1])
    large = np.maximum(before[:, 2], after[2])
    place = moved / (DRIFT * np.minimum(steps, 4) + LOOSE * large)
    size = np.abs(before[:, 2] - after[2]) / (0.7 * large + 2)
    apart = moved > before[:, 2] + after[2] + DRIFT * steps
    return np.asarray(np.where(apart, np.inf, place**2 + 0.5 * size**2 + 0.02 * (steps - 1)))


def target(
    bubbles: Sequence[Chain], looks: Sequence[Look], point: tuple[float, ...] | None, firm: Iterable[int] = ()
) -> tuple[int, str]:
    """Which of the bubbles is meant, and a note where that is not sure: the corrected, the one at ``point``, the
    laser's, or the one whose wall travels furthest."""
    frames = set(firm)
    by_hand = [sum(c.frame in frames for c in bubble.candidates) for bubble in bubbles]
    if point is not None:
        return min(range(len(bubbles)), key=lambda n: bubbles[n].distance(*point)), ""
    if max(by_hand):
        return int(np.argmax(by_hand)), ""
    scores = [bubble.score for bubble in bubbles]
    marked = _lit(bubbles, [n for n, score in enumerate(scores) if score > FAINT * max(scores)], looks)
    chosen = int(np.argmax(scores)) if marked is None else marked
    rivals = [b for n, b in enumerate(bubbles) if n != chosen and scores[n] > SAME * max(scores)]
    if marked is not None or not rivals:
        return chosen, ""
    x, y, _ = np.median(bubbles[chosen].circles, axis=0)
    others = ", ".join(f"{u:.0f},{v:.0f}" for u, v, _ in (np.median(b.circles, axis=0) for b in rivals))
    words = (
        f"{1 + len(rivals)} bubbles are alike; the one about {x:.0f},{y:.0f} was followed (--bubble {others}: another)"
    )
    return chosen, words


def _lit(bubbles: Sequence[Chain], among: Iterable[int], looks: Sequence[Look]) -> int | None:
    """Which of some bubbles begins where the laser's light was last seen before it."""
    choices = []
    bright = {look.frame: look.spot for look in looks if look.spot is not None}
    where = np.array([spot[:2] for spot in bright.values()]).reshape(-1, 2)
    brief = {
        frame: (x, y, light)
        for frame, (x, y, light) in bright.items()
        if np.sum(np.hypot(*(where - (x, y)).T) < TOUCH) <= BRIEF
    }
    for n in among:
        first = bubbles[n].candidates[0]
        spots = [spot for frame, spot in brief.items() if -GAP <= frame - first.frame <= 1]
        x, y, light = max(spots, key=lambda spot: spot[2], default=(np.inf, np.inf, 0.0))
        if np.hypot(first.circle.x - x, first.circle.y - y) < first.circle.R + TOUCH:
            choices.append((-light, -bubbles[n].score, n))
    return min(choices)[2] if choices else None


def doubts(bubble: Chain, others: Sequence[Chain]) -> dict[int, str]:
    """Frame → what its candidate's neighbours and other bubbles make doubtful in it."""
    return {**_touching(bubble, others), **_jumps(bubble)}


def _touching(bubble: Chain, others: Sequence[Chain]) -> dict[int, str]:
    """Frames in which another bubble's outline reaches, or reached a few frames before or after, that of this one."""
    result: dict[int, str] = {}
    for other in others:
        frames, circles = np.array([c.frame for c in other.candidates]), other.circles
        for candidate in bubble.candidates:
            near = np.abs(frames - candidate.frame) <= NEAR
            c = candidate.circle
            apart = np.hypot(circles[near, 0] - c.x, circles[near, 1] - c.y) - circles[near, 2] - c.R
            if np.any(apart < TOUCH):
                result[candidate.frame] = TOUCHES
    return result


def _jumps(bubble: Chain) -> dict[int, str]:
    frames, circles = np.array([c.frame for c in bubble.candidates]), bubble.circles
    result: dict[int, str] = {}
    for n, frame in enumerate(frames):
        before, after = circles[max(0, n - ABOUT) : n], circles[n + 1 : n + 1 + ABOUT]
        off, far = 0.0, JUMP
        if len(before) > 1 and len(after) > 1:
            off = _from_segment(circles[n, :2], *(np.median(part[:, :2], axis=0) for part in (before, after)))
            far = max(JUMP, JUMP_SHARE * float(np.median(np.concatenate([before, after])[:, 2])))
        if off > far:
            result[int(frame)] = f"jump: the centre is {off:.0f} pixels from where the frames about it show it"
        elif words := _leap(frames, circles[:, 2], n) or _still(frames, circles[:, 2], n):
            result[int(frame)] = words
    return result


def _leap(frames: Array, radii: Array, n: int) -> str:
    """Why a radius, or two in a row, cannot lie between their neighbours'; "" where they can."""
    for i, j in ((n - 1, n + 1), (n - 2, n + 1), (n - 1, n + 2)):
        if i < 0 or j >= len(radii) or frames[j] - frames[i] != j - i:
            continue
        low, high = sorted((float(radii[i]), float(radii[j])))
        steps = np.abs(np.diff(radii[max(0, i - ABOUT) : j + 1 + ABOUT]))
        first = min(i, ABOUT)  # the step from i on
        speed = float(np.max(np.delete(steps, slice(first, first + j - i)), initial=-np.inf))
        if speed < 0:  # three or four frames in all
            continue
        if radii[n] > high + RISE * speed + max(LEAP, LEAP_SHARE * high):
            return f"jump: the radius is {radii[n] - high:.0f} pixels above those of the frames about it"
        if j - i == 2 and radii[n] < low - FALL * speed - FALL_SHARE * low - LEAP:
            return f"jump: the radius is {low - radii[n]:.0f} pixels below those of the frames about it"
    return ""


def _still(frames: Array, radii: Array, n: int) -> str:
    """Why a radius cannot be that of the frame before; "" where it can."""
    if not 2 <= n < len(radii) - 1 or frames[n + 1] - frames[n - 2] != 3:
        return ""
    before, step, after = np.diff(radii[n - 2 : n + 2])
    if before * after <= 0 or min(abs(before), abs(after)) < MOVES or abs(step) > STANDS * min(abs(before), abs(after)):
        return ""
    return (
        f"copy: the radius is that of the frame before, but changes by {abs(before):.1f} and {abs(after):.1f} pixels "
        "before and after; if a copy was put in, later times are late"
    )


def _from_segment(point: Array, a: Array, b: Array) -> float:
    along = float(np.clip((point - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-9), 0, 1))
    return float(np.hypot(*(point - a - along * (b - a))))


def reasons(looks: Sequence[Look], bubble: Chain) -> Mapping[int, str]:
    """Frame → why the bubble has no outline there: what the candidates at its place say, or all where none is."""
    inside = {c.frame for c in bubble.candidates}
    result = {}
    for look in looks:
        if look.frame in inside:
            continue
        of_place = [c for c in look.candidates if inside and bubble.distance(c.circle.x, c.circle.y)[0] == 0]
        faults = [c.fault for c in of_place or look.candidates]
        if not all(faults):
            result[look.frame] = "elsewhere: the outline lies outside the bubble of other frames"
        else:
            result[look.frame] = next(iter(faults), look.reason)
    return result
