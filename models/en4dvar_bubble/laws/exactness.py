"""Whether a law is one, and its table the law. That of one with kinks or features narrower than the cells of the grid
has cells halved where it takes; what cannot be tabulated is refused, by name.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.laws.parameters import columns
from en4dvar_bubble.laws.tabulate import GRID, Function, accumulated, differentiate, from_function, from_strain_energy
from en4dvar_bubble.tables import GAUSS, LOBATTO, evaluate, to_coefficients

ERROR = 1e-7
"""Largest error of the stress, relative to the larger of its size there and its largest between λ = 1/2 and 2. Where
cells may still be halved a hundredth of it is asked for, and of the slope 1e-5 of its largest in the cell."""
HALVINGS = 24
"""A kink lies in a cell of 1/32 · 2⁻²⁴ = 2e-9 of ln λ."""
_MOST = 2000  # cells that are halved at once: noise would have all of them halved
_CHECKED = np.array([1e-3, 0.04, 0.2, 0.41, 0.5, 0.59, 0.8, 0.96, 0.999])
_TO_THE_END = 12  # halvings of the cell where a function ends: to 1e-5 of λ
_BESIDE = np.array([-64, 64])  # cells: so near the end of a function it may grow without bound


class Refined(NamedTuple):
    """``table`` (cells, 8) of one member, with one cell more than it needs, and ``x``, ln λ of the middle of the cells
    (K,) that hold the function to less than :data:`ERROR`: their coefficients are NaN.
    """

    table: Array
    x: Array


def refine(function: Callable[[Array], Array], slope: bool) -> Refined:
    """A table on :data:`GRID` of a function of ln λ (K,) → (K,), or of that whose ``slope`` it is and which is zero at
    ln λ = 0.

    Each cell is compared with the function at nine points that it was not made from. What lies between them, at first
    1/160 apart, is not seen. Cells in which the function is finite at some points and not at others are halved, so
    that the table ends where the function does, to 1e-5.
    """
    points = GAUSS if slope else LOBATTO
    fit = to_coefficients(points)
    asked, to_checked = np.append(points, _CHECKED), np.vander(_CHECKED, len(points), increasing=True).T
    begins = left = GRID.within(np.zeros(1))[:, 0]
    places, records, inexact = np.arange(GRID.cells), np.zeros((GRID.cells, 8)), []
    central = floor = 0.0
    for level in range(HALVINGS + 1):
        width = GRID.step * 0.5**level
        both = np.reshape(function((left[:, None] + width * asked).ravel()), (len(left), -1))
        values, exact = both[:, : len(points)], both[:, len(points) :]
        made = values @ fit
        difference = made @ to_checked - exact
        known = np.isfinite(both)
        error = np.abs(difference).max(axis=1)
        size = np.abs(exact).max(axis=1, where=known[:, len(points) :], initial=0.0)
        if level == 0:
            middle = size[np.abs(left) < np.log(2)]
            central = float(np.max(middle, initial=0.0))
            floor = central * (np.log(2) if slope else 1.0)
            scale = np.maximum(floor, size)  # halves keep it: what grows without bound is not held
        if slope:
            wrong_slope, error = error, error * width
            largest_slope = np.maximum(size, 1e-3 * central)
        else:
            wrong_slope = error / width
            largest_slope = np.maximum(np.ptp(exact, axis=1) / width, 1e-3 * floor)
        with np.errstate(invalid="ignore"):
            halved = (error > 0.01 * ERROR * scale) | (wrong_slope > 1e-5 * largest_slope) & (error > 1e-13 * scale)
            bad = error > ERROR * scale
        if level < _TO_THE_END:
            halved |= known.any(axis=1) & ~known.all(axis=1)
        records[places, int(slope) : 6] = made * width / np.arange(1, 6) if slope else made
        records[places, 6] = 2.0**level
        if level == HALVINGS or halved.sum() > _MOST:
            records[places[bad], :6] = np.nan
            inexact = left[bad] + width / 2
            beside = inexact[:, None] + _BESIDE * width
            inexact = inexact[np.isfinite(np.reshape(function(beside.ravel()), beside.shape)).all(axis=1)]
            break
        if not halved.any():
            break
        children = len(records) + 2 * np.arange(halved.sum())
        records[places[halved], 7] = children
        records = np.concatenate([records, np.zeros((2 * len(children), 8))])
        places = np.stack([children, children + 1], axis=1).ravel()
        left, scale = (left[halved][:, None] + [0.0, width / 2]).ravel(), np.repeat(scale[halved], 2)
        begins = np.concatenate([begins, left])
    if slope:
        _add_up(records, begins)
    return Refined(np.concatenate([records, np.zeros((1, 8))]), np.asarray(inexact, dtype=float))


def _add_up(records: Array, begins: Array) -> None:
    """Give each cell of an antiderivative its value on the left. ``begins``: ln λ there, of all cells."""
    leaves = np.flatnonzero(records[:, 7] == 0)
    leaves = leaves[np.argsort(begins[leaves])]
    records[leaves, 0] = accumulated(records[leaves, 1:6].sum(axis=1), int(np.searchsorted(begins[leaves], 0.0)))


TABLE_ERROR = 1e-6
"""Largest relative error of dJ/dλ in a uniform table; that of J is a hundredth of it."""
_PACKAGE = f"{__package__}."
F = TypeVar("F", bound=Callable[..., Any])
_POINTS_IN_CELL = 8
_STENCIL = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
_STEP = 5e-3


def slope_error(law: Any) -> tuple[float, float]:
    """Largest relative error of dJ/dλ in a uniform table at the example values, and the stretch where it is; NaN where
    the law has no value inside its range.
    """
    values = law.example_values()
    lowest, highest = np.log(law.stretch_range)
    x = np.arange(lowest, highest, GRID.step / _POINTS_IN_CELL)
    stretch = np.exp(x[np.abs(x) > 1e-3])
    p = columns(values)
    with np.errstate(all="ignore"):  # a law may overflow at stretches that no member reaches
        if law.closed_form:
            near = stretch * (1 + _STEP * np.arange(-4, 5)[:, None])
            samples = [np.broadcast_to(law.stress(at, p), (1, len(at)))[0] for at in near]
            exact = _STENCIL @ np.stack(samples) / (_STEP * stretch)
            uniform = from_function(lambda at: law.stress(at, p), 1)
        else:
            exact = -np.broadcast_to(law.strain_energy_rate(stretch, p), (1, len(stretch)))[0] / (stretch**3 - 1)
            uniform = from_strain_energy(lambda at: law.strain_energy_rate(at, p), 1)
    table = evaluate(differentiate(uniform), GRID.span, np.log(stretch)[None])[0] / stretch
    scale = np.abs(exact) + 1e-6 * np.max(np.abs(exact * stretch)) / stretch
    error = np.where(scale > 0, np.abs(table - exact) / np.where(scale > 0, scale, 1), np.abs(table))
    worst = int(np.argmax(error))
    return float(error[worst]), float(stretch[worst])


_once: Callable[[F], F] = cast(Any, cache)  # for functions of a class, which mypy takes for unhashable


@_once
def is_sharp(kind: type[Any]) -> bool:
    """Whether a law has a uniform table that is wrong; those of the package say so, and tests hold them to it."""
    if kind.__module__.startswith(_PACKAGE):
        return bool(kind.kinked)
    try:
        with np.errstate(all="ignore"):
            return slope_error(kind())[0] >= TABLE_ERROR
    except Exception:  # what is wrong with the methods is told by those who call them
        return False


_AROUND = np.array([0.9, 1.0, 1.1])
_RATES = np.logspace(-2, 12, 15)


class UnfitError(ValueError):
    """A class is no law; unlike another :class:`ValueError`, which its methods may raise."""


def _elastic(law: Any) -> tuple[str, Array, int]:
    """What an author writes, J or W′, at :data:`_AROUND` in Pa, and its sign where it pushes the wall outwards."""
    what, function, outwards = ("J", law.stress, 1) if law.closed_form else ("W′", law.strain_energy_rate, -1)
    with np.errstate(all="ignore"):
        return what, np.broadcast_to(function(_AROUND, columns(law.example_values())), (1, 3))[0], outwards


def refuse_stress_at_rest(law: Any, tolerance: float = ERROR) -> None:
    """Raise :class:`UnfitError` where J or W′ is not zero at λ = 1 and at rest: J of such a W′ is infinite."""
    what, elastic, _ = _elastic(law)
    memory = sum(float(np.ravel(v.equilibrium_at(_AROUND[1:2]))[0]) for v in law.memory(columns(law.example_values())))
    if abs(elastic[1] + memory) > tolerance * np.max(np.abs(elastic)):
        raise UnfitError(
            f"{law.name}: a stress without strain: at rest, {what} is {elastic[1] + memory:.3g} Pa at λ = 1. It must "
            "be zero there: check signs and exponents, or subtract it"
        )


def refuse_wrong_sign(law: Any) -> None:
    """Raise :class:`UnfitError` where the elastic stress drives the wall away from λ = 1 on both sides."""
    what, elastic, outwards = _elastic(law)
    if elastic[0] * outwards < 0 < elastic[2] * outwards:
        raise UnfitError(
            f"{law.name}: its elastic stress drives the wall away from its rest, {what} being {elastic[0]:.3g} Pa at "
            f"λ = 0.9 and {elastic[2]:.3g} Pa at λ = 1.1. Change its sign: J is below zero where the medium pulls the "
            "wall inwards, and W′ is above zero where λ > 1"
        )


def refuse_mixed_members(law: Any) -> None:
    """Raise :class:`UnfitError` where the numbers of a member depend on those beside it."""
    bounds = {p.name: p.bounds for p in law.parameters}
    alone = law.example_values()
    other = {name: np.clip(1.3 * v, *bounds.get(name, (0, np.inf))) for name, v in alone.items()}
    together = {name: np.append(v, other[name]) for name, v in alone.items()}
    with np.errstate(all="ignore"):
        both, *single = (numbers_of(law, values) for values in (together, alone, other))
    for member, numbers in enumerate(single):
        for what, own in numbers.items():
            if not np.allclose(both[what][member], own[0], rtol=1e-9, atol=0, equal_nan=True):
                raise UnfitError(
                    f"{law.name}: {what} of a member depends on the members beside it: every p.name is a column "
                    "(N, 1), one row for each member; write each row of the result from its own row alone"
                )


def numbers_of(law: Any, values: Mapping[str, Array]) -> dict[str, Array]:
    """What the solver reads of N members, (N, …) each, by name."""
    n, memory, (lowest, highest) = len(next(iter(values.values()))), law.memory_tables(values), law.stretch_range
    stretch = np.broadcast_to(np.geomspace(lowest, highest, 15), (n, 15))
    return {
        "the elastic stress": law.elastic_stress(stretch, values),
        "the viscosity": law.mean_viscosity(np.broadcast_to(_RATES, (n, 15)), values, stretch),
        "the memory": np.concatenate(
            [part.reshape(n, -1) for part in (memory.relaxation_time, memory.stiffness, memory.equilibrium)], axis=1
        ),
    }


@_once
def refuse_unfit(kind: type[Any]) -> None:
    """Raise :class:`UnfitError` for a user's class that is no law at its example values (tests hold those of the
    package to it), and for one that :func:`refuse_inexact` refuses.
    """
    law = kind()
    if not kind.__module__.startswith(_PACKAGE):
        try:
            if not law.closed_form:  # a coating may have a tension at rest
                refuse_stress_at_rest(law)
            refuse_wrong_sign(law)
            refuse_mixed_members(law)
        except UnfitError:
            raise
        except Exception:  # what is wrong with the methods is told by those who call them
            return
    refuse_inexact(kind)


@_once
def refuse_inexact(kind: type[Any]) -> None:
    """Raise :class:`UnfitError` for a sharp law whose stress jumps, or is too rough for cells however narrow, and for
    one whose other functions of the stretch, for which no cells are halved, a uniform table does not hold.
    """
    law = kind()
    if law.strain_dependent or law.memory_count:
        _refuse_rough(law)
    if not is_sharp(kind):
        return
    lowest, highest = law.stretch_range
    inexact = np.exp(law.refined(law.example_values()).x)
    inexact = inexact[(inexact > lowest) & (inexact < highest)]
    if len(inexact):
        raise UnfitError(
            f"{law.name}: its stress changes too sharply for the table that the solver reads: at λ = {inexact[0]:.6g} "
            f"it jumps, or is too rough for cells of {GRID.step * 0.5**HALVINGS:.0e} in ln λ to hold it to {ERROR:g} "
            "of its size. Make it continuous there (a kink does no harm), return NaN from where on the law has no "
            "values, or narrow stretch_range to where it is continuous, if bubbles stay inside (en4dvar laws --check "
            "says more)"
        )


def _refuse_rough(law: Any) -> None:
    """Raise :class:`UnfitError` where a table is 1e-6 off a viscosity or memory function, or its largest near λ = 1."""
    p, (lowest, highest) = columns(law.example_values()), np.log(law.stretch_range)
    x = np.arange(lowest, highest, GRID.step / _POINTS_IN_CELL)
    functions: dict[str, Function] = {}
    if law.strain_dependent:
        functions["its strained_viscosity"] = lambda stretch: law.strained_viscosity(stretch, p)
    for i, variable in enumerate(law.memory(p)):
        functions[f"the stiffness of its memory variable {i + 1}"] = variable.stiffness_at
        functions[f"the equilibrium of its memory variable {i + 1}"] = variable.equilibrium_at
    for what, function in functions.items():
        with np.errstate(all="ignore"):
            exact = np.broadcast_to(function(np.exp(x)), (1, len(x)))[0]
            error = np.abs(evaluate(from_function(function, 1), GRID.span, x[None])[0] - exact)
            allowed = TABLE_ERROR * np.maximum(np.abs(exact), np.max(np.abs(exact[np.abs(x) < np.log(2)]), initial=0.0))
        if np.any(error > allowed):
            where = np.exp(x[np.argmax(error - allowed)])
            raise UnfitError(
                f"{law.name}: {what} changes too sharply near λ = {where:.3g} for the table that the solver reads, "
                f"whose cells are {GRID.step:g} wide in ln λ: make it smoother there, or narrow stretch_range to where "
                "it is smooth, if bubbles stay inside"
            )
