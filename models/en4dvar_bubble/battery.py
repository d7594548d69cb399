"""Checks that every constitutive law must pass: the same checks for the shared tests and for ``en4dvar laws --check``.

A check takes a law and raises :class:`AssertionError` or :class:`UnfitError` with the reason, and with the parameter
values and the worst place. All run at the law's example values, over its ``stretch_range``. :func:`respond` is for
looking at a law on its own as well: slow, and independent of the compiled solver.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.user_code import line_of, reason_of
from en4dvar_bubble.laws import exactness
from en4dvar_bubble.laws.base import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import columns
from en4dvar_bubble.laws.tabulate import GRID, differentiate
from en4dvar_bubble.tables import evaluate

Check = Callable[[ConstitutiveLaw], None]
_RATES = np.logspace(-2, 12, 57)


@dataclass(frozen=True)
class Cycle:
    """λ(t) = extreme^{sin²(πt/period)}, one closed cycle from rest, ``period`` in s."""

    extreme: float
    period: float

    def stretch(self, t: Array) -> Array:
        return np.asarray(self.extreme ** np.sin(np.pi * t / self.period) ** 2)

    def rate(self, t: Array) -> Array:
        """V = Ṙ/R in 1/s."""
        return np.asarray(np.log(self.extreme) * np.pi / self.period * np.sin(2 * np.pi * t / self.period))


@dataclass(frozen=True)
class Response:
    """J (K,) in Pa at ``times`` (K,) in s, its elastic part, and the work per 4πR0³ (Pa) that the cycle costs:
    −∫ J λ² dλ. ``turnover`` is ∫ |J| λ² |dλ|, what the work is to be compared with.
    """

    times: Array
    J: Array
    work: float
    elastic_work: float
    turnover: float


def respond(law: ConstitutiveLaw, values: Mapping[str, Array], cycle: Cycle, points: int = 400) -> Response:
    """Integrate one member (``values``: name → (1,)) over a cycle, relaxed at its start."""
    from scipy.integrate import solve_ivp

    variables = law.memory(columns(values))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0, cycle.period, points // 8 + 1)
    half = np.diff(edges)[:, None] / 2
    times = (edges[:-1, None] + half * (nodes + 1)).ravel()
    weight = (half * weights).ravel()
    stretch, rate = cycle.stretch(times), cycle.rate(times)
    elastic = law.elastic_stress(stretch[None], values)[0]
    J = elastic - 4 * law.mean_viscosity(np.abs(rate)[None], values, stretch[None])[0] * rate
    if variables:
        theta = np.array([_scalar(v.relaxation_time) for v in variables])
        k = np.array([v.convection for v in variables])

        def rhs(t: float, s: Array) -> Array:
            x, V = cycle.stretch(np.array([t])), float(cycle.rate(np.array(t)))
            a = np.array([_scalar(v.stiffness_at(x)) for v in variables])
            b = np.array([_scalar(v.equilibrium_at(x)) for v in variables])
            return np.asarray((b - s) / theta + V * (k * s + a))

        start = np.array([_scalar(v.equilibrium_at(np.ones(1))) for v in variables])
        stiffest = max(abs(_scalar(v.stiffness_at(np.ones(1)))) for v in variables) or 1.0
        solution = solve_ivp(
            rhs, (0, cycle.period), start, "LSODA", t_eval=times, rtol=1e-10, atol=1e-11 * stiffest,
            max_step=cycle.period / 50,
        )  # fmt: skip
        J = J + solution.y.sum(axis=0)
    flux = weight * stretch**3 * rate
    turnover = float(np.sum((np.abs(J) + np.abs(elastic)) * np.abs(flux)))
    return Response(times, J, -float(J @ flux), -float(elastic @ flux), turnover)


def _scalar(value: float | Array) -> float:
    return float(np.ravel(value)[0])


def cycles(law: ConstitutiveLaw) -> tuple[Cycle, ...]:
    """Closed cycles inside the stretch range, fast and slow, in tension and in compression."""
    lowest, highest = law.stretch_range
    return Cycle(min(3.0, highest), 1e-6), Cycle(min(3.0, highest), 1e-4), Cycle(max(1 / 1.5, lowest), 1e-6)


def run_battery(law: ConstitutiveLaw) -> dict[str, str]:
    """All checks on one law, in words, and the reason why it fails, "" where it passes."""
    return {words: _reason(check, law) for words, check in CHECKS.items()}


def small_strain(law: ConstitutiveLaw) -> str:
    """Shear modulus and viscosity at small strain and rate: what no check can know, and the author can."""
    values = law.example_values()
    slope = evaluate(differentiate(law.table(values)), GRID.span, np.zeros((1, 1)))[0, 0]
    viscosity = law.mean_viscosity(np.array([[_RATES[0]]]), values)[0, 0]
    branches = ", without its memory" if law.memory_tables(values).convection.size else ""
    return f"shear modulus {0.0 - slope / 4:.4g} Pa, viscosity {viscosity:.4g} Pa s{branches} ({_at(values)})"


def documented(law: ConstitutiveLaw) -> None:
    missing = [] if law.title else ["a title"]
    if "$" not in (type(law).__doc__ or ""):
        missing.append("a formula in LaTeX ($…$) in the docstring")
    missing += [f"bounds of {p.name}" for p in law.parameters if p.bounds == (-np.inf, np.inf)]
    assert not missing, "the class lacks " + "; ".join(missing)


def no_stress_without_strain(law: ConstitutiveLaw) -> None:
    exactness.refuse_stress_at_rest(law, 1e-9)


def stress_falls_with_stretch(law: ConstitutiveLaw) -> None:
    exactness.refuse_wrong_sign(law)
    stretch, J = _elastic(law)
    if not law.monotone or not np.any(J):
        return
    rise = np.diff(J) >= 0
    assert not np.any(rise), f"J rises with λ at λ = {stretch[:-1][rise][0]:.4g} ({_at(law.example_values())})"


def parameters_act(law: ConstitutiveLaw) -> None:
    values = law.example_values()
    own = exactness.numbers_of(law, values)
    for p in law.parameters:
        value = values[p.name]
        moved = np.clip([1.3 * value + (value == 0), 0.7 * value], *p.bounds)
        other = exactness.numbers_of(law, values | {p.name: moved[0] if moved[0] != value else moved[1]})
        acts = any(not np.array_equal(own[what], other[what], equal_nan=True) for what in own)
        assert acts or p.name == law.rest_tension, f"{p.name} changes neither stress nor viscosity nor memory"


def finite(law: ConstitutiveLaw) -> None:
    values = law.example_values()
    stretch, J = _elastic(law)
    bad = ~np.isfinite(J)
    assert not np.any(bad), f"J is not finite at λ = {stretch[bad][0]:.4g} ({_at(values)})"
    mu = law.mean_viscosity(_RATES[None], values)[0]
    bad = ~(np.isfinite(mu) & (mu >= 0))
    assert not np.any(bad), f"viscosity {mu[bad][0]:.3g} Pa s at |V| = {_RATES[bad][0]:.3g} 1/s ({_at(values)})"
    tables = law.memory_tables(values)
    x = np.log(stretch)[None]
    for i in range(len(tables.convection)):
        for what, table in (("stiffness", tables.stiffness), ("equilibrium", tables.equilibrium)):
            bad = ~np.isfinite(evaluate(table[:, i], GRID.span, x)[0])
            where = f"{what} of memory variable {i + 1}"
            assert not np.any(bad), f"{where} is not finite at λ = {stretch[bad][0]:.4g} ({_at(values)})"


def table_has_the_slope_of_the_law(law: ConstitutiveLaw) -> None:
    """The table of a law that is too sharp for that has halved cells, and holds its stress to 1e-7."""
    exactness.refuse_inexact(type(law))
    if exactness.is_sharp(type(law)):
        return
    error, stretch = exactness.slope_error(law)
    assert error < exactness.TABLE_ERROR, (
        f"relative error {error:.2g} of dJ/dλ at λ = {stretch:.4g} ({_at(law.example_values())}); kinked = True in the "
        "class halves the cells of its table"
    )


def limits_hold(law: ConstitutiveLaw) -> None:
    for parent_type, special in type(law).__dict__.get("limits", ()):
        parent = parent_type()
        known = [p.name for p in (*law.parameters, *parent.parameters)]
        unknown = [name for name in special if name not in known]
        assert not unknown, f"limits: {unknown[0]!r} is not a parameter of the law{suggest(unknown[0], known)}"
        told = law.example_values() | {n: np.array([v]) for n, v in special.items()}
        merged = parent.example_values() | told
        untold = _at({name: merged[name] for name in parent.example_values() if name not in told})
        run_at = f"; the parent was run at its own {untold}, which the values do not give" if untold else ""
        for cycle in cycles(law):
            own, theirs = (respond(kind, {name: merged[name] for name in kind.example_values()}, cycle).J
                           for kind in (law, parent))  # fmt: skip
            scale = np.max(np.abs(theirs)) or np.max(np.abs(respond(law, law.example_values(), cycle).J))
            error = np.max(np.abs(own - theirs)) / scale
            assert error < 1e-7, f"differs from {parent.name} by {error:.2g} of its largest stress at {special}{run_at}"


def dissipates(law: ConstitutiveLaw) -> None:
    values = law.example_values()
    for cycle in cycles(law):
        response = respond(law, values, cycle)
        scale = response.turnover
        assert abs(response.elastic_work) <= 1e-7 * scale, f"the spring gives or takes work over {cycle}"
        assert response.work >= -1e-7 * scale, f"a cycle {cycle} releases energy ({_at(values)})"


CHECKS: Mapping[str, Check] = {
    "Title, formula, and bounds of every parameter": documented,
    "No stress without strain: J, or W′, is zero at λ = 1, at rest": no_stress_without_strain,
    "The elastic stress opposes the strain: J falls as λ grows (where the law claims it: monotone)":
        stress_falls_with_stretch,
    "Finite over the stretch range, and over shear rates from 1e-2 to 1e12 1/s with viscosity ≥ 0": finite,
    "dJ/dλ of the table agrees with finite differences of the stress, or with −W′/(λ³ − 1), to 1e-6":
        table_has_the_slope_of_the_law,
    "With the declared values of its parameters the law is its parent, over closed cycles": limits_hold,
    "A closed cycle from rest costs work, or none where the law is elastic": dissipates,
    "Two members beside each other have the numbers that each has alone": exactness.refuse_mixed_members,
    "Every parameter acts": parameters_act,
}  # fmt: skip


def _reason(check: Check, law: ConstitutiveLaw) -> str:
    try:
        check(law)
    except (AssertionError, exactness.UnfitError) as error:
        return str(error)
    except BaseException as error:
        return f"{reason_of(error)}{line_of(error)}"
    return ""


def _elastic(law: ConstitutiveLaw) -> tuple[Array, Array]:
    stretch = np.geomspace(*law.stretch_range, 400)
    return stretch, law.elastic_stress(stretch[None], law.example_values())[0]


def _at(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {v[0]:.3g}" for name, v in values.items())
