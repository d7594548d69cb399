"""What the placeholders of declared names stand for in the result of one data set, and units and conditions."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from en4dvar.data.noise import SHARED, SIDES
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.model.state import Array
from en4dvar.results.declared import Item, UnitRule, When, axes_of, shown_as


def _parameters(a: Analysis) -> Iterator[Item]:
    for column, p in enumerate(a.parameters):
        yield Item(column, {"parameter": p.name}, p.label, {**shown_as(p), "source": p.source})


def _series(a: Analysis) -> Iterator[Item]:
    parts = a.problem.parts
    for axis, part in zip(axes_of([part.name for part in parts]), parts, strict=True):
        o, names = part.observable, {"series": part.name, "shared": axis.own(""), "time": axis.time}
        yield Item(part, names, o.label, shown_as(o))


def _walks(a: Analysis) -> Iterator[Item]:
    for walk in a.problem.walks:
        yield Item(walk, {"walk": walk.name}, walk.label, shown_as(walk.parameter))


def _matrices(a: Analysis) -> Iterator[Item]:
    several = bool(a.observations.parts)
    own = "reading" if several else "time"
    for key, (matrix, words) in a.observations.noise.matrices().items():
        name = key if several else f"{a.problem.observable.name}_{key}"
        dims = {SHARED: f"{own} shared_error", SIDES: own}.get(key, "correlated_pair")
        dims = f"{own} {own}_column" if matrix.ndim == 2 and key != SHARED else dims
        yield Item(matrix, {"matrix": name, "pairs": dims}, words)


def _fixed(a: Analysis) -> Iterator[Item]:
    known = {p.name: p for p in a.fixed_parameters}
    for name, value in a.problem.fixed.items():
        p = known.get(name)
        about = {**shown_as(p), "source": p.source} if p else {"units": "1", "symbol": name}
        yield Item(value, {"fixed": name}, p.label if p else "fixed value", about)


def _limits(a: Analysis) -> Iterator[Item]:
    for column, v in enumerate(a.problem.model.validity):
        about = {"units": v.unit, "limit": v.value, "source": v.source}
        yield Item(column, {"limit": v.name}, v.label, about)


def _quantities(a: Analysis) -> Iterator[Item]:
    for row, q in enumerate(a.ledger.quantities if a.ledger else ()):
        yield Item(row, {"quantity": q.name}, q.label, shown_as(q))


def _fields(a: Analysis) -> Iterator[Item]:
    for estimate in a.fields:
        f = estimate.prior.field
        yield Item(estimate, {"field": f.name}, f.label, shown_as(f))


SCOPES: dict[str, Callable[[Any], Iterator[Item]]] = {
    "parameter": _parameters, "series": _series, "shared": _series, "time": _series, "walk": _walks,
    "matrix": _matrices, "fixed": _fixed, "limit": _limits, "quantity": _quantities, "field": _fields,
}  # fmt: skip


def _clock(**more: str) -> UnitRule:
    """Times of the model; ``more`` attributes."""

    def attributes(a: Analysis, _: Item) -> dict[str, str]:
        model = a.problem.model
        return {"units": model.time_unit, "display_units": model.time_display_unit, **more}

    return UnitRule("time of the model", attributes, ("units", "display_units"))


TIME, CELL_TIME, PIECE_TIME = _clock(axis="T"), _clock(), _clock(axis="T", symbol="t")
FIXED = UnitRule("its own", lambda _, item: item.about, ("units", "symbol"))
LIMIT = UnitRule("its own", lambda _, item: item.about)
PLACE = UnitRule("of the field's coordinates", lambda _, item: {"units": item.held.places.unit})
AT = UnitRule("of the field's coordinates", lambda _, item: {"units": item.held.prior.field.coordinate_unit})

PATH = When("one value at a time", lambda _, item: item.held.has_path)
PLACED = When("readings of a field", lambda _, item: item.held.places is not None)
ROBUST = When("robust cost", lambda a, _: a.down_weights is not None)
WHITENED = When("residuals that can be whitened", lambda a, _: a.residuals is not None)
TOLD = When("it can be told", lambda a, _: a.influence is not None)
DISCREPANT = When("a discrepancy is allowed for", lambda a, _: a.discrepancy is not None)
DISCREPANT_FIRST = When(DISCREPANT.words, lambda a, item: a.discrepancy is not None and item.held.begin == 0)
SEARCHED = When("a scheme that searches", lambda a, _: bool(a.modes) and a.descents is not None)
RESPONSE = When("a model with alternatives", lambda a, _: bool(a.what_if))
WITHHELD = When("readings after the window", lambda a, _: a.withheld is not None)
SAMPLED = When("a posterior that was sampled by weighted draws", lambda a, _: a.draws.size > 0)
LEDGER = When("a model with quantities of its path", lambda a, _: a.ledger is not None)


def of_series(values: Callable[[Any], Any]) -> Callable[[Analysis, Item], Array]:
    """The part of a series of numbers (…, K) of all readings."""

    def part(a: Analysis, item: Item) -> Array:
        return np.asarray(values(a))[..., item.held.where]

    return part
