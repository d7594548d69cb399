"""The settings of an estimate: a scheme with its own keys, and the keys of every scheme."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le

from en4dvar import schemes
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.user_file import is_file_reference
from en4dvar.schemes import DEFAULT, keys_of, require_usable, unread
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.en4dvar import En4DVar

AFTERWARDS = ("refine", "draws", "emulator", "what_if")  # keys of what follows a descent that is not localised


@dataclass(frozen=True)
class Localisation:
    """How the gain of an ensemble is localised (:mod:`en4dvar.schemes.local_gain`).

    By distance with a ``radius``, in the unit of the model's coordinates, where ``at`` are the coordinates of
    parameters and of series that are no part of a field; or by correlation, ``radius`` None, with a ``threshold`` or
    its default. ``velocity``, in coordinates per unit of the model's time: what a field reads at time t was so much
    times t away when the model's clock began.
    """

    radius: float | None = None
    at: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    velocity: tuple[float, ...] = ()
    threshold: float | None = None


@dataclass(frozen=True, init=False)
class AssimilationSettings:
    """What a scheme is told, by the keys of ``assimilation:`` in YAML; defaults are the recommended ones.

    ``AssimilationSettings("es-mda", members=100, mda_form="square-root")`` takes the keys below, which every scheme
    reads, and those of the scheme that is named: the fields of its class in :mod:`en4dvar.schemes`. They are the one
    declaration of type, bounds, description and default of each. ``own`` is the scheme with its keys, which can be
    read as attributes of the settings, too.

    The guidance of ``refine: mcmc`` uses the ``emulator`` as well (see :mod:`en4dvar.sampling.refine`).

    Raises
    ------
    ConfigError: a scheme that does not exist, or keys that the scheme does not read.
    """

    scheme: str = DEFAULT
    members: Annotated[int, Ge(3), Le(100_000), "Ensemble size N."] = 48
    sampling: Annotated[
        Literal["exact", "random"],
        "Prior ensemble: second-order exact (mean and covariance are the prior's), or random.",
    ] = "exact"
    min_active_fraction: Annotated[
        float, Gt(0), Le(1), "Fewer surviving members than this share of the ensemble end the run (exit code 3)."
    ] = 0.5
    refine: Annotated[
        Literal["auto", "none", "mcmc"],
        "auto: sample the posterior where the ensemble leaves a doubt (cheap models); mcmc: by a Markov chain, always.",
    ] = "auto"
    draws: Annotated[
        int | None,
        Ge(400),
        "Effective draws where the posterior is sampled, whose mean is known to 1/√draws of its std; "
        "default: 1500, of a chain 1000.",
    ] = None
    emulator: Annotated[
        Literal["auto", "on", "off"],
        "A few hundred more runs to tell how Gaussian the posterior is: auto (compiled models), on, or off.",
    ] = "auto"
    what_if: Annotated[
        bool | Literal["added"],
        "Say what the result would be under the model's alternatives, and which part of the path informed it; "
        "added: and let the posterior's width hold these as well (run --with-what-if).",
    ] = True
    stochastic_model: Annotated[
        bool, "true: accept a model that gives other numbers when a member is run again; by default that is an error."
    ] = False
    localisation: Annotated[
        Localisation | None, "Which readings act on what: by distance, or by correlation; default: all on everything."
    ] = None
    own: Scheme = field(default_factory=En4DVar)

    def __init__(self, scheme: str = DEFAULT, **keys: Any) -> None:
        kinds = schemes.ON_A_WINDOW
        before = keys.pop("own", None)  # of settings that are changed by dataclasses.replace
        if before is not None and is_file_reference(scheme):  # which a worker has not read
            kinds.setdefault(scheme, type(before))
        require_usable(scheme)
        if scheme not in kinds:
            raise ConfigError(f"{scheme!r} is not a scheme for the data of one set{suggest(scheme, list(kinds))}")
        kind, common = kinds[scheme], {f.name: f.default for f in fields(self) if f.name not in ("scheme", "own")}
        changed = {key: keys.pop(key) for key in keys.keys() & keys_of(kind)}
        own = replace(before, **changed) if type(before) is kind else kind(**changed)
        faults = unread(scheme, kinds, keys)
        for key in keys.keys() - common.keys() - faults.keys():
            faults[key] = f"unknown key{suggest(key, [*common, *keys_of(kind)])}"
        if keys.get("localisation") is not None:
            values = {f.name: (getattr(own, f.name), f.default) for f in fields(own)}
            values |= {key: (keys.get(key, common[key]), common[key]) for key in AFTERWARDS}
            faults |= beside_localisation(scheme, [key for key, (value, default) in values.items() if value != default])
        elif keys.get("stochastic_model") and own.minimiser:
            faults |= beside_noise({**keys, "linearisation": own.minimiser.linearisation})
            own = replace(own.minimiser, linearisation="transform")
        if faults:
            raise ConfigError([Fault(words, key) for key, words in faults.items()])
        for name, value in {"scheme": scheme, **common, **keys, "own": own}.items():
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "own" not in self.__dict__:  # while it is copied
            raise AttributeError(name)
        return getattr(self.own, name)

    @property
    def keys(self) -> dict[str, Any]:
        """Every key with its value, the scheme's own included."""
        every = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "own"}
        return every | {f.name: getattr(self.own, f.name) for f in fields(self.own)}


def beside_noise(section: Mapping[str, Any]) -> dict[str, str]:
    """A linearisation by runs that are close together, of a stochastic model, with a message."""
    if section.get("stochastic_model") is not True or section.get("linearisation") not in ("bundle", "tangent"):
        return {}
    why = "close to each other, runs of a stochastic_model tell its noise instead of its slope"
    return {"linearisation": f"{why}; leave it out, or set linearisation: transform"}


def beside_localisation(scheme: str, keys: Collection[str]) -> dict[str, str]:
    """Those of ``keys`` that a scheme does not read where its gain is localised, each with a message."""
    if schemes.ON_A_WINDOW[scheme].localised_keys is None:
        return {}  # it cannot be localised at all, which is told by itself
    after = {key: "not read beside a localisation" for key in AFTERWARDS if key in keys}
    return unread(scheme, schemes.ON_A_WINDOW, keys, localised=True) | after
