"""What one data set of a campaign has and its neighbours lack."""

from dataclasses import replace

import netCDF4
import numpy as np
from run_files import add_to_pack
from wells import two_wells

from en4dvar.estimation.assimilate import assimilate
from en4dvar.report.result import Result
from en4dvar.results.campaign_file import save_campaign
from en4dvar.results.pack import PACK, Pack
from en4dvar.results.provenance import provenance
from en4dvar.schemes.settings import AssimilationSettings


def test_variables_that_the_first_set_lacks_are_kept(tmp_path):
    """The influence of its readings could not be told; that of the second one's can."""
    analysis = assimilate(two_wells(), AssimilationSettings(refine="none", what_if=False, max_iterations=1), 1)
    for name, of_it in (("first", replace(analysis, influence=None)), ("second", analysis)):
        add_to_pack(tmp_path, name, Result.from_analysis(of_it, provenance("name: test\n")))
    sources = {"first": "first", "second": "second"}
    with netCDF4.Dataset(save_campaign(tmp_path / "posterior.nc", Pack(tmp_path / PACK), sources, {}, {})) as file:
        file.set_auto_mask(False)
        told = file["sample_stats/influence_change"][:]
        assert np.isnan(told[0]).all()
        np.testing.assert_array_equal(told[1], analysis.influence.change)


def test_scalars_of_the_sets_that_were_sampled_are_kept(tmp_path):
    """The first set was not sampled: what the second one's draws were worth must not be lost with it."""
    problem, sources = two_wells(), {"plain": "plain", "drawn": "drawn"}
    for name, refine in (("plain", "none"), ("drawn", "auto")):
        analysis = assimilate(problem, AssimilationSettings(refine=refine), 1)
        add_to_pack(tmp_path, name, Result.from_analysis(analysis, provenance("name: test\n")))
    with netCDF4.Dataset(save_campaign(tmp_path / "posterior.nc", Pack(tmp_path / PACK), sources, {}, {})) as file:
        file.set_auto_mask(False)
        stats = file["sample_stats"]
        assert np.isnan(stats["importance_draws"][0])
        assert stats["importance_draws"][1] == analysis.refinement["importance_draws"]
        assert np.isfinite(stats["gaussian_fit"][0])
        assert np.isnan(stats["gaussian_fit"][1])
        assert stats["n_descents"][:].tolist() == [3, len(analysis.descents.members)]
        assert stats["descents"][1] == analysis.descents.words
