"""The bubble solver against general-purpose integrators and against itself: one command, one run, ratios.

    python benchmarks/solver.py [--docs]

Prints Markdown tables; ``--docs`` writes them between the markers of ``docs/solver.md``. CVODE needs
``pip install scikit-sundae``; it is left out by name where that is missing. Timings of one run are interleaved, and of
single threads the processor time is taken, so that a busy machine disturbs the ratios little.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scalar_bubble import Array, Integrator, Problem, constants, cvode, lsoda, run

from en4dvar.executor import Executor, SerialExecutor, ThreadsExecutor
from en4dvar_bubble import Accuracy, BubbleModel, get_law, simulate
from en4dvar_bubble.collapse import RAYLEIGH
from en4dvar_bubble.solver.driver import ACCURACIES, preset
from en4dvar_bubble.solver.integrate import MAX_MACH, SMEAR, STEPS

CENTRE = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}  # the paper's 1 % gel
SPREAD = 0.3
RELEASED = {"G": 2770.0, "mu": 0.186, "R_max": 230e-6, "R_eq": 230e-6 / 7}  # polyacrylamide
PHYSICS: dict[str, dict[str, Any]] = {
    "polytropic": {"gas": "polytropic"},
    "heat": {},
    "heat, conducting medium": {"medium_heat": "conducting"},
    "heat, vapour transport": {"vapour": "transport"},
    "heat, vapour transport, conducting medium": {"vapour": "transport", "medium_heat": "conducting"},
}
TIMES = np.linspace(6e-6, 80e-6, 60)
RELEASED_TIMES = np.linspace(1e-6, 60e-6, 60)
BASELINE_MEMBERS = 12  # of the 48, for the slow integrators
SINGLE_MEMBERS = 5  # likewise, of every physics
_FORECASTS = 10  # in a row between two runs of a slow integrator, which empties the caches
DOCS = Path(__file__).resolve().parents[1] / "docs" / "solver.md"


def members(n: int) -> dict[str, Array]:
    """The 48 members of the study, repeated as often as needed."""
    rng = np.random.default_rng(0)
    first = {name: value * np.exp(SPREAD * rng.standard_normal(48)) for name, value in CENTRE.items()}
    return {name: np.resize(values, n) for name, values in first.items()}


def forecast(model: BubbleModel, x: Array, executor: Executor | None = None) -> Array:
    """R (N, K) in m through the framework's executor, as an assimilation sees it."""
    paths: Any = (executor or SerialExecutor()).trajectories(model, x, TIMES)
    return np.asarray(model.observables[0].operator(paths))


def median_time(call: Callable[[], object], repeats: int) -> float:
    """Median processor seconds of a call, after one to warm up."""
    return interleaved([call], repeats)[0]


def interleaved(
    calls: list[Callable[[], object]], repeats: int, clock: Callable[[], float] = time.process_time
) -> list[float]:
    """Median seconds of each call, in rounds of all calls, the first of which does not count."""
    spent: list[list[float]] = [[] for _ in calls]
    for turn in range(repeats + 1):
        for call, times in zip(calls, spent, strict=True):
            begin = clock()
            call()
            if turn:
                times.append(clock() - begin)
    return [statistics.median(times) for times in spent]


def rms(R: Array, exact: Array) -> Array:
    """rms over the observations of the error of R, over R_max, per member."""
    return np.sqrt(np.mean((R - exact) ** 2, axis=1)) / exact.max(axis=1)


def tuned(radii: Callable[[float], Array], exact: Array, target: float) -> tuple[float, float]:
    """The tolerance whose median error of R (N, K) is ``target``, by secant steps in logarithms, and that error."""
    rtol, slope = target / 3, 1.0
    last: tuple[float, float] | None = None
    for _ in range(7):
        error = float(np.median(rms(radii(rtol), exact)))
        if abs(np.log(error / target)) < 0.1:
            break
        if last is not None and last[0] != rtol:
            slope = float(np.clip(np.log(error / last[1]) / np.log(rtol / last[0]), 0.5, 2.0))
        last = (rtol, error)
        rtol *= float((target / error) ** (1 / slope))
    return rtol, error


