"""Posteriors of two modes whose masses are known by quadrature."""

from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import assert_cost_by_definition
from wells import UnlikeWells, Wells, mass_and_evidence, two_wells

from en4dvar import estimate
from en4dvar.descent.minima import Minimum
from en4dvar.diagnosis.analysis import Mode
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.conclusions import modes_of
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.results.store import StoredResult
from en4dvar.sampling import mcmc
from en4dvar.sampling.modes import belonging, sample_modes
from en4dvar.sampling.refine import SEEN, Refined, mode_cautions
from en4dvar.schemes.settings import AssimilationSettings

KEYWORDS = mcmc.sample.__kwdefaults__


CASES = [(Wells, 0.3), (Wells, 0.0), (UnlikeWells, 0.3), (UnlikeWells, 0.8)]


@pytest.mark.parametrize(("kind", "mean"), CASES)
def test_weights_are_the_masses_of_the_wells(kind, mean):
    problem = two_wells(kind, mean=mean)
    expected, evidence = mass_and_evidence(problem)
    analysis = assimilate(problem, AssimilationSettings(), 1)
    assert len(analysis.modes) == 2
    assert 0.05 < expected < 0.95
    positive = sum(mode.weight for mode in analysis.modes if mode.centre[0] > 0)
    assert positive == pytest.approx(expected, abs=0.03)
    assert np.mean(analysis.posterior[:, 0] > 0) == pytest.approx(expected, abs=0.03)
    assert sum(mode.weight for mode in analysis.modes) == pytest.approx(1)
    assert analysis.log_evidence == pytest.approx(evidence, abs=0.1)
    assert_cost_by_definition(analysis)
    (told,) = (c for c in analysis.cautions if c.code == "several-modes")
    assert told.parameters == ("a",)  # b is the same in both
    a, b = StoredResult.from_analysis(analysis, {}).rows
    assert (a.modal, b.modal) == (True, False)
    assert a.q05 < 0 < a.q95


@pytest.mark.parametrize("seed", range(2))
def test_two_narrow_modes_as_far_apart_as_the_prior_is_wide_are_no_silent_data(seed):
    """Of x² the data tell |x| to 3 %, and the variance of both modes together is that of the prior."""
    prior, t = {"prior": "normal", "mean": 0.3, "std": 1}, np.array([1.0, 2.0, 3.0])
    squared = lambda p, t: p["x"] ** 2 * t  # noqa: E731
    result = estimate(squared, (t, [1.0, 2.2, 2.9]), {"x": prior}, error=0.1, cheap=True, seed=seed, progress=False)
    assert np.abs(result.sample_stats["dfs"].values).max() < 0.1
    (told,) = result.warnings
    assert told.startswith("the posterior has 2 modes")


@pytest.mark.parametrize("case", [CASES[0], pytest.param(CASES[2], marks=pytest.mark.slow)])
def test_a_chain_moves_between_the_wells(case):
    problem = two_wells(*case[:1], mean=case[1])
    analysis = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    assert analysis.refinement["mcmc_converged"]
    positive = sum(mode.weight for mode in analysis.modes if mode.centre[0] > 0)
    assert positive == pytest.approx(mass_and_evidence(problem)[0], abs=0.03)


@pytest.mark.parametrize(
    ("refine", "by"), [("auto", "importance"), pytest.param("mcmc", "mcmc", marks=pytest.mark.slow)]
)
def test_as_many_draws_are_effective_as_are_asked_for(refine, by):
    few, many = (assimilate(two_wells(), AssimilationSettings(refine=refine, draws=n), 1) for n in (400, 4000))
    assert few.refinement[f"{by}_effective_sample_size"] >= 400
    assert many.refinement[f"{by}_effective_sample_size"] >= 4000
    assert few.forward_runs < many.forward_runs


@pytest.mark.slow
def test_without_jumps_walkers_of_two_wells_do_not_agree(monkeypatch):
    """R-hat compares walkers that started in different modes, so that it is near 1 only where they were exchanged."""
    problem = two_wells()
    problem = replace(problem, observations=replace(problem.observations, values=problem.observations.values + 3.0))
    jumping = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    monkeypatch.setattr("en4dvar.sampling.mcmc._jump", lambda proposal: lambda x, random: (x, np.zeros(len(x))))
    monkeypatch.setattr("en4dvar.sampling.mcmc.MAX_R_HAT", 0.0)  # all steps there are
    monkeypatch.setattr("en4dvar.sampling.mcmc.sample.__kwdefaults__", {**KEYWORDS, "max_steps": 300})
    stuck = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    assert jumping.refinement["mcmc_r_hat"] < 1.1 < stuck.refinement["mcmc_r_hat"]


