"""Fixtures shared by the tests of what comes after the assimilation: a synthetic analysis with a failed member."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import hypothesis
import numpy as np
import pytest
from chromium import browser  # noqa: F401  a fixture: one for all, since Playwright runs once in a process
from parts_in_turn import is_of_part
from threadpoolctl import threadpool_limits

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.analysis import Analysis, Descents, IterationRecord, Mode
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import TIME_SHIFT, Array, Field, Parameter, StateLayout
from en4dvar.plumbing.caution import caution
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.report.figures import all_figures
from en4dvar.schemes import ON_A_SERIES, ON_A_WINDOW
from en4dvar.schemes.settings import AssimilationSettings

# Of several test processes on the same cores, each with as many threads of BLAS, these wait for each other, spinning:
# one solution of an oracle took four times the CPU time. What tests start has the number that it would have anyway.
threadpool_limits(1, user_api="blas")

# What this process writes need not outlive a loss of power: the fifty flushes of a run were a third of its time. The
# programs that tests start flush, and ``faults/test_commands.py`` has that fail.
os.fsync = lambda file: None  # type: ignore[assignment]

# What a test's configuration names as the user's own code is remembered for the tests of this process alone.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="en4dvar-tests-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], True)

# How long an example takes says how busy a machine is, and what is drawn at random would refuse a change that has
# nothing to do with it.
hypothesis.settings.register_profile(
    "any machine", deadline=None, derandomize=True, database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)  # fmt: skip
hypothesis.settings.load_profile("any machine")

# A file is one worker's (``--dist loadfile``), and the files keep the order given below (``--no-loadscope-reorder``).
# First the file that compiles what most bubbles need: begun by both workers at once it would be compiled by both. Then
# those that take longest, or one worker would be left with them at the end.
FIRST = (
    "test_solver", "test_study", "test_examples", "test_same_bits", "test_discrepancy", "test_terminal",
    "test_commands", "test_ending_models", "test_twin", "test_estimate", "test_imr_suite",
)  # fmt: skip

# Fixtures of a module that take minutes.
COSTLY = {"test_study": {"small", "twin"}}

FAILED = 3

PARAMETERS = (
    Parameter("G", "Pa", "lognormal", (0.0, np.inf), "shear modulus", "$G$", "kPa", "a test"),
    Parameter("mu", "Pa s", "lognormal", (0.0, np.inf), "viscosity", r"$\mu$", "Pa s", "a test"),
    Parameter("R0", "m", "lognormal", (0.0, np.inf), "stress-free radius", "$R_0$", "um", "a test"),
    TIME_SHIFT,
)
FIXED = (Parameter("p_inf", "Pa", label="far-field pressure", symbol=r"$p_\infty$", display_unit="kPa"),)
OBSERVABLE = Observable("R", "m", StateField("R"), "$R$", "um", "bubble radius")
MEAN = np.array([2500.0, 0.09, 40e-6, 0.0])
PRIOR_RELATIVE = np.array([0.4, 0.5, 0.2, 1.0])
SCALE = np.array([2500.0, 0.09, 40e-6, 0.4e-6])
SHRINK = np.array([0.12, 0.25, 0.97, 0.6])


class Bounce(ForwardModel):
    """What an analysis knows of its model; it is never run."""

    parameters, layout, observables = (*PARAMETERS[:3], *FIXED), StateLayout((Field("R", unit="m"),)), (OBSERVABLE,)
    time_display_unit = "us"

    def initial_state(self, theta):
        raise NotImplementedError

    def step(self, x, t0, t1):
        raise NotImplementedError


def _path(theta: Array, times: Array) -> Array:
    """A damped bounce (N, K): any smooth observable with the right feel would do."""
    g, mu, r0, t_s = (theta[:, i, None] for i in range(4))
    t = times[None, :] + t_s
    period = 45e-6 * (g / 2500.0) ** -0.15
    return r0 * (1.0 + 6.0 * np.exp(-t / 60e-6 * mu / 0.09) * np.abs(np.cos(np.pi * t / 2 / period)))


def _analysis(n_members: int = 24, **changes: Any) -> Analysis:
    rng = np.random.default_rng(7)
    noise = rng.standard_normal((n_members, 4))
    prior = np.where(np.arange(4) < 3, MEAN * np.exp(PRIOR_RELATIVE * noise), PRIOR_RELATIVE * SCALE * noise)
    truth = MEAN + np.array([300.0, -0.01, 0.0, 0.1e-6])

    def ensemble(shrink: Array, centre: Array) -> Array:
        return centre + shrink * (prior - prior.mean(axis=0))

    times, grid = np.linspace(2e-6, 80e-6, 40), np.linspace(0.0, 85e-6, 200)
    std = np.full(40, 4e-6)
    values = _path(truth[None], times)[0] + std * rng.standard_normal(40)
    posterior = ensemble(SHRINK, truth)
    predictions = _path(posterior, times)
    for rows in (posterior, predictions):
        rows[FAILED] = np.nan
    paths = _path(ensemble(SHRINK, truth), grid)
    paths[FAILED] = np.nan
    centre_predictions = _path(truth[None], times)[0]
    records = []
    for i in range(6):
        part = 1.0 - 0.35**i
        background, observation = 4.0 * part, 900.0 * 0.2**i + 19.0
        members = ensemble(1 + part * (SHRINK - 1), MEAN + part * (truth - MEAN))
        records.append(
            IterationRecord(
                i, background + observation, background, observation, 0.5**i, 1.0 if i < 5 else 0.0,
                2 * observation / 40, 2.3 * part, 1 - 0.8 * part, n_members - 1, members, members.mean(axis=0),
            )
        )  # fmt: skip
    failures = tuple("collapse too violent" if i == FAILED else "" for i in range(n_members))
    analysis = Analysis(
        problem=InverseProblem(
            Bounce(),
            OBSERVABLE,
            Observations(times, values, noise_of(std), np.ones(40), "A_E2_synthetic", "made/up.csv", {"Req": 4e-5}),
            Prior(tuple(map(PriorTerm.normal, PARAMETERS, MEAN, SCALE))),
            {"p_inf": 101325.0},
        ),
        settings=AssimilationSettings(members=n_members),
        seed=11,
        fixed_parameters=FIXED,
        prior=prior,
        posterior=posterior,
        centre=truth,
        prior_predictions=_path(prior, times),
        posterior_predictions=predictions,
        centre_predictions=centre_predictions,
        error_std=std,
        own_std=std,
        log_likelihood=-0.5 * ((values - predictions) / std) ** 2 - np.log(std * np.sqrt(2 * np.pi)),
        trajectory_times=grid,
        prior_trajectories=_path(prior, grid),
        posterior_trajectories=paths,
        prior_failures=("",) * n_members,
        posterior_failures=failures,
        iterations=tuple(records),
        dfs_per_parameter=1 - SHRINK**2,
        converged=True,
        stop_reason="step norm below 1e-3",
        forward_runs=6 * n_members,
        modes=(
            Mode(truth, 0.9 * truth, 1.1 * truth, 23.0, 3, 0.02, 0.8),
            Mode(MEAN, 0.9 * MEAN, 1.1 * MEAN, 25.1, 2, 0.0, 0.2),
        ),
        descents=Descents((4, 17, 9, -1, 30), (0, 0, 0, 1, 1), (23.0, 25.1), 0.02, 20),
        cautions=(caution("members-lost", "1 of 24 members failed in the posterior forecast: collapse too violent"),),
    )
    return replace(analysis, **changes)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--turn", type=int, help="a sixteenth of the tests, of the long ones a thirtieth: those of a turn")


def _name_in_turn(item: pytest.Item) -> str:
    """The name by which a long test is of a part: where a fixture takes minutes, all that share it are of one part."""
    shared = sorted(COSTLY.get(item.path.stem, set()) & set(item.fixturenames))  # type: ignore[attr-defined]
    return "::".join([*shared, item.path.stem]) if shared else item.nodeid


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests of the turn that is asked for; :data:`FIRST`, files with long tests, then those with the most."""
    long = {item.nodeid for item in items if item.get_closest_marker("long")}
    if (turn := config.getoption("--turn")) is not None:
        names = {item: (_name_in_turn(item), 30) if item.nodeid in long else (item.nodeid, 16) for item in items}
        items[:] = [item for item in items if is_of_part(names[item][0], turn, names[item][1])]
    tests, begun_first = Counter(item.path for item in items), {item.path for item in items if item.nodeid in long}
    ranks = {path: FIRST.index(path.stem) if path.stem in FIRST else len(FIRST) for path in tests}
    items.sort(key=lambda item: (ranks[item.path], item.path not in begun_first, -tests[item.path]))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Modules that are compiled and imported make no circular garbage: to look for it took a third of the time."""
    gc.disable()
    yield
    gc.enable()


def pytest_collection_finish() -> None:
    """What the imported modules consist of is never garbage: to look through it took 6 % of the time."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def schemes_as_before():
    """Schemes of files that a test names are forgotten behind it, for other tests go through all that there are."""
    before = [(registry, dict(registry)) for registry in (ON_A_WINDOW, ON_A_SERIES)]
    yield
    for registry, known in before:
        for name in registry.keys() - known.keys():
            del registry[name]


@pytest.fixture(scope="session")
def renamed() -> Callable[[Analysis, str], Analysis]:
    """``renamed(analysis, name)``: as if the data set had that name."""

    def rename(analysis: Analysis, name: str) -> Analysis:
        problem = analysis.problem
        return replace(analysis, problem=replace(problem, observations=replace(problem.observations, name=name)))

    return rename


@pytest.fixture(scope="session")
def make_analysis() -> Callable[..., Analysis]:
    """``make_analysis(n_members=24, **fields)``: deterministic, member 3 failed in the posterior forecast."""
    return _analysis


@pytest.fixture(scope="session")
def analysis() -> Analysis:
    return _analysis()


@pytest.fixture
def one_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports of this process draw the first of their figures only: enough where a test asks for files and pages."""
    monkeypatch.setattr("en4dvar.report.page.all_figures", lambda result: islice(all_figures(result), 1))