def equal_accuracy(nodes: int, rtol: float) -> list[str]:
    """The lanes kernel against LSODA and CVODE at its own measured error, same equations, nodes and observations."""
    theta = members(48)
    model = BubbleModel(accuracy=Accuracy(nodes=nodes, rtol=rtol))
    x = model.initial_states(theta)
    exact = forecast(BubbleModel(accuracy=Accuracy(nodes=nodes, rtol=1e-10)), x)
    error = float(np.median(rms(forecast(model, x), exact)))
    rows = np.array([constants(*(theta[name][i] for name in CENTRE)) for i in range(BASELINE_MEMBERS)])
    problem = Problem(rows, TIMES * 1e6, nodes)
    exact = exact[:BASELINE_MEMBERS]
    others: list[tuple[str, Integrator]] = [("scipy LSODA (odeint, compiled right-hand side)", lsoda)]
    if find_spec("sksundae"):
        others.append(("SUNDIALS CVODE (scikit-sundae, compiled right-hand side and Jacobian)", cvode))
    calls: list[Callable[[], object]] = [lambda: [forecast(model, x) for _ in range(_FORECASTS)]]
    lines = []
    for name, integrator in others:
        chosen, reached = tuned(lambda tol, f=integrator: run(f, problem, tol) * 1e-6, exact, error)  # type: ignore[misc]
        calls.append(lambda f=integrator, tol=chosen: run(f, problem, tol))  # type: ignore[misc]
        lines.append((name, reached, chosen))
    spent = interleaved(calls, 7)
    ours = spent[0] / (48 * _FORECASTS)
    table = [f"| en4dvar, 48 members, {nodes} nodes | {error:.1e} | {rtol:.1e} | {ours * 1e3:.3f} | 1 |"]
    for (name, reached, chosen), seconds in zip(lines, spent[1:], strict=True):
        each = seconds / BASELINE_MEMBERS
        table.append(f"| {name} | {reached:.1e} | {chosen:.1e} | {each * 1e3:.2f} | **{each / ours:.0f}** |")
    if not find_spec("sksundae"):
        table.append("| SUNDIALS CVODE: scikit-sundae is not installed | | | | |")
    return table


def integrator_alone(n: int, batches: int = 1) -> tuple[float, float]:
    """Median seconds on one thread and on two of the compiled integration of ``batches`` batches, without what the
    interpreter does before and after it. One batch is shared by two threads; two are integrated one by each.
    """
    model = BubbleModel()
    x = model.initial_states(members(n))
    times = np.broadcast_to(TIMES, (n, len(TIMES)))
    spent: dict[int, list[float]] = {1: [], 2: []}
    with ThreadPoolExecutor(1) as pool:
        for workers in (1, 2) * 101:
            works = [model.prepared(x, times)[0] for _ in range(batches)]
            begin = time.perf_counter()
            others = [pool.submit(works[-1]) for _ in range(workers - 1)]
            for work in works[: batches - workers + 1] or works:
                work()
            for other in others:
                other.result()
            spent[workers].append(time.perf_counter() - begin)
    return statistics.median(spent[1][1:]), statistics.median(spent[2][1:])


def threads() -> list[str]:
    model, lines = BubbleModel(), []

    def line(what: str, one_thread: float, two_threads: float) -> None:
        ratio = one_thread / two_threads
        lines.append(f"| {what} | {one_thread * 1e3:.2f} | {two_threads * 1e3:.2f} | **{ratio:.2f}** |")

    line("2 × 48, integration, a batch each (what the machine gives)", *integrator_alone(48, batches=2))
    line("48, integration", *integrator_alone(48))
    for n in (48, 480):
        x = model.initial_states(members(n))
        with ThreadsExecutor(2) as two:
            calls = [lambda x=x: forecast(model, x), lambda x=x, two=two: forecast(model, x, two)]
            one_thread, two_threads = interleaved(calls, 41, time.perf_counter)  # type: ignore[arg-type]
        line(f"{n}, forecast", one_thread, two_threads)
    return lines


def simulated() -> list[str]:
    """``simulate`` on one worker and on two against the forecast of the same members."""
    model, lines = BubbleModel(), []
    for n in (8, 48, 480):
        theta = members(n)
        x = model.initial_states(theta)
        calls: list[Callable[[], object]] = [partial(forecast, model, x)]
        calls += [partial(simulate, parameters=theta, times=TIMES, workers=workers) for workers in (1, 2)]
        spent = interleaved(calls, 41, time.perf_counter)
        lines.append(f"| {n} | {' | '.join(f'{s * 1e3:.2f}' for s in spent)} | **{spent[1] / spent[0]:.2f}** |")
    return lines


