"""Designs and what they are worth ⇄ ``design.nc``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.estimation.design.evaluate import FAN, Evaluated
from en4dvar.estimation.design.nested import Decision
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.declared import Names, text
from en4dvar.results.netcdf import Group, read_groups, to_bytes, understood, variable

FILE = "design.nc"
COLUMNS = {  # field of an evaluation → variable, its dimensions beside that of the designs, description
    "gain": ("gain", "", "expected information gain, nats"),
    "error": ("gain_error", "", "Monte Carlo standard error of gain"),
    "method": ("method", "", "method of gain"),
    "alike": ("experiments", "", "experiments alike"),
    "lost": ("lost", "", "share of the prior where the model fails"),
    "beyond": ("beyond", "", "share of the prior that leaves the model's validity"),
    "forward_runs": ("forward_runs", "", "forward runs"),
    "thin": ("thin", "", "share of simulated readings explained by few effective draws"),
    "std": ("std", "parameter", "expected posterior std, units of parameters"),
    "relative": ("relative_std", "parameter", "the same relative to the value"),
    "ratio": ("std_ratio", "parameter", "posterior over prior std"),
    "readings": ("reading", "taken", "numbers of the readings taken"),
    "times": ("time", "taken", "times of the readings taken"),
    "grid": ("grid", "point", "times of the fan"),
    "fan": ("fan", "level point", "{seen}"),
}
NEEDED = {  # the same, where something is wanted; of the last condition all others at once
    "needed": ("needed_factor", "wanted condition", "largest factor of others' prior std that allows what is wanted"),
    "others": ("other_std", "measure other", "prior std of others, in their units and relative to the value"),
}
PADDED = ("taken", "point")  # of which one design has more than another
DECISION = {  # field → variable, description
    "information": ("law_information", "mutual information of law and data, nats"),
    "information_error": ("law_information_error", "its Monte Carlo standard error"),
    "probability": ("law_probability", "expected probability of the law that holds"),
    "probability_error": ("law_probability_error", "its Monte Carlo standard error"),
    "decided": ("law_decided", "share of experiments in which that is 0.95 or more"),
    "decided_error": ("law_decided_error", "its Monte Carlo standard error"),
    "thin": ("law_thin", "share of evidences with few effective draws"),
}


@dataclass(frozen=True, eq=False)  # of arrays, which do not compare
class DesignRow:
    """A design: its ``number`` in the file, what its knobs are set to (nothing: as in the file), what it is worth, or
    the reason why that is not known; ``price`` in the unit of the file.
    """

    number: int
    settings: Mapping[str, Any]
    result: Evaluated | None
    price: float
    failure: str = ""

    @property
    def evaluated(self) -> Evaluated:
        """The result of a design without ``failure``."""
        assert self.result is not None
        return self.result


@dataclass(frozen=True)
class Asked:
    """What was asked: parameters with their ``units`` (stored, shown), symbols and labels, the knobs and the laws; the
    label and the ``axes`` of what is seen, time and observable, each with its units (stored, shown); what is
    ``enough``, nats; what is ``wanted``, as it is written, and for it all ``others`` with their units (stored, shown)
    and symbols.
    """

    parameters: tuple[str, ...]
    symbols: tuple[str, ...]
    labels: tuple[str, ...]
    units: tuple[tuple[str, str], ...]
    knobs: tuple[str, ...]
    seen: str
    axes: tuple[tuple[str, str], tuple[str, str]]
    laws: tuple[str, ...]
    enough: float
    wanted: Mapping[str, str] = field(default_factory=dict)
    others: tuple[tuple[str, str, str], ...] = ()
    other_symbols: tuple[str, ...] = ()

    @property
    def written(self) -> "Asked":
        """The same with symbols in place of names, as a page writes them."""
        names = Names(zip(self.parameters, self.symbols, strict=True))
        beside = self.other_symbols or [name for name, *_ in self.others]  # which earlier versions did not store
        others = tuple((s, unit, shown) for s, (_, unit, shown) in zip(beside, self.others, strict=True))
        wanted = {names[name]: text for name, text in self.wanted.items()}
        return replace(self, parameters=self.symbols, wanted=wanted, others=others)


@dataclass(frozen=True)
class Designs:
    """A file of :func:`save_designs`."""

    asked: Asked
    rows: tuple[DesignRow, ...]
    attributes: Mapping[str, Any]


def save_designs(path: Path, rows: Sequence[DesignRow], asked: Asked, attributes: Mapping[str, Any]) -> Path:
    """Write the file; it appears complete or not at all. Raises :class:`OutputError`."""
    (time, _), (value, _) = asked.axes
    units = {"method": "", "std": "", "times": time, "grid": time, "fan": value}
    fixed = {"parameter": len(asked.parameters), "level": len(FAN), "other": len(asked.others)}
    worth = [row.result for row in rows]
    variables = {
        "number": variable("design", np.array([row.number for row in rows]), "1", "number of the design in the file"),
        "settings": variable("design", text([json.dumps(dict(row.settings)) for row in rows]), "", "knobs, as JSON"),
        "failure": variable("design", text([row.failure for row in rows]), "", "why a design could not be evaluated"),
        "price": variable("design", np.array([row.price for row in rows]), "1", "price"),
    }
    for key, (name, along, label) in (COLUMNS | (NEEDED if asked.wanted else {})).items():
        dims = along.split()
        values = text([o.method if o else "" for o in worth]) if key == "method" else _padded(worth, key, dims, fixed)
        variables[name] = variable(("design", *dims), values, units.get(key, "1"), label.format(seen=asked.seen))
    if asked.laws:
        decisions = [result.decision if result else None for result in worth]
        for key, (name, label) in DECISION.items():
            variables[name] = variable("design", _padded(decisions, key, [], {}), "1", label)
    root = {**attributes, "asked": json.dumps(asked.__dict__)}
    parameters = {"parameter": variable("parameter", text(asked.parameters), "", "asked for")}
    return to_bytes({"/": Group(variables, parameters, root)}).write(path)


def _padded(
    of: Sequence[Evaluated | Decision | None], key: str, dims: Sequence[str], sizes: Mapping[str, int]
) -> Array:
    """(designs, …) numbers along ``dims``, which have at least their ``sizes``; NaN where a design has none."""
    each = [None if design is None else np.asarray(getattr(design, key), dtype=float) for design in of]
    shape = [max(sizes.get(dim, 1), *(v.shape[k] for v in each if v is not None), 0) for k, dim in enumerate(dims)]
    table = np.full((len(of), *shape), np.nan)
    for i, values in enumerate(each):
        if values is not None:
            where: tuple[Any, ...] = (i, *map(slice, values.shape))
            table[where] = values
    return table


def load_designs(path: Path) -> Designs:
    """Read the file. Raises :class:`OutputError`: it is none, cut short or altered."""
    root = read_groups(path)["/"]
    if "asked" not in root.attrs:
        raise OutputError(f"{path}: no result of en4dvar design")
    with understood(path):
        asked = Asked(**json.loads(root.attrs["asked"]))
        return Designs(asked, tuple(_row(root, i) for i in range(root.sizes["design"])), root.attrs)


def _row(root: Group, i: int) -> DesignRow:
    def of(name: str, along: str = "") -> Any:
        values = root[name].values[i]
        if along in PADDED:
            return np.asarray(values[np.isfinite(values)], dtype=float)
        return values if along or isinstance(values, str) else float(values)

    number, settings, price, failure = int(of("number")), json.loads(of("settings")), of("price"), of("failure")
    if failure:
        return DesignRow(number, settings, None, price, failure)
    held = {key: of(name, along) for key, (name, along, _) in (COLUMNS | NEEDED).items() if name in root}
    held |= {key: int(held[key]) for key in ("alike", "forward_runs")}
    held["fan"] = held["fan"][:, : len(held["grid"])]
    decision = {key: of(name) for key, (name, _) in DECISION.items() if name in root}
    told = Decision(**decision) if decision else None
    return DesignRow(number, settings, Evaluated(**held, decision=told), price)