def test_one_seed_gives_the_same_bits_for_any_workers():
    one = assimilate(two_wells(), AssimilationSettings(), 1)
    with ThreadsExecutor(2) as executor:
        assert_same_bits(assimilate(two_wells(), AssimilationSettings(), 1, executor), one)


def test_of_a_model_that_is_not_cheap_the_other_minimum_is_told():
    slow = assimilate(two_wells(compiled=False, mean=0.0), AssimilationSettings(), 1)
    assert slow.refinement == {}
    assert len(slow.modes) == 2
    (told,) = (c for c in slow.cautions if c.code == "several-modes")
    assert told.severity == "serious"
    assert all(row.untrusted == ("several-modes",) for row in StoredResult.from_analysis(slow, {}).rows)


def test_a_mode_that_the_chain_has_left_has_no_share() -> None:
    prior = Prior((PriorTerm.normal(Parameter("a", "m"), 0.0, 1.0),))
    minima = [Minimum(np.array([x]), np.eye(1) * 0.01, cost, 1) for x, cost in ((0.0, 1.0), (1.0, 3.0), (-1.0, 5.0))]
    draws = np.array([[0.01], [-0.02], [1.01], [0.0]])
    np.testing.assert_array_equal(belonging(prior, minima, draws, np.full(4, 0.25)), [0, 0, 1, 0])


def test_a_mode_whose_draws_lie_to_both_sides_of_their_mean_keeps_its_valley_to_another() -> None:
    """None is near the mean of the first; what lies before all draws is no valley."""
    prior = Prior((PriorTerm.normal(Parameter("a", "m"), 0.0, 1.0),))
    minima = [Minimum(np.array([x]), np.eye(1) * 0.01, cost, (0,)) for x, cost in ((0.0, 1.0), (1.0, 1.2))]
    draws = np.array([[-0.2], [0.2], [0.95], [1.05]])
    np.testing.assert_array_equal(belonging(prior, minima, draws, np.full(4, 0.25)), [0, 0, 1, 1])


@pytest.mark.parametrize(("floor", "modes"), [(0.0, 1), (6.0, 2)])
def test_a_mode_is_where_its_own_draws_are(floor, modes):
    """Flat between a = -4 and 4, or with a ``floor`` of J between two wells; the Gaussian about the second minimum is
    far too wide, as on a bent ridge."""
    prior = Prior(tuple(PriorTerm.normal(Parameter(name, "m"), 0.0, 10.0) for name in "ab"))

    def cost(x):
        between = floor * np.exp(-0.5 * (x[:, 0] / 1.5) ** 2)
        return between + 4 * np.clip(np.abs(x[:, 0]) - 4, 0, None) ** 2 + 0.5 * x[:, 1] ** 2

    minima = [
        Minimum(np.array([3.9, 0.0]), np.diag([0.05, 1.0]), 0.0, (1, 2)),
        Minimum(np.array([-3.9, 0.0]), np.diag([9.0, 1.0]), 0.1, (3,)),
    ]
    draws = sample_modes(cost, prior, minima, 1)
    weights = np.bincount(draws.mode, draws.shares, minlength=2)
    assert np.sum(weights > 0.02) == modes
    if modes == 2:
        assert weights[0] == pytest.approx(0.5, abs=0.05)
        assert draws.shares @ (draws.mode == (draws.x[:, 0] < 0)) > 0.99


@pytest.mark.parametrize(("apart", "severity"), [(1.5, "note"), (2.5, "caution")])
def test_modes_that_overlap_are_only_worth_knowing(apart: float, severity: str) -> None:
    """Two Gaussians of one width make two peaks where they lie more than two standard deviations apart."""
    prior = Prior(tuple(PriorTerm.normal(Parameter(name, "m"), 0.0, 1.0) for name in "ab"))
    minima = [Minimum(np.array([x, 0.0]), np.diag([0.01, 0.04]), 3.0, (1, 2)) for x in (0.0, 0.1 * apart)]
    half = 1.645 * np.array([0.1, 0.2])
    modes = [
        Mode(m.x, m.x - half, m.x + half, 3.0, 2, 0.0, weight) for m, weight in zip(minima, (0.6, 0.4), strict=True)
    ]
    sampled = Refined(np.zeros((8, 2)), {})
    (told,) = mode_cautions(prior, minima, modes, True, sampled)
    assert (told.code, told.severity) == ("several-modes", severity)
    (told,) = mode_cautions(prior, minima, modes, True, None)  # members describe one of them alone
    assert told.severity == "serious"


