"""The order of warnings, whose numbers they spoil, and what is said of the data: decided once, for every output."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.provoked import PROVOKED, bent, linear, run
from toys import Decay, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.diagnosis.honesty.checks import conflict, gaussian, information
from en4dvar.estimation.summary import informed_words
from en4dvar.model.state import Parameter
from en4dvar.plumbing.caution import CATALOGUE, SEVERITIES, Caution, caution, gravity, untrusted, worst_first
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.results.store import StoredResult

G = Parameter("G", "Pa", bounds=(0.0, np.inf), display_unit="kPa")
MU = Parameter("mu", "Pa s", bounds=(0.0, np.inf))
PRIOR = Prior((PriorTerm.lognormal(G, 1000.0, 1.0), PriorTerm.lognormal(MU, 0.1, 0.5)))


def some(code, *parameters, severity=None):
    return caution(code, "words", severity, parameters)


def test_the_catalogue_stands_in_the_order_it_gives():
    cautions = [some(code) for code in CATALOGUE]
    assert list(worst_first(reversed(cautions))) == cautions
    assert [c.severity for c in cautions] == sorted((c.severity for c in cautions), key=SEVERITIES.index)


def test_what_ruins_the_values_comes_before_what_ruins_the_interval():
    order = [c.code for c in worst_first(map(some, CATALOGUE))]
    assert order.index("not-converged") < order.index("misfit") < order.index("ensemble-collapse")
    assert order.index("non-gaussian") < order.index("overstated-error")
    graver = some("non-gaussian", severity="serious")
    assert worst_first((some("members-lost"), graver, some("start-moved")))[0] is graver
    unknown = Caution("other", "caution", "of another version", "")
    assert worst_first((some("start-moved"), unknown, some("overstated-error")))[1] is unknown


def test_data_sets_sort_by_their_worst_warning_first():
    ranked = [
        (), (some("start-moved"),), (some("not-informed"),), (some("not-informed"), some("start-moved")),
        (some("at-bound"),) * 5, (some("members-lost"),), (some("misfit"),), (some("not-converged"),),
    ]  # fmt: skip
    values = [gravity(cautions) for cautions in ranked]
    assert values == sorted(values)
    assert len(set(values)) == len(values)


def test_whose_interval_is_not_to_be_quoted():
    found = (some("at-bound", "G"), some("not-informed", "mu"), some("odd-residuals"))
    assert untrusted(found, "G") == ("at-bound",)
    assert untrusted(found, "mu") == ()
    assert untrusted((*found, some("misfit")), "mu") == ("misfit",)
    assert untrusted((*found, some("misfit")), "G") == ("misfit", "at-bound")
    assert untrusted((some("not-converged", severity="note"),), "G") == ()
    assert untrusted((some("non-gaussian", "G"),), "mu") == ()
    assert untrusted((some("non-gaussian"),), "mu") == ("non-gaussian",)


def test_a_line_keeps_whose_it_is():
    one = some("at-bound", "G", "mu")
    assert one.line.startswith("caution [at-bound: G mu] words — ")
    assert Caution.parse(one.line) == one


@pytest.mark.parametrize(("code", "names"), [("at-bound", ("a",)), ("not-informed", None), ("ensemble-collapse", ())])
def test_checks_say_whose_numbers_they_are_about(code, names):
    found = [c for c in PROVOKED[code]().cautions if c.code == code]
    for c in found:
        expected = (c.words.split()[0],) if names is None else names
        assert c.parameters == expected


def test_the_summary_follows():
    ended = PROVOKED["at-bound"]()
    analysis = replace(ended, cautions=tuple(c for c in ended.cautions if c.code == "at-bound"))
    rows = {row.name: row for row in StoredResult.from_analysis(analysis, {}).rows}
    assert rows["a"].untrusted == ("at-bound",)
    assert rows["a"].informed == ""
    assert rows["b"].untrusted == ()
    assert rows["b"].informed


def test_words_of_the_data_are_for_the_check_to_find():
    little = (some("not-informed", "G"),)
    assert informed_words("G", 0.05, little) == "data say little"
    assert informed_words("mu", 0.05, little) == "not narrowed by the data"
    assert informed_words("G", 0.05, (*little, some("misfit"))) == ""
    assert informed_words("G", float("nan"), ()) == ""
    assert [informed_words("G", dfs, ()) for dfs in (0.3, 0.7, 0.95)] == [
        "weakly informed", "informed", "determined by the data",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("shift", "dfs", "doubted", "told"),
    [
        (0.0, 0.05, (), True),
        (0.0, -0.2, (), True),
        (0.0, 0.15, (), False),
        (0.0, -0.8, (), False),  # wider than the prior
        (1.0, 0.05, (), False),  # moved, not narrowed
        (0.0, 0.05, ("G",), False),  # the members may not be the posterior
    ],
)
def test_little_is_said_only_where_it_is_so(shift, dfs, doubted, told):
    x = PRIOR.sample(48, 1, "exact") + np.array([shift, 0.0])
    found = list(information(PRIOR, x, np.array([dfs, 0.9]), doubted))
    assert [c.parameters for c in found] == [("G",)] * told


def test_a_posterior_that_moved_without_narrowing_is_not_called_silent():
    """A reading whose error is about the prior's width, far from the prior: little narrowing, a large shift."""
    problem = linear(scale=0.05, std=0.5, k=6)
    values = problem.observations.values + 2.0
    moved = run(replace(problem, observations=replace(problem.observations, values=values)))
    codes = {p: [c.code for c in moved.cautions if p in c.parameters] for p in ("a", "b")}
    assert moved.dfs_per_parameter[0] < 0.1
    assert "not-informed" not in codes["a"]


