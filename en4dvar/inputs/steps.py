"""Times beside the camera's frames: whether steps between readings can be what the file, or its user, says.

Readings of a film lie whole frames apart, also where some frames could not be read. A step that is none, among many
that are, is a time that was written wrongly. Steps of all kinds are those of another instrument, and nothing is said.
"""

import re
from collections.abc import Mapping

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.units import convert

MOSTLY = 0.8  # of the steps are whole frames: this is a film
WHOLE = 0.1  # of a frame: times may be rounded
ODD = 0.25  # of a frame off the next whole number
SAME = 0.01  # rates that agree within this are the same
_STEP = re.compile(r"(?i)(.*\.)?(delta_?t|dt|t_?step|time_?step)")
_RATE = re.compile(r"(?i)(.*\.)?(fps|frame_?rate|f_?rate)")


def step_doubts(
    times: Array, unit: str, display: str, scalars: Mapping[str, float], rate: float | None = None
) -> tuple[Caution, ...]:
    """What contradicts times (K,) in ``unit``, increasing, K > 1.

    ``scalars``: of the file, whose units nobody said, so factors of 1000 are not told from agreement. ``rate``: of the
    frames, as the user says, per ``unit``. ``display``: the unit that messages use.
    """
    steps, cautions = np.diff(times), list[Caution]()
    step = float(np.median(steps))
    told = f"the times are {convert(step, unit, display):.4g} {display} apart"
    if rate is not None and _off(np.array([step * rate]))[0] > SAME * step * rate:
        words = f"{told}, which is no whole number of frames: at the rate given one takes "
        cautions.append(caution("implausible-data", f"{words}{convert(1 / rate, unit, display):.4g} {display}"))
    for name, value in scalars.items():
        if value > 0 and (_STEP.fullmatch(name) or _RATE.fullmatch(name)):
            frames = step / value if _STEP.fullmatch(name) else step * value
            frames /= 1000.0 ** np.rint(np.log10(frames) / 3)
            if abs(frames - 1) > SAME and _off(np.array([frames]))[0] > SAME * frames:
                cautions.append(caution("implausible-data", f"{told}, but {name} of the file is {value:g}"))
    off = _off(steps / step)
    odd = np.flatnonzero(off > ODD)
    if len(odd) and np.mean(off < WHOLE) >= MOSTLY:
        first, after, whole = convert(np.array([*times[odd[0] : odd[0] + 2], step]), unit, display)
        words = (
            f"{len(odd)} of {len(steps)} steps between readings are no whole number of frames of {whole:.4g} "
            f"{display}, the first from {first:.6g} to {after:.6g} {display}: is a time wrong?"
        )
        cautions.append(caution("implausible-data", words, "caution"))
    return tuple(cautions)


def _off(frames: Array) -> Array:
    """How far steps (K,) in frames are from a whole number of them, at least one."""
    return np.abs(frames - np.maximum(np.rint(frames), 1))
