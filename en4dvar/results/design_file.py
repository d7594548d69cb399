"""Designs and what they are worth ⇄ ``design.nc``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.estimation.design.evaluate import FAN, Evaluated
from en4dvar.estimation.design.laws import Decision
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.netcdf import Group, read_groups, to_bytes, understood, variable

DECISION = {  # field → variable, description
    "information": ("law_information", "mutual information of law and data, nats"),
    "information_error": ("law_information_error", "its Monte Carlo standard error"),
    "probability": ("law_probability", "expected probability of the law that holds"),
    "probability_error": ("law_probability_error", "its Monte Carlo standard error"),
    "decided": ("law_decided", "share of experiments in which that is 0.95 or more"),
    "decided_error": ("law_decided_error", "its Monte Carlo standard error"),
    "thin": ("law_thin", "share of evidences with few effective draws"),
}


@dataclass(frozen=True)
class DesignRow:
    """A design: its ``number`` in the file, what its knobs are set to (nothing: as in the file), what it is worth, or
    the reason why that is not known; ``price`` in the unit of the file.
    """

    number: int
    settings: Mapping[str, Any]
    result: Evaluated | None
    price: float
    failure: str = ""


@dataclass(frozen=True)
class Asked:
    """What was asked: parameters with their ``units`` (stored, shown), symbols and labels, the knobs and the laws; the
    label and the ``axes`` of what is seen, time and observable, each with its units (stored, shown); what is
    ``enough``, nats.
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


@dataclass(frozen=True)
class Designs:
    """A file of :func:`save_designs`."""

    asked: Asked
    rows: tuple[DesignRow, ...]
    attributes: Mapping[str, Any]


def save_designs(path: Path, rows: Sequence[DesignRow], asked: Asked, attributes: Mapping[str, Any]) -> Path:
    """Write the file; it appears complete or not at all. Raises :class:`OutputError`."""
    return to_bytes({"/": _group(rows, asked, attributes)}).write(path)


def _group(rows: Sequence[DesignRow], asked: Asked, attributes: Mapping[str, Any]) -> Group:
    worth = [row.result for row in rows]

    def each(name: str) -> Array:
        return np.array([np.nan if result is None else getattr(result, name) for result in worth], dtype=float)

    def padded(name: str, length: int) -> Array:
        table = np.full((len(rows), length), np.nan)
        for i, result in enumerate(worth):
            if result is not None:
                values = getattr(result, name)
                table[i, : len(values)] = values
        return table

    def text(values: Sequence[str]) -> np.ndarray[Any, Any]:
        return np.array(values, dtype=object)

    readings = max((len(result.times) for result in worth if result), default=1)
    points = max((len(result.grid) for result in worth if result), default=1)
    a, (time, _), (value, _) = len(asked.parameters), *asked.axes
    variables = {
        "number": variable("design", np.array([row.number for row in rows]), "1", "number of the design in the file"),
        "settings": variable("design", text([json.dumps(dict(row.settings)) for row in rows]), "", "knobs, as JSON"),
        "failure": variable("design", text([row.failure for row in rows]), "", "why a design could not be evaluated"),
        "price": variable("design", np.array([row.price for row in rows]), "1", "price"),
        "gain": variable("design", each("gain"), "1", "expected information gain, nats"),
        "gain_error": variable("design", each("error"), "1", "Monte Carlo standard error of gain"),
        "method": variable("design", text([result.method if result else "" for result in worth]), "", "method of gain"),
        "experiments": variable("design", each("alike"), "1", "experiments alike"),
        "lost": variable("design", each("lost"), "1", "share of the prior where the model fails"),
        "beyond": variable("design", each("beyond"), "1", "share of the prior that leaves the model's validity"),
        "forward_runs": variable("design", each("forward_runs"), "1", "forward runs"),
        "std": variable(("design", "parameter"), padded("std", a), "", "expected posterior std, units of parameters"),
        "relative_std": variable(("design", "parameter"), padded("relative", a), "1", "the same relative to the value"),
        "std_ratio": variable(("design", "parameter"), padded("ratio", a), "1", "posterior over prior std"),
        "reading": variable(("design", "taken"), padded("readings", readings), "1", "numbers of the readings taken"),
        "time": variable(("design", "taken"), padded("times", readings), time, "times of the readings taken"),
        "grid": variable(("design", "point"), padded("grid", points), time, "times of the fan"),
        "fan": variable(("design", "level", "point"), _fans(worth, points), value, asked.seen),
    }
    if asked.laws:
        decisions = [result.decision if result else None for result in worth]
        variables |= {
            name: variable("design", _of_decisions(decisions, field), "1", label)
            for field, (name, label) in DECISION.items()
        }
    root = {**attributes, "asked": json.dumps(asked.__dict__)}
    return Group(variables, {"parameter": variable("parameter", text(asked.parameters), "", "asked for")}, root)


def _of_decisions(decisions: Sequence[Decision | None], field: str) -> Array:
    return np.array([np.nan if decision is None else getattr(decision, field) for decision in decisions], dtype=float)


def _fans(worth: Sequence[Evaluated | None], points: int) -> Array:
    """(designs, levels, points), NaN behind the points of a design."""
    fans = np.full((len(worth), len(FAN), points), np.nan)
    for i, result in enumerate(worth):
        if result is not None:
            fans[i, :, : len(result.grid)] = result.fan
    return fans


def load_designs(path: Path) -> Designs:
    """Read the file. Raises :class:`OutputError`: it is none, cut short or altered."""
    root = read_groups(path)["/"]
    if "asked" not in root.attrs:
        raise OutputError(f"{path}: no result of en4dvar design")
    with understood(path):
        asked = Asked(**json.loads(root.attrs["asked"]))
        return Designs(asked, tuple(_row(root, i) for i in range(root.sizes["design"])), root.attrs)


def _row(root: Group, i: int) -> DesignRow:
    def of(name: str) -> Any:
        return root[name].values[i]

    def known(name: str) -> Array:
        values = of(name)
        return np.asarray(values[np.isfinite(values)], dtype=float)

    number, settings, price, failure = int(of("number")), json.loads(of("settings")), float(of("price")), of("failure")
    if failure:
        return DesignRow(number, settings, None, price, failure)
    grid = known("grid")
    decision = {field: float(of(name)) for field, (name, _) in DECISION.items() if name in root}
    result = Evaluated(
        gain=float(of("gain")),
        error=float(of("gain_error")),
        method=of("method"),
        std=of("std"),
        relative=of("relative_std"),
        ratio=of("std_ratio"),
        lost=float(of("lost")),
        beyond=float(of("beyond")),
        readings=known("reading"),
        times=known("time"),
        grid=grid,
        fan=of("fan")[:, : len(grid)],
        alike=int(of("experiments")),
        forward_runs=int(of("forward_runs")),
        decision=Decision(**decision) if decision else None,
    )
    return DesignRow(number, settings, result, price)