def test_a_minimum_that_no_draw_belongs_to_is_no_mode():
    """Its quantiles are not known, and nothing is computed of them."""
    prior = Prior((PriorTerm.logit(Parameter("a", "1"), (0.0, 1.0), 0.5, 1.0),))
    minima = [Minimum(np.array([x]), np.eye(1), 3.0, (1,)) for x in (0.0, 1.0)]
    own = [(1.0, np.array([[-1.0], [0.0], [1.0]]), 3.0), (0.0, np.full((3, 1), np.nan), np.inf)]
    (mode,) = modes_of(prior, minima, Refined(np.zeros((8, 1)), {}, own))
    assert mode.centre == pytest.approx(0.5)


def test_a_mode_that_members_describe_counts_however_small_it_is() -> None:
    """The lowest minimum is the narrowest: of weight 0.002, and another one holds the posterior."""
    prior = Prior((PriorTerm.normal(Parameter("a", "1"), 0.0, 1.0),))
    minima = [Minimum(np.array([x]), np.array([[std**2]]), x, (1, 2)) for x, std in ((0.0, 1e-4), (0.5, 0.1))]
    modes = modes_of(prior, minima, None)
    assert modes[0].weight < SEEN
    (told,) = mode_cautions(prior, minima, modes, True, None)
    assert (told.code, told.severity) == ("several-modes", "serious")
    draws = Refined(np.zeros((8, 1)), {})  # they are of the other one
    assert list(mode_cautions(prior, minima, modes, True, draws)) == []


@pytest.mark.parametrize(("others", "words"), [(1, "others ended at 9.0"), (0, "the others came to no minimum")])
def test_where_descents_disagree_it_is_told_where_the_others_ended(others, words):
    prior = Prior((PriorTerm.normal(Parameter("a", "1"), 0.0, 1.0),))
    minima = [Minimum(np.array([x]), np.eye(1), x, (0,)) for x in (3.0, 9.0)][: 1 + others]
    (told,) = mode_cautions(prior, minima, [], False, None)
    assert told.words.endswith(f"J = 3.0; {words}")


def test_the_tail_of_a_posterior_that_is_bent_is_sampled() -> None:
    """The logarithm of a modulus that readings tell only with a pressure: flat where the modulus is small.

    With s = 0.25, y = 1.5 N(g(z_0) + 0.9 z_1 + 0.7 z_2, s²) and ten more directions that Gaussians tell; the marginal
    density of z_0 is that of y ~ N(g, s² + 0.9² + 0.7²), integrated by a sum.
    """
    y, s, n = 1.5, 0.25, 13
    widths = np.linspace(0.1, 0.8, n - 3)

    def misfit(z):
        g = 0.75 * np.exp(np.clip(1.6 * z[:, 0], -50, 20)) + 0.9 * z[:, 1] + 0.7 * z[:, 2]
        return 0.5 * ((y - g) / s) ** 2 + 0.5 * np.sum((z[:, 3:] / widths) ** 2, axis=1)

    grid = np.linspace(-8, 4, 24001)
    variance = s**2 + 0.9**2 + 0.7**2
    logs = -0.5 * grid**2 - 0.5 * (y - 0.75 * np.exp(1.6 * grid)) ** 2 / variance
    density = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    mean = density @ grid
    std = np.sqrt(density @ (grid - mean) ** 2)
    evidence = np.log(np.exp(logs).sum() * (grid[1] - grid[0]) / np.sqrt(2 * np.pi)) + np.log(s / np.sqrt(variance))
    evidence += np.sum(0.5 * np.log(widths**2 / (1 + widths**2)))

    prior = Prior(tuple(PriorTerm.normal(Parameter(f"z{i}", "1"), 0.0, 1.0) for i in range(n)))
    slope = np.array([0.75 * 1.6 * np.exp(1.6 * 0.3), 0.9, 0.7]) / s
    precision = np.diag(np.append(np.ones(3), 1 + 1 / widths**2))
    precision[:3, :3] += np.outer(slope, slope)
    about = Minimum(np.append(0.3, np.zeros(n - 1)), np.linalg.inv(precision), 1.0)
    sampled = [
        sample_modes(lambda z: misfit(z) + 0.5 * np.sum(z**2, axis=1), prior, [about], seed, 1000.0)
        for seed in range(4)
    ]
    assert np.mean([draws.mean[0] for draws in sampled]) == pytest.approx(mean, abs=0.2 * std)
    # judged by the draws that proposals were fitted to it was 0.6 of the exact one, and the evidence 0.6 lower
    assert 0.8 < np.mean([np.sqrt(draws.covariance[0, 0]) for draws in sampled]) / std < 1.1
    assert np.mean([draws.log_evidence for draws in sampled]) == pytest.approx(evidence, abs=0.15)