def shape(mean, std, share=0.9):
    physical = {"emulated_mean_G": mean, "emulated_std_G": std, "emulated_mean_mu": 0.1, "emulated_std_mu": 0.02}
    return {"gaussian_fit": 0.3, "emulator_fit": share, "mean_shift": 0.2, "spread_ratio": 1.6, **physical}


def test_sizes_are_those_of_the_printed_value():
    """1.6 in ln G is 4.3 kPa against 1 kPa in G: it is G that the page prints."""
    rng = np.random.default_rng(1)
    members = np.column_stack([4000.0 + 4300.0 * rng.standard_normal(2000), 0.1 + 0.02 * rng.standard_normal(2000)])
    (found,) = gaussian(PRIOR, members, shape(3900.0, 1000.0))
    assert found.parameters == ("G",)
    assert found.severity == "serious"  # more than a factor of two
    mean, std = (float(v) / 1e3 for v in (members[:, 0].mean(), members[:, 0].std(ddof=1)))
    assert f"G = {mean:.2g} ± {std:.2g} kPa where it should be about 3.9 ± 1 kPa" in found.words
    assert "1.6" not in found.words
    (mild,) = gaussian(PRIOR, members, shape(3900.0, 3000.0))
    assert mild.severity == "caution"
    (unsure,) = gaussian(PRIOR, members, shape(3900.0, 1000.0, share=0.1))
    assert unsure.parameters == ()
    assert list(gaussian(PRIOR, members, {"gaussian_fit": 0.9})) == []


def test_a_conflict_tells_both_values_as_they_are_printed():
    (found,) = conflict(PRIOR, np.array([np.log(1000.0) + 6.0, np.log(0.1)]))
    assert "G at 403 kPa where the prior says 0.368 to 2.72 kPa: +6.0 prior standard deviations" in found.words
    assert "mu at" not in found.words


def test_a_conflict_of_one_parameter_among_many_is_told():
    prior = Prior(tuple(PriorTerm.normal(Parameter(f"k_{j}", "1"), 0.0, 1.0) for j in range(12)))
    centre = np.zeros(12)
    centre[7] = 4.5
    (found,) = conflict(prior, centre)
    assert "(k_7 at 4.5 where the prior says -1 to 1: +4.5 prior standard deviations)" in found.words
    centre[7] = 3.8
    assert not list(conflict(prior, centre))
    draws = np.random.default_rng(1).standard_normal((20000, 12))
    assert sum(bool(list(conflict(prior, draw))) for draw in draws) < 20  # 10 are expected


def test_a_bound_is_told_as_it_is_printed():
    p = Parameter("y0", "m", bounds=(0.0, 1.0), display_unit="mm")
    model = PROVOKED["at-bound"]().problem.model
    other = PriorTerm.normal(model.parameters[1], 0.5, 1.0)
    problem = make_problem(
        model, (1.6, 0.5), prior=(PriorTerm.logit(replace(p, name="a"), (0.0, 1.0), 0.5, 1.5), other)
    )
    (found,) = (c for c in run(problem).cautions if c.code == "at-bound")
    assert "its upper bound (1e+03 mm)" in found.words


@pytest.mark.parametrize(("std", "severity"), [(0.05, "serious"), (5.0, "caution")])
def test_a_structure_far_below_the_errors_spoils_no_interval(std, severity):
    """The same curve that the model lacks, read with the errors it comes near to, and with errors a hundred times so
    large: all residuals together are less than one standard deviation then.
    """
    problem = bent()
    wide = replace(problem.observations, noise=noise_of(np.full(40, std)))
    analysis = run(replace(problem, observations=wide))
    (found,) = (c for c in analysis.cautions if c.code == "residual-structure")
    assert found.severity == severity
    assert all(
        ("residual-structure" in row.untrusted) == (severity == "serious")
        for row in StoredResult.from_analysis(analysis, {}).rows
    )


@pytest.mark.slow
def test_after_a_chain_the_words_are_those_of_the_chain():
    """Its draws have another spread than the Gaussian about the mode."""
    problem = make_problem(Decay(), (1.0, 0.8), std=0.3, k=8, scale=0.5)
    refined, plain = (run(problem, refine=refine, what_if=False) for refine in ("mcmc", "none"))
    x = problem.prior.from_physical(refined.posterior)
    np.testing.assert_allclose(refined.dfs_per_parameter, 1 - x.var(axis=0) / problem.prior.std**2, atol=0.03)
    assert np.abs(refined.dfs_per_parameter - plain.dfs_per_parameter).max() > 0.05
    for row, dfs in zip(StoredResult.from_analysis(refined, {}).rows, refined.dfs_per_parameter, strict=True):
        assert row.informed == informed_words(row.name, float(dfs), refined.cautions)
