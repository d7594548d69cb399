"""What about an experiment with a bubble could be otherwise than assumed, each by as much as laboratories differ.

Sizes: a hydrophone states the amplitude within 5 to 10 %; weather moves the ambient pressure by 2 % about its mean,
1000 m of height by 11 %; the rheometry codes take 0.056 to 0.072 N/m for the surface tension of water in a gel; a
calibration target gives the scale of the picture within about 1 %; the density of a gel is water's or up to 6 % more,
its speed of sound that of water or 3 % more; the walls of a dish or of the holder of a gel are millimetres away, and
one three times the largest radius away makes a collapse 7 % longer (Rattray: 0.205 R_max/h).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

from en4dvar.model.forward import Alternative, ForwardModel
from en4dvar_bubble.dynamics import Dynamics, Wall
from en4dvar_bubble.gas import saturated_vapour_pressure
from en4dvar_bubble.numbers import WALL_DISTANCE

PULSE, REST, SCALE, CLOCK = 1.05, 1.1, 1.01, 1.01
NEARBY = Wall(3.0, relative=True), "three times R_max"
NEARBY_DRIVEN = Wall(3e-3), "3 mm"
MEDIUM = (  # parameter, unless it is one that is named; alternative, factor, words
    ("p_inf", "ambient_pressure", 1.02, "the ambient pressure were 2 % higher"),
    ("rho", "density", 1.03, "the medium were 3 % denser"),
    ("c", "sound_speed", 1.03, "sound were 3 % faster in the medium"),
    ("surface_tension", "surface_tension", 0.8, "the surface tension were 20 % lower"),
)


@lru_cache(maxsize=4)  # the data sets of a campaign share their model; not in the model, which is sent to workers
def alternatives(model: ForwardModel) -> tuple[Alternative, ...]:
    """Those of a bubble: pulse, medium, wall, gas, vapour, radius at rest, scale, time step.

    None in whose equations a parameter of the model has no place.
    """
    assert isinstance(model, Dynamics)
    return tuple(a for a in _alternatives(model) if a.model is None or _names(a.model) == _names(model))


def _names(model: ForwardModel) -> list[str]:
    return [p.name for p in model.parameters if p.name != WALL_DISTANCE.name]  # stated with the wall itself


def _alternatives(model: Dynamics) -> Iterator[Alternative]:
    def changed(name: str, words: str, **options: Any) -> Alternative:
        return Alternative(name, words, replace(cast(Any, model), **options))

    medium, driving, rest = model.medium, model.driving, model.stress_free_radius
    saturated = replace(medium, p_v=saturated_vapour_pressure(medium.T_inf))
    if not driving.silent and "p_A" not in model.named:  # what is a parameter has its own uncertainty
        stronger = replace(driving, amplitude=PULSE * driving.amplitude)
        yield changed("pulse_amplitude", "the pulse were 5 % stronger", driving=stronger)
    for name, key, factor, words in MEDIUM:
        if name not in model.named and (name != "surface_tension" or not model.law.rest_tension):
            of = "S" if name == "surface_tension" else name
            yield changed(key, words, medium=replace(medium, **{of: factor * getattr(medium, of)}))
    if model.wall is None:
        wall, far = NEARBY if model.start == "laser" else NEARBY_DRIVEN
        yield changed("wall", f"a rigid wall were {far} away", wall=wall)
    if model.gas != "heat":
        yield changed("gas_model", "the gas conducted heat to the wall (gas: heat)", gas="heat")
    else:
        cold = replace(model, medium_heat="cold")
        simple = replace(cold, vapour="none", medium=saturated) if model.vapour == "transport" else cold
        words = "the gas were polytropic (gas: polytropic)"
        yield Alternative("gas_model", words, replace(cast(Any, simple), gas="polytropic"))
    if model.medium_heat == "conducting":
        yield changed("medium_heat", "the gel stayed cold at the wall (medium_heat: cold)", medium_heat="cold")
    if medium.p_v and "p_v" not in model.named:
        yield changed("vapour", "there were no vapour in the bubble", medium=replace(medium, p_v=0.0))
    elif model.vapour != "none":  # and p_v is no parameter
        yield changed("vapour", "there were no vapour in the bubble (vapour: none)", vapour="none")
    elif "p_v" not in model.named:
        yield changed("vapour", "vapour filled the bubble (vapour_pressure: saturated)", medium=saturated)
    yield Alternative("radius_at_rest", f"{rest} were 10 % larger", parameters={rest: REST})
    yield Alternative("length_scale", "all radii were 1 % larger (µm per pixel)", values=SCALE, observable="radius")
    yield Alternative("time_scale", "the time between frames were 1 % longer", times=CLOCK, observable="radius")
