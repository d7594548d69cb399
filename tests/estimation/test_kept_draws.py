"""What a sampled posterior keeps of its draws, and the population that is made of them without a further run."""

import numpy as np
import pytest
import yaml
from toys import make_observations
from wells import Wells, two_wells

from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population.own import OwnDraws, own_draws
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.results.together import load_population
from en4dvar.runs.finished import finished
from en4dvar.runs.runner import run_campaign
from en4dvar.schemes.settings import AssimilationSettings


class CheapWells(Wells):
    def __init__(self):
        super().__init__(compiled=True)


def test_kept_draws_are_of_the_posterior_that_is_sampled_anew():
    problem = two_wells()
    analysis = assimilate(problem, AssimilationSettings(), 1)
    told = analysis.refinement["importance_effective_sample_size"], analysis.log_evidence
    kept = OwnDraws.kept(problem, analysis.draws, *told)
    anew = own_draws(problem, kept.z[:40], 2)
    assert kept.log_evidence == pytest.approx(anew.log_evidence, abs=0.15)
    assert np.mean(kept.z[:, 0] > 0) == pytest.approx(np.mean(anew.z[:, 0] > 0), abs=0.1)
    for sign in (-1, 1):
        (a, b) = (draws.z[sign * draws.z[:, 0] > 0] for draws in (kept, anew))
        assert np.all(np.abs(a.mean(axis=0) - b.mean(axis=0)) < 0.3 * b.std(axis=0))
        np.testing.assert_allclose(a.std(axis=0), b.std(axis=0), rtol=0.2)
    assert (kept.forward_runs, kept.effective < told[0]) == (0, True)


@pytest.mark.slow
def test_a_run_samples_no_data_set_twice(tmp_path):
    (tmp_path / "data").mkdir()
    for seed in range(3):
        o = two_wells(seed=seed).observations
        rows = "\n".join(f"{t:.6g},{y:.6g}" for t, y in zip(o.times, o.values, strict=True))
        (tmp_path / "data" / f"set{seed}.csv").write_text(f"t,y\n{rows}\n")
    of = (("a", 0.3, 1), ("b", 0, 0.5))
    prior = {name: {"prior": "normal", "mean": f"{mean} m", "std": f"{std} m"} for name, mean, std in of}
    config = {
        "name": "wells", "seed": 1, "model": {"name": f"{__name__}:CheapWells"}, "parameters": prior,
        "data": {"path": "data/*.csv", "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "y", "unit": "m"}},
                 "error": {"y_std": "0.2 m"}},
        "population": {"of": ["b"]}, "output": {"directory": str(tmp_path / "run"), "report": False},
    }  # fmt: skip
    (tmp_path / "wells.yaml").write_text(yaml.safe_dump(config))
    run = run_campaign(tmp_path / "wells.yaml").directory
    _, sets = finished([run], True, None)
    assert all(s.drawn is not None for s in sets)
    assert load_population(run / "population.nc").attributes["forward_runs"] == 0


BEND = np.array([0.6, -0.5, 0.4, 0.3])


def valley(p, t):
    """Readings at t = 1 to 4 of b_1 to b_4 and of what a adds to each, no polynomial."""
    each = np.stack([p[f"b{k}"] for k in range(1, 5)]) + BEND * (np.cosh(0.9 * p["a"]) - 1)
    return each[np.rint(np.asarray(t) - 1).astype(int)]


@pytest.mark.slow
def test_a_thin_bent_posterior_is_as_wide_as_its_integral_says():
    """b_k = y_k − bend_k(a) within 0.03, so that p(a|y) is N(y; bend(a), 1 + 0.03²) N(a): 5, 50 and 95 %, evidence."""
    std, names = 0.03, ["a", "b1", "b2", "b3", "b4"]
    model = FunctionModel(valley, [Parameter(name, "1") for name in names], {"y": "1"})
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    data = make_observations(np.arange(4) + 1.0, 0.7 * BEND + 0.1, std=std)
    problem = InverseProblem(model, model.observables[0], data, prior)
    a = np.linspace(-6, 6, 24001)
    apart = data.values - BEND * (np.cosh(0.9 * a)[:, None] - 1)
    logs = -0.5 * a**2 - 0.5 * np.sum(apart**2, axis=1) / (1 + std**2) + 2 * np.log(std**2 / (1 + std**2))
    density = np.exp(logs)
    exact = np.interp([0.05, 0.5, 0.95], np.cumsum(density) / density.sum(), a)
    evidence = np.log(density.sum() * (a[1] - a[0]) / np.sqrt(2 * np.pi))
    slope = BEND * 0.9 * np.sinh(0.45)
    at = np.append(0.5, data.values - BEND * (np.cosh(0.45) - 1))
    rows = np.vstack([slope, np.eye(4)]) / std
    root = np.linalg.cholesky(np.linalg.inv(np.eye(5) + rows @ rows.T))
    start = at + np.random.default_rng(0).standard_normal((48, 5)) @ root.T
    several = [own_draws(problem, start, seed) for seed in range(3)]
    found = np.mean([np.quantile(draws.z[:, 0], [0.05, 0.5, 0.95]) for draws in several], axis=0)
    np.testing.assert_allclose(found, exact, atol=0.15)
    assert np.mean([draws.log_evidence for draws in several]) == pytest.approx(evidence, abs=0.15)