def by_members() -> list[str]:
    model, lines = BubbleModel(), []
    for n in (1, 2, 4, 8, 16, 32, 64, 256, 1024, 4096):
        x = model.initial_states(members(n))
        seconds = median_time(lambda x=x: forecast(model, x), max(3, min(25, 2000 // n)))  # type: ignore[misc]
        lines.append(f"| {n} | {seconds * 1e3:.2f} | {seconds / n * 1e3:.3f} |")
    return lines


def by_nodes() -> list[str]:
    theta = members(48)
    exact = forecast(*_start(Accuracy(nodes=40, rtol=1e-9), theta))
    lines = []
    for nodes in (0, 2, 4, 6, 8, 12, 16, 24, 32):
        accuracy = Accuracy(nodes=max(nodes, 1), rtol=1e-5)
        model, x = _start(accuracy, theta, "heat" if nodes else "polytropic")
        seconds = median_time(lambda model=model, x=x: forecast(model, x), 9)  # type: ignore[misc]
        error = f"{np.median(rms(forecast(model, x), exact)):.1e}" if nodes else "other physics"
        lines.append(f"| {nodes or 'polytropic'} | {seconds / 48 * 1e3:.3f} | {error} |")
    return lines


def accuracies() -> list[str]:
    """Error in time (same nodes) and in all (40 nodes, 1e-9), before the collapse and over everything."""
    theta = members(48)
    exact = forecast(*_start(Accuracy(nodes=40, rtol=1e-9), theta))
    lines = []
    for name, accuracy in ACCURACIES.items():
        model, x = _start(accuracy, theta)
        R = forecast(model, x)
        in_time = rms(R, forecast(*_start(Accuracy(nodes=accuracy.nodes, rtol=1e-10), theta)))
        in_all = rms(R, exact)
        after = np.arange(len(TIMES)) > np.argmax(exact, axis=1)[:, None]
        collapsed = np.logical_or.accumulate(after & (exact < 0.2 * exact.max(axis=1, keepdims=True)), axis=1)
        before = np.sqrt(np.mean(np.where(collapsed, 0.0, R - exact) ** 2, axis=1)) / exact.max(axis=1)
        seconds = median_time(lambda model=model, x=x: forecast(model, x), 7)  # type: ignore[misc]
        columns = [f"{np.median(e):.0e} ({np.quantile(e, 0.9):.0e})" for e in (in_time, before, in_all)]
        nodes_rtol = f"{accuracy.nodes} | {accuracy.rtol:.0e}"
        lines.append(f"| `{name}` | {nodes_rtol} | {' | '.join(columns)} | {seconds / 48 * 1e3:.3f} |")
    return lines


def released(accuracy: Accuracy, options: dict[str, Any]) -> tuple[BubbleModel, Array]:
    """Laser bubbles of some physics: the model and 48 states."""
    rng = np.random.default_rng(0)
    theta = {name: value * np.exp(0.1 * rng.standard_normal(48)) for name, value in RELEASED.items()}
    model = BubbleModel(law=get_law("neo-hookean-kelvin-voigt"), start="laser", accuracy=accuracy, **options)
    return model, model.initial_states(theta)


def integrated(model: BubbleModel, x: Array) -> Any:
    """The paths of laser bubbles."""
    return model.integrate(x, np.broadcast_to(RELEASED_TIMES, (len(x), len(RELEASED_TIMES))))


def by_integrator() -> list[str]:
    """Each physics by the lanes kernel, LSODA and CVODE at the error of the first."""
    from single_bubble import INTEGRATORS, Bubble

    standard, lines = preset("standard", "laser"), []
    for name, options in PHYSICS.items():
        model, x = released(standard, options)
        exact = integrated(*released(replace(standard, rtol=1e-10), options))["R"]
        error = float(np.median(rms(integrated(model, x)["R"], exact)))
        bubbles = [Bubble(model, x, i) for i in range(SINGLE_MEMBERS)]
        calls, told = [partial(integrated, model, x)], [("en4dvar", error, standard.rtol, 48)]
        for integrator, solve in INTEGRATORS.items():
            if integrator == "CVODE" and not find_spec("sksundae"):
                continue

            def radii(rtol: float, solve: Any = solve, bubbles: list[Any] = bubbles) -> Array:
                return np.array([solve(bubble, RELEASED_TIMES * 1e6, rtol) for bubble in bubbles]) * 1e-6

            rtol, reached = tuned(radii, exact[:SINGLE_MEMBERS], error)
            calls.append(partial(radii, rtol))
            told.append((integrator, reached, rtol, SINGLE_MEMBERS))
        spent = [s / n for s, (*_, n) in zip(interleaved(calls, 5), told, strict=True)]
        for seconds, (integrator, reached, rtol, _) in zip(spent, told, strict=True):
            costs = f"{seconds * 1e3:.3g} | **{seconds / spent[0]:.0f}**"
            lines.append(f"| {name} | {integrator} | {reached:.0e} | {rtol:.1e} | {costs} |")
    return lines


def by_physics() -> list[str]:
    """A laser bubble with each physics: steps, cost, error in time (same nodes, 1e-10) and in all (finer grids)."""
    standard, lines, cheapest = preset("standard", "laser"), [], 0.0
    for name, options in PHYSICS.items():
        model, x = released(standard, options)
        paths = integrated(model, x)
        seconds = median_time(lambda model=model, x=x: integrated(model, x)["R"], 5) / 48  # type: ignore[misc]
        cheapest = cheapest or seconds
        in_time = rms(paths["R"], integrated(*released(replace(standard, rtol=1e-10), options))["R"])
        finer = Accuracy(nodes=32, rtol=1e-9, medium_nodes=48)
        in_all = rms(paths["R"], integrated(*released(finer, options))["R"])
        errors = " | ".join(f"{np.nanmedian(e):.0e}" for e in (in_time, in_all))
        steps, size = paths.solution.record[:, STEPS].mean(), paths.model.system.size
        lines.append(
            f"| {name} | {size} | {steps:.0f} | {errors} | {seconds * 1e3:.3f} | **{seconds / cheapest:.1f}** |"
        )
    return lines


def _start(accuracy: Accuracy, theta: dict[str, Array], gas: str = "heat") -> tuple[BubbleModel, Array]:
    model = BubbleModel(accuracy=accuracy, gas=gas)  # type: ignore[arg-type]
    return model, model.initial_states(theta)


def random_members(n: int = 20_000) -> list[str]:
    """Members a factor of ten around the paper's, α up to one."""
    rng = np.random.default_rng(0)
    theta = {name: value * 10 ** rng.uniform(-1, 1, n) for name, value in (("G", 2e3), ("mu", 0.1), ("R0", 1e-6))}
    theta["alpha"] = 10 ** rng.uniform(-4, 0, n)
    begin = time.perf_counter()
    data = simulate(parameters=theta, times=TIMES, workers=2)
    seconds = time.perf_counter() - begin
    reasons = Counter(reason.split(" at t =")[0] for reason in data.reason.values if reason)
    failed = int((data.status != 0).sum())
    told = ", ".join(f"{reason} {count}" for reason, count in reasons.items()) or "none"
    steps, mach = int(data.steps.max()), float(data.max_wall_mach.max())
    return [f"| {n} | {seconds:.1f} | {failed} ({told}) | {steps} | {mach:.0f} |"]


def violent(n: int = 2000, others: int = 8) -> list[str]:
    """Released bubbles of the widest liquids and gels, over four collapses; ``others`` of them by LSODA as well."""
    from single_bubble import Bubble

    rng = np.random.default_rng(1)
    ranges = {"R_max": (50e-6, 1.5e-3), "mu": (5e-4, 0.5), "G": (1.0, 1e5), "R_eq": (0.01, 0.3)}
    theta = {name: np.exp(rng.uniform(*np.log(ends), n)) for name, ends in ranges.items()}
    theta["R_eq"] *= theta["R_max"]
    ends = 4 * RAYLEIGH * theta["R_max"] * np.sqrt(998 / 101325)
    times, lines = np.linspace(0.01, 1, 200) * ends[:, None], []
    law, tight = get_law("neo-hookean-kelvin-voigt"), replace(preset("standard", "laser"), rtol=1e-8)
    for name, options in PHYSICS.items():
        model = BubbleModel(law=law, start="laser", **options)
        x = model.initial_states(theta)
        solution = model.integrate(x, times).solution
        reasons = Counter(solution.reason(i).split(" at t =")[0] for i in np.flatnonzero(solution.status))
        told = ", ".join(f"{reason} {count}" for reason, count in reasons.items()) or "none"
        record, differences = solution.record, []
        exact = replace(model, accuracy=tight).integrate(x[:others], times[:others])
        for i in range(others if not model.system.wall else 0):
            try:
                R = Bubble(model, x, i, exact.solution.record[i, SMEAR]).lsoda(times[i] * 1e6, 1e-9)
            except RuntimeError:
                continue
            differences.append(float(rms(R[None] * 1e-6, exact["R"][i : i + 1])[0]))
        second = f"{len(differences)} of {others} | {max(differences):.0e}" if differences else "no | "
        numbers = f"{sum(reasons.values())} ({told}) | {(record[:, SMEAR] > 0).sum()}"
        most = f"{record[:, STEPS].max():.0f} | {record[:, MAX_MACH].max():.0f}"
        lines.append(f"| {name} | {n} | {numbers} | {most} | {second} |")
    return lines


_MEMORY = """
import re, sys
sys.path.insert(0, {folder!r})
from solver import TIMES, members, simulate
def peak():  # ru_maxrss would still know the parent's
    return int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
simulate(parameters=members(8), times=TIMES)
before = peak()
simulate(parameters=members(4096), times=TIMES, workers=2)
print(before, peak())
"""


def memory() -> list[str]:
    code = _MEMORY.format(folder=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, peak = (int(word) / 1024 for word in done.stdout.split())
    return [f"| 4096 | {peak:.0f} | {before:.0f} | {peak - before:.0f} |"]


TABLES: dict[str, tuple[str, Callable[[], list[str]]]] = {
    "accuracy": (
        "| accuracy | nodes | rtol | error in time | before the collapse | everything | ms per trajectory |\n"
        "|---|---|---|---|---|---|---|",
        accuracies,
    ),
    "speed": (
        "| integrator | rms error / R_max | rtol | ms per trajectory | ratio |\n|---|---|---|---|---|",
        lambda: equal_accuracy(ACCURACIES["standard"].nodes, ACCURACIES["standard"].rtol),
    ),
    "threads": ("| members | one thread, ms | two threads, ms | ratio |\n|---|---|---|---|", threads),
    "simulate": (
        "| members | forecast, ms | `simulate`, ms | `workers=2`, ms | `simulate` / forecast |\n|---|---|---|---|---|",
        simulated,
    ),
    "members": ("| members | ms | ms per member |\n|---|---|---|", by_members),
    "nodes": ("| nodes | ms per trajectory | rms error / R_max |\n|---|---|---|", by_nodes),
    "physics": (
        "| laser bubble, `standard` | unknowns | steps | error in time | everything | ms per trajectory | ratio |\n"
        "|---|---|---|---|---|---|---|",
        by_physics,
    ),
    "integrators": (
        "| laser bubble, `standard` | integrator | rms error / R_max | rtol | ms per trajectory | ratio |\n"
        "|---|---|---|---|---|---|",
        by_integrator,
    ),
    "random": (
        "| random members | s on two threads | failures | most steps | largest wall Mach |\n|---|---|---|---|---|",
        random_members,
    ),
    "violent": (
        "| released bubbles | members | failures | smeared | most steps | largest wall Mach | LSODA completes "
        "| largest rms difference |\n"
        "|---|---|---|---|---|---|---|---|",
        violent,
    ),
    "memory": ("| members | peak, MB | before, MB | taken, MB |\n|---|---|---|---|", memory),
}


def machine() -> str:
    cpu = platform.processor()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line.split(":")[1].strip() for line in information.read_text().splitlines() if "model name" in line]
        cpu = f"{len(names)} × {names[0]}"
    return f"{cpu}, Python {platform.python_version()}, NumPy {np.__version__}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/solver.md")
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of: {', '.join(TABLES)} (default: all)")
    options = parser.parse_args()
    unknown = set(options.tables) - set(TABLES)
    if unknown:
        parser.error(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    text = DOCS.read_text(encoding="utf-8") if options.docs else ""
    print(machine())
    for name in options.tables or TABLES:
        head, measure = TABLES[name]
        table = "\n".join([head, *measure()])
        print(f"\n## {name}\n{table}", flush=True)
        if options.docs:
            text = replaced(text, name, f"{table}\n\n{machine()}, {time.strftime('%Y-%m-%d')}.")
    if options.docs:
        DOCS.write_text(text, encoding="utf-8")


def replaced(text: str, name: str, content: str) -> str:
    """``text`` with what stands between the markers of ``name`` replaced. Raises ValueError without markers."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if begin not in text or end not in text:
        raise ValueError(f"{DOCS} has no markers {begin} … {end}")
    head, rest = text.split(begin, 1)
    return f"{head}{begin}\n{content}\n{end}{rest.split(end, 1)[1]}"


if __name__ == "__main__":
    main()
