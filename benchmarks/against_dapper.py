"""Twin experiments side by side with DAPPER: the same truths and observations, settings and inflation.

    pip install en4dvar[benchmark]
    python benchmarks/against_dapper.py [--cycles 1000] [--seeds 5] [--only 'L96 N=25']

Prints analysis RMSE (after a burn-in of a tenth, averaged over seeds; the ratio with its standard error) and time of
the assimilation. DAPPER is timed twice: as its examples run it (ten iterations a window, all statistics), and lean: its
recommended ``wtol=1e-5``, errors only, no live plots, which is also where its RMSE comes from. Times are of the
processor, which with one thread each is wall time on an idle machine. Results: docs/against_dapper.md.
"""

from __future__ import annotations

import os

os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MPLBACKEND="Agg")

import argparse
import copy
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.cycling.sequential import CycleSeries, SequentialSettings, run_sequential
from en4dvar.prior import member_stream
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.inflation import Inflation
from en4dvar_lorenz import Lorenz63, Lorenz96
from en4dvar_lorenz.lorenz63 import Lorenz63Settings
from en4dvar_lorenz.lorenz96 import Lorenz96Settings


@dataclass(frozen=True)
class System:
    """``step``: of the integration; an observation of all variables every ``every`` steps."""

    name: str
    model: Any
    step: float
    every: int
    error_std: float
    initial_std: float
    tolerance: float = 0.05  # of the iterations, in posterior standard deviations


# Sakov, Oliver & Bertino (2012), Table 1; Sakov & Oke (2008)
# In Lorenz-63 a window of four intervals loses its way now and then; the iterations go as far as DAPPER's there.
L63 = System("L63", Lorenz63.from_settings(Lorenz63Settings()), 0.01, 25, 2**0.5, 2**0.5, tolerance=1e-5)
L96 = System("L96", Lorenz96.from_settings(Lorenz96Settings()), 0.05, 1, 1.0, 0.001**0.5)
# system, members, lag (0: ETKF), inflation
CASES = [
    (L63, 10, 0, 1.02),
    (L63, 10, 1, 1.02),
    (L63, 10, 4, 1.02),
    (L96, 25, 0, 1.02),
    (L96, 25, 1, 1.02),
    (L96, 25, 4, 1.02),
    (L96, 40, 0, 1.01),
    (L96, 40, 1, 1.01),
    (L96, 40, 4, 1.01),
]


