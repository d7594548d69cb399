"""What does a wrong model, or a laboratory's usual sins, do to G and μ, and what does ``discrepancy: estimated``?

    python benchmarks/misspecification.py                        100 sets of each row, fitted (a) as by default and
                                                                 (b) with the discrepancy as by default
    python benchmarks/misspecification.py --n 10 --rows laser    ten sets of the rows whose name begins so
    python benchmarks/misspecification.py --minutes 4            a piece: records are kept and the next call goes on
    python benchmarks/misspecification.py --seen --n 20          what is wrong, without a fit: how much of it is seen

Truths are drawn from the stated priors, the readings made in another world than that of the fit. Reported: how often
the interval between members that holds 45 of the 49 ranks (91.8 %) covers the truth, with its binomial standard error,
the median ratio of the standard deviations (b over a) in transformed space, the share of sets that warn (graver than a
note) and of what. "a with what-if": the same of the Gaussian 90 % interval (a) whose variance has the squared shifts of
the page's what-if table added. ``--seen``: the squared residual of the true parameters in the wrong model, what of it
is left after the move along the parameters that takes up most (linear, about the truth; of as many degrees of freedom
as there are readings more than parameters), and how far that moves them. The number of a set is its seed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from acoustic_twin import MODEL, WIDE, make_twin, prior
from laser_twin import make_laser_twin
from records import Record, fill
from worlds import CENTRAL, Twin, World, experiment

from en4dvar.config.context import Context
from en4dvar.config.of_readings import DiscrepancySection
from en4dvar.data.noise import noise_of
from en4dvar.ensemble.forecast import forecast
from en4dvar.model.state import READING_SCALE
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem, discrepancy_parameters
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.laws.kelvin_voigt import FungKelvinVoigt, NeoHookeanKelvinVoigt, QuadraticKelvinVoigt
from en4dvar_bubble.laws.maxwell import ZenerNeoHookean, ZenerQuadratic
from en4dvar_bubble.laws.parameters import ALPHA, MU_P

SETTINGS = {"a": AssimilationSettings(), "b": AssimilationSettings(what_if=False)}
LASER = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser")  # with the default gas
REPORTED = ("G", "mu")
MEMBERS = 48
NINETY = 1.645
EPSILON = 1e-3  # prior standard deviations of a difference
WIDE_PRIOR = prior(WIDE)


def acoustic(**differs: Any) -> Callable[[int], Twin]:
    """Sets of a driven bubble, wide priors, read in a world that ``differs``."""
    return lambda seed: make_twin(seed, WIDE_PRIOR, world=World(**differs))


def laser(**differs: Any) -> Callable[[int], Twin]:
    """Sets of a laser-induced bubble with rebounds in a neo-Hookean gel."""
    return lambda seed: make_laser_twin(seed, LASER, World(**differs))


def fung(seed: int) -> Twin:
    """A gel that stiffens exponentially, fitted by the first term of the series."""
    stiffens = PriorTerm.lognormal(ALPHA, 0.02, 0.5)
    made, fit = (BubbleModel(law=law(), start="laser") for law in (FungKelvinVoigt, QuadraticKelvinVoigt))
    return make_laser_twin(seed, fit, World(made), (stiffens,))


def knowing(make: Callable[[int], Twin], term: PriorTerm, model: BubbleModel | None = None) -> Callable[[int], Twin]:
    """The same sets, fitted with what the laboratory does not know as one more parameter (of ``model``)."""

    def twin(seed: int) -> Twin:
        made = make(seed)
        of = Prior((*made.problem.prior.terms, term))
        return Twin(replace(made.problem, prior=of, model=model or made.problem.model), made.truth)

    return twin


STRONGER = replace(MODEL, driving=replace(MODEL.driving, amplitude=1.05 * MODEL.driving.amplitude))
OF_PULSE = MODEL.with_parameters(("p_A",))
PULSE = PriorTerm.normal(OF_PULSE.parameters[-1], MODEL.driving.amplitude, 0.05 * abs(MODEL.driving.amplitude))
SCALE = PriorTerm.lognormal(READING_SCALE, 1.0, 0.03)
MEMORY: dict[str, Any] = {"renamed": {"mu": MU_P}, "fixed": {"relaxation_time": 1e-6}}
ROWS: dict[str, Callable[[int], Twin]] = {
    "acoustic, as stated": acoustic(),
    "laser, as stated": laser(),
    "laser, vapour and conducting medium": laser(model=replace(LASER, vapour="transport", medium_heat="conducting")),
    "laser, Fung by quadratic": fung,
    "acoustic, pulse 5 % stronger": acoustic(model=STRONGER),
    "acoustic, memory of 1 us by none": acoustic(model=BubbleModel(law=ZenerQuadratic()), **MEMORY),
    "laser, memory of 1 us by none": laser(model=replace(LASER, law=ZenerNeoHookean()), **MEMORY),
    "acoustic, errors correlated over 3 us": acoustic(correlation_time=3e-6),
    "laser, errors correlated over 3 us": laser(correlation_time=3e-6),
    "acoustic, radii 3 % too large": acoustic(scale=1.03),
    "laser, radii 3 % too large": laser(scale=1.03),
    "laser, radii 3 % too large, scale known to 3 %": knowing(laser(scale=1.03), SCALE),
    "acoustic, pulse 5 % stronger, known to 5 %": knowing(acoustic(model=STRONGER), PULSE, OF_PULSE),
    "laser, as stated, scale known to 3 %": knowing(laser(), SCALE),
    "laser, 5 % outliers of 8 std": laser(outliers=0.05),
    "laser, instants off by up to 0.5 us": laser(jitter=0.5e-6),
}


def with_discrepancy(problem: InverseProblem, given: Mapping[str, Any] = MappingProxyType({})) -> InverseProblem:
    """As ``data.error.discrepancy`` has it; {} means ``estimated``."""
    observed, context = problem.observations, Context(Path(), problem.model, observed=problem.observable)
    section = DiscrepancySection.model_validate(given, context=context)
    times, parameters = observed.times, discrepancy_parameters(problem.model, problem.observable)
    terms = section.terms(parameters, float(observed.values.max()), float(times[-1] - times[0]))
    noise = noise_of(observed.noise.std, observed.noise.time_std, discrepancy=section.kernel_at(times))
    return replace(problem, observations=replace(observed, noise=noise), prior=Prior((*problem.prior.terms, *terms)))


def fitted(key: str) -> Record:
    """One set of a row, by one of the fits."""
    name, fit, seed = key.rsplit("/", 2)
    twin = ROWS[name](int(seed))
    if fit == "b":
        twin = Twin(with_discrepancy(twin.problem), twin.truth)
    return {**experiment(int(seed), twin, SETTINGS[fit]), "names": twin.problem.prior.names[: len(twin.truth)]}


def seen(key: str) -> Record:
    """χ² (of K readings) of the truth in the model of the fit, and after the best linear move of its parameters."""
    name, seed = key.rsplit("/", 1)
    twin = ROWS[name](int(seed))
    problem, n = twin.problem, len(twin.problem.prior.names)
    x = np.append(twin.truth, problem.prior.mean[len(twin.truth) :])
    near = EPSILON * np.diag(problem.prior.std)
    predicted = forecast(problem, np.vstack([x, x + near, x - near])).predictions / problem.observations.noise.std
    slopes = (predicted[1 : n + 1] - predicted[n + 1 :]) / (2 * EPSILON)
    residual = problem.observations.values / problem.observations.noise.std - predicted[0]
    covariance = np.linalg.inv(np.eye(n) + slopes @ slopes.T)
    moved = covariance @ slopes @ residual
    return {
        "readings": len(residual),
        "at_truth": float(residual @ residual),
        "left": float(np.sum((residual - slopes.T @ moved) ** 2)),
        "moved": dict(zip(problem.prior.names, np.abs(moved) / np.sqrt(np.diag(covariance)), strict=True)),
    }


def table_of_seen(rows: Sequence[str], found: dict[str, Record]) -> None:
    """Medians, a line a row."""
    print("| what is wrong | sets | readings | χ² of the truth | left | G moves by (std) | μ |")
    print("|---|---|---|---|---|---|---|")
    for name in rows:
        good = [r for key, r in found.items() if key.rsplit("/", 1)[0] == name and np.isfinite(r["left"])]
        cells = [f"{np.median([r[what] for r in good]):.0f}" for what in ("readings", "at_truth", "left")]
        cells += [f"{np.median([r['moved'][parameter] for r in good]):.1f}" for parameter in REPORTED]
        print(f"| {name} | {len(good)} | {' | '.join(cells)} |")


def covered(records: Sequence[Record], name: str) -> str:
    """Coverage with its standard error."""
    return _share([2 * abs(r["rank"][r["names"].index(name)] - MEMBERS / 2) < CENTRAL[1] for r in records])


def covered_with_shifts(records: Sequence[Record], name: str) -> str:
    """Coverage by a Gaussian interval that counts every shift of the what-if table as one more standard deviation."""
    inside = []
    for r in records:
        j = r["names"].index(name)
        wider = np.sqrt(1 + sum(shift[j] ** 2 for shift in r["what_if"].values()))
        inside.append(abs(r["truth"][j] - r["mean"][j]) < NINETY * wider * r["std"][j])
    return _share(inside)


def _share(inside: Sequence[bool]) -> str:
    share = float(np.mean(inside))
    return f"{share:.0%} ± {np.sqrt(share * (1 - share) / len(inside)):.0%}"


def warned(records: Sequence[Record]) -> str:
    """How many warn, and of what most."""
    counts = Counter(code for r in records for code in set(r["graver"]))
    told = ", ".join(f"{code} {count}" for code, count in counts.most_common(3))
    return f"{np.mean([bool(r['graver']) for r in records]):.0%} ({told})" if told else "0%"


def line(name: str, found: dict[str, Record], seeds: Sequence[int]) -> str:
    """The row of the table; sets of which either fit failed are left out and counted."""
    pairs = [[found.get(f"{name}/{fit}/{seed}", {}) for fit in SETTINGS] for seed in seeds]
    good = [pair for pair in pairs if all("rank" in r for r in pair)]
    if not good:
        return f"| {name} | 0 |"
    a, b = ([pair[i] for pair in good] for i in range(2))
    cells = [covered(records, parameter) for records in (a, b) for parameter in REPORTED]
    cells += [covered_with_shifts(a, parameter) for parameter in REPORTED]
    for parameter in REPORTED:
        j = a[0]["names"].index(parameter)
        cells.append(f"{np.median([y['std'][j] / x['std'][j] for x, y in good]):.2f}")
    return f"| {name} | {len(good)} of {len(pairs)} | {' | '.join([*cells, warned(a), warned(b)])} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--start", type=int, default=0, help="first set (its seed)")
    parser.add_argument("--n", type=int, default=100, help="sets of each row")
    parser.add_argument("--rows", default="", help="beginning of the names of the rows wanted")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no fit after so long")
    parser.add_argument("--seen", action="store_true", help="how much of what is wrong can be seen, without a fit")
    parser.add_argument("--records", type=Path, default=Path("runs/misspecification"), help="folder of the records")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.n)
    rows = [name for name in ROWS if name.startswith(options.rows)]
    if options.seen:
        keys = [f"{name}/{seed}" for seed in seeds for name in rows]
        table_of_seen(rows, fill(options.records / "seen.jsonl", keys, seen, options.minutes))
        return
    keys = [f"{name}/{fit}/{seed}" for seed in seeds for name in rows for fit in SETTINGS]
    found = fill(options.records / "fits.jsonl", keys, fitted, options.minutes)
    heads = ["what is wrong", "sets", "G covered, a", "μ, a", "G, b", "μ, b", "G, a with what-if", "μ, a with what-if"]
    heads += ["std of G, b/a", "of μ", "a warns", "b warns"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for name in rows:
        print(line(name, found, seeds))


if __name__ == "__main__":
    main()
