"""What a sampled posterior keeps of its draws, and the population that is made of them without a further run."""

import numpy as np
import pytest
import yaml
from wells import Wells, two_wells

from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.population.own import OwnDraws, own_draws
from en4dvar.results.population_file import load_population
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
    assert load_population(run / "population.nc").tree.attrs["forward_runs"] == 0