def draw(system: System, cycles: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth at every step (K + 1, n), its observations (cycles, n) and the state all start around."""
    mean = system.model.initial_state(system.model.defaults)
    n = len(mean) - len(system.model.defaults)
    stream = member_stream(seed, "truth")
    start = mean.copy()
    start[:n] += system.initial_std * stream.standard_normal(n)
    (path,) = system.model.trajectories(start[None], system.step * np.arange(1, cycles * system.every + 1))
    truth = np.vstack([start[:n], path.states[:, :n]])
    seen = truth[system.every :: system.every]
    return truth, seen + system.error_std * stream.standard_normal(seen.shape), mean


def ours(
    system: System,
    members: int,
    lag: int,
    inflation: float,
    truth: np.ndarray,
    y: np.ndarray,
    mean: np.ndarray,
    seed: int,
) -> tuple[np.ndarray, float]:
    """Analysis RMSE of every cycle and the seconds it took."""
    n = truth.shape[1]
    ensemble = np.tile(mean, (members, 1))
    ensemble[:, :n] += system.initial_std * member_stream(seed, "members").standard_normal((members, n))
    times = system.step * system.every * np.arange(1, len(y) + 1)
    series = CycleSeries(times, y, np.full(n, system.error_std))
    scheme = IEnKS(lag, tolerance=system.tolerance) if lag else ETKF()
    settings = SequentialSettings(scheme, Inflation(inflation), rotation=True)
    began = time.process_time()
    result = run_sequential(system.model, system.model.observables, ensemble, series, settings, seed)
    took = time.process_time() - began
    error = result.analysis.mean[:, :n] - truth[system.every :: system.every]
    return np.sqrt(np.mean(error**2, axis=1)), took


def theirs(
    system: System, members: int, lag: int, inflation: float, truth: np.ndarray, y: np.ndarray, seed: int, lean: bool
) -> tuple[np.ndarray, float]:
    """The same by DAPPER."""
    warnings.simplefilter("ignore")  # DAPPER's own, about plots that are not asked for
    import dapper as dpr
    import dapper.da_methods as methods
    from dapper.tools import progressbar
    from dapper.tools.seeding import set_seed

    progressbar.disable_progbar = True
    if system is L63:
        from dapper.mods.Lorenz63.sakov2012 import HMM as original
    else:
        from dapper.mods.Lorenz96.sakov2008 import HMM as original
    hmm = copy.deepcopy(original)
    hmm.tseq.Ko = len(y) - 1
    assert (hmm.tseq.dt, hmm.tseq.dko, hmm.tseq.K) == (system.step, system.every, len(truth) - 1)
    dpr.rc.comps["error_only"] = lean
    options = {"N": members, "infl": inflation, "rot": True}
    if lag:
        method = methods.iEnKS("Sqrt", Lag=lag, wtol=1e-5 if lean else 0, **options)
    else:
        method = methods.EnKF("Sqrt", **options)
    set_seed(1 + seed)
    began = time.process_time()
    method.assimilate(hmm, truth, y, liveplots=False)
    return np.array(method.stats.err.rms.a), time.process_time() - began


HEAD = (
    "case",
    "RMSE",
    "DAPPER's",
    "ratio",
    "ms a cycle",
    "DAPPER as shipped",
    "DAPPER lean",
    "times less",
    "than lean",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument(
        "--seeds", type=int, default=5, help="of a Lorenz-96 case; Lorenz-63 scatters and takes 4 times as many"
    )
    parser.add_argument("--only", default="", help="cases whose name contains this, e.g. 'L96 N=25'")
    arguments = parser.parse_args()
    for system in (L63, L96):  # compile
        ours(system, 4, 1, 1.0, *draw(system, 2, 0), 0)
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD), flush=True)
    for case in CASES:
        system, members, lag, _ = case
        name = f"{system.name} N={members} " + (f"lag {lag}" if lag else "ETKF")
        if arguments.only in name:
            print(f"| {name} | " + " | ".join(compare(case, arguments.cycles, arguments.seeds)) + " |", flush=True)


def compare(case: tuple[System, int, int, float], cycles: int, seeds: int) -> list[str]:
    """The row of a case."""
    system, members, lag, inflation = case
    seeds = 4 * seeds if system is L63 else seeds
    counted = slice(cycles // 10, None)
    errors = np.empty((2, seeds))
    spent = {"ours": 0.0, "shipped": 0.0, "lean": 0.0}
    for seed in range(seeds):
        truth, y, mean = draw(system, cycles, seed)
        rmse, took = ours(system, members, lag, inflation, truth, y, mean, seed)
        errors[0, seed], spent["ours"] = rmse[counted].mean(), spent["ours"] + took / seeds
        rmse, took = theirs(system, members, lag, inflation, truth, y, seed, lean=True)
        errors[1, seed], spent["lean"] = rmse[counted].mean(), spent["lean"] + took / seeds
        if seed == 0:  # its time does not depend on the seed
            spent["shipped"] = theirs(system, members, lag, inflation, truth, y, seed, lean=False)[1]
    a, b = errors.mean(axis=1)
    scatter = np.std(errors[0] - a / b * errors[1], ddof=1) / b / np.sqrt(seeds) if seeds > 1 else np.nan
    each = {who: 1e3 * seconds / cycles for who, seconds in spent.items()}
    return [
        f"{a:.3f}", f"{b:.3f}", f"{a / b:.3f} ± {scatter:.3f}", *(f"{each[who]:.3f}" for who in spent),
        f"{each['shipped'] / each['ours']:.1f}", f"{each['lean'] / each['ours']:.1f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
