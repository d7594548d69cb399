"""``en4dvar population`` on finished runs of the toy oscillator, and what is said of the draws."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import make_campaign
from scipy.stats import norm
from toys import Vectorised, make_observations, make_problem
from varying_models import KNOTS, Batched

from en4dvar.cli import main
from en4dvar.data.noise import noise_of
from en4dvar.data.noise.correlated import SharedErrors
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import Draws, Population, population_of, require_population
from en4dvar.estimation.population.campaign import _draws as of_white
from en4dvar.estimation.population.own import OwnDraws
from en4dvar.model.state import READING_OFFSET, READING_SCALE
from en4dvar.plumbing.caution import caution
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import RandomWalk, StateChanges
from en4dvar.problem import InverseProblem
from en4dvar.report.together import forest, sentences
from en4dvar.results.together import load_population
from en4dvar.runs.finished import Finished, _named_apart, finished
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import _cautions, _doubted, population

STD, SETS = 0.3, 6
SMALL = Effort(hyper_walkers=32, draws=1500)
TOLD: list[str] = []


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Three oscillators whose springs differ."""
    folder = tmp_path_factory.mktemp("population")
    overrides = {"output.report": False, "output.directory": str(folder / "run")}
    return run_campaign(make_campaign(folder, 3, "execution_models:Swift"), overrides=overrides).directory


DOUBT = caution("chain-not-converged", "only 8 effective draws support the population")


@pytest.fixture(scope="module")
def found(campaign, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:  # fresh draws of an emulator say nothing more
        patch.setattr("en4dvar.estimation.population.own._emulated", lambda *of: None)
        return population([campaign], ["k"], out, effort=SMALL, tell=TOLD.append)[0], out


def test_files_and_the_answer(found):
    stored, folder = found
    assert stored.names == ("k",)
    said = re.search(
        r"over 3 data sets, and how much these differ; cost: up to about (\d+) to (\d+) forward runs each of 3$",
        TOLD[0],
    )
    assert int(said[1]) / 4 < stored.attributes["forward_runs"] / 3 < int(said[2])
    posterior = stored.group("posterior")
    assert posterior["k_mean"].dims == ("chain", "draw")
    assert posterior["A"].dims == ("chain", "draw", "dataset")
    page = (folder / "population.html").read_text()
    assert "varies by" in page
    assert "the median (geometric mean) of the population" in page
    assert page.index("varies by") < page.index('id="forest"') < page.index("<h2>The population</h2>")
    assert "k_mean" not in page
    assert '<figure id="forest"><div class="scroll"><svg role' in page  # one panel: not as wide as the page
    assert f"{stored.attributes['effective_draws']:.0f} effective draws" in page
    population, sets = page.split("Each data set, given all of them")
    assert "what the data told" in population
    assert "what the data told" not in sets
    rows = (folder / "population.csv").read_text().splitlines()
    assert rows[1].startswith("median of the population,k,")
    assert "set2,k," in "\n".join(rows)
    assert r"\toprule" in (folder / "population.tex").read_text()
    assert 1.5 < np.median(posterior["k_mean"].values) < 2.2  # the springs are 1.6 to 2.05


def test_its_page_writes_symbols_where_the_terminal_writes_names(found):
    stored, _ = found
    posterior = stored.group("posterior")
    variables = {n: replace(v, attrs={**v.attrs, "symbol": r"$\kappa$"}) for n, v in posterior.variables.items()}
    written = replace(stored, groups={**stored.groups, "/posterior": replace(posterior, variables=variables)})
    told = sentences(written, written.symbols)
    assert told[0].startswith(stored.group("posterior")["k"].attrs["label"] + r" $\kappa$ = ")
    assert not any(re.search(r"\bk\b", line.removeprefix("k ")) for line in told)
    assert " k = " in sentences(stored)[0]


def test_the_median_of_a_lognormal_population_lies_below_its_mean(found):
    """exp(ν) and exp(ν + τ²/2), draw by draw; the second is larger by half the square of the relative spread."""
    posterior = found[0].group("posterior")
    median, mean, between = (posterior[f"k_{what}"].values for what in ("median", "mean", "between"))
    np.testing.assert_allclose((mean / median) ** 2, 1 + (between / mean) ** 2, rtol=1e-10)
    assert posterior["k_median"].attrs["std_common"] == 0


def warned(stored, line):
    root = replace(stored.groups["/"], attrs={**stored.attributes, "warnings": line})
    return replace(stored, groups={**stored.groups, "/": root})


def test_where_draws_are_few_the_median_one_by_one_stands_with_its_interval(found):
    """Warned draws give no number away, and withhold none."""
    stored = found[0]
    (first, *_) = sentences(warned(stored, DOUBT.line))
    low, _, high = stored.group("empirical")["k"].values
    assert "the median of 3 data sets one by one is k =" in first
    assert "chain-not-converged" in first
    low_text, high_text = first.split("5–95 %: ")[1].split(")")[0].split(" … ")
    assert (float(low_text), float(high_text)) == pytest.approx((low, high), abs=0.02)


def test_what_is_not_to_be_trusted_is_drawn_in_orange_without_an_interval(found):
    stored = found[0]
    common = {"k": stored.group("posterior")["k_median"]}
    for warnings, colours in (("", {"prior", "posterior"}), (DOUBT.line, {"prior", "centre"})):
        ((panel,),) = (row.panels for row in forest(warned(stored, warnings), stored.datasets, common).rows)
        assert {mark.colour for mark in panel.marks} == colours
        assert sum(mark.kind == "band" for mark in panel.marks) == (not warnings)


def test_who_is_odd_is_said_beside_the_number(found):
    stored = found[0]
    assert not any("Perhaps not" in line for line in sentences(stored))
    alone = stored.group("alone")
    belongs = replace(alone["belongs"], values=np.array([*alone["belongs"].values[:2], 0.3]))
    odd = replace(alone, variables={**alone.variables, "belongs": belongs})
    line = "Perhaps not of the population; these numbers count them only as far as they are: set2."
    assert line in sentences(replace(stored, groups={**stored.groups, "/alone": odd}))


def test_a_data_set_whose_readings_are_warned_of_counts_only_with_the_others(campaign, tmp_path, monkeypatch):
    config, sets = finished([campaign], True, None)
    sets = [replace(s, drawn=OwnDraws(s.white, 0.0, float(len(s.white)), 0)) for s in sets]
    wrong = caution("lost-frame", "after the reading at 3 s all times seem one interval too early")
    warned = [*sets[:2], replace(sets[2], cautions=(wrong,))]
    monkeypatch.setattr("en4dvar.runs.together.finished", lambda *of: (config, warned))
    stored, page = population([campaign], ["k"], tmp_path, effort=SMALL)
    assert stored.odd_before.tolist() == [0.05, 0.05, 0.9]
    assert stored.belongs["set2"] < 0.6 < min(stored.belongs["set0"], stored.belongs["set1"])
    line = "Counted only as far as the others bear them out, since warnings say that their readings are wrong: set2."
    assert line in sentences(stored)
    (alone,) = (sentence for sentence in sentences(stored) if "one by one" in sentence)
    assert "its data took away, set2 at a fraction of it, for warnings say that readings there are wrong" in alone
    assert "and of 0.9 if warnings of its own say that readings are wrong (set2)" in page.read_text()
    assert _doubted([replace(s, cautions=(replace(wrong, severity="caution"),)) for s in sets]) == set()
    assert _doubted([replace(s, cautions=(wrong,)) for s in sets]) == set()  # what most share is no oddity


def test_the_next_spring_is_less_certain_than_the_mean(found):
    posterior = found[0].group("posterior")
    assert posterior["k_next"].values.std() > 1.2 * posterior["k_mean"].values.std()
    assert posterior["k_mean"].attrs["learned"] > 0.8
    assert found[0].combinations == ()


@pytest.mark.slow
def test_the_command_and_a_damaged_file(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr("en4dvar.estimation.population.campaign.Effort", lambda: SMALL)
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["population", str(campaign), "--of", "k"])
    assert result.exit_code == 0, result.output
    assert "mean of the population" in result.output
    path = campaign.parent / "population_run" / "population.nc"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(OutputError, match=r"population\.nc"):
        load_population(path)


def test_bad_questions(campaign, tmp_path):
    with pytest.raises(ConfigError, match=r"q: not estimated in"):
        population([campaign], ["q"], tmp_path)
    result = CliRunner().invoke(main, ["population", str(campaign), "--of", "c"])
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize("what", ["median", "mean", "between", "next"])
def test_a_parameter_called_as_a_number_of_the_population_is_refused(what):
    """The draws of each data set would take the place of those of the population of ``a`` in the file."""
    model = Vectorised(names=("a", f"a_{what}"))
    problems = [make_problem(model, (1.0, 0.4), seed=s) for s in range(4)]
    with pytest.raises(ConfigError, match=f"a_{what}: the {what} of the population of a has this name, too"):
        require_population(problems, ["a"])
    require_population(problems, [f"a_{what}"])


def test_data_sets_of_several_runs_get_names_that_none_has():
    """Of runs with the data sets (x, x_2), (x) and (x) together."""
    problem, nothing = make_problem(Vectorised(), (1.0, 0.4)), np.empty(0)
    named = (replace(problem.observations, name=name) for name in ("x", "x_2", "x", "x"))
    sets = [Finished(None, replace(problem, observations=o), nothing, nothing, nothing, (), {}, None) for o in named]
    assert [s.name for s in _named_apart(sets)] == ["x", "x_2", "x_3", "x_4"]


def linear(seed: int = 4) -> list:
    """y = a + b cos(t + 1/3) + noise; a varies; b has a prior of its own in every set, centred wherever it likes."""
    rng, model = np.random.default_rng(seed), Vectorised()
    truths = [(1.0 + 0.5 * rng.standard_normal(), 0.4 + 0.1 * s) for s in range(SETS)]
    a, b = model.parameters
    problems = []
    for s, truth in enumerate(truths):
        problem = make_problem(model, truth, std=STD, seed=s, k=4 + s % 3)
        prior = Prior((PriorTerm.normal(a, 0.6, 0.9), PriorTerm.normal(b, 0.2 + 0.1 * s, 0.5 - 0.05 * s)))
        problems.append(replace(problem, prior=prior, observations=replace(problem.observations, name=f"set{s}")))
    return problems


def exact(problems, hyper):
    """Weights of (ν, τ) on a grid, and the exact moments of each a given ν, τ."""
    nu, tau = np.linspace(-3, 4, 141), np.geomspace(1e-2, 3, 61)
    total = norm(0.6, 0.9 * hyper.mean_std).logpdf(nu)[:, None] - 0.5 * (tau / (0.9 * hyper.spread)) ** 2
    means, variances = [], []
    for p in problems:
        t, term = p.observations.times, p.prior.terms[1]
        column = np.cos(t + 1 / 3)
        C = STD**2 * np.eye(len(t)) + term.std**2 * np.outer(column, column)
        y = p.observations.values - term.mean * column
        information, best = np.linalg.solve(C, np.ones(len(t))).sum(), 0.0
        best = np.linalg.solve(C, y).sum() / information
        total = total + norm(best, np.sqrt(1 / information + tau[None] ** 2)).logpdf(nu[:, None])
        variance = 1 / (information + tau**-2.0)
        means.append(variance * (information * best + nu[:, None] / tau**2))
        variances.append(np.broadcast_to(variance, means[-1].shape))
    weights = np.exp(total - total.max()) * np.gradient(tau)
    return weights / weights.sum(), nu, tau, np.array(means), np.array(variances)


def test_what_is_determined_together_only():
    """2 a + b is sharp, a and b are not: in units of their priors (std 0.5 and 1) it is the sum of both."""
    rng, model = np.random.default_rng(1), Vectorised()
    a, b = model.parameters
    prior = Prior((PriorTerm.normal(a, 0.0, 0.5), PriorTerm.normal(b, 0.0, 1.0)))
    problems = (replace(make_problem(model, [1.0, 0.4]), prior=prior),)
    free, sharp = rng.standard_normal((2, 4000))
    nu = np.stack([(free + 0.01 * sharp) / np.sqrt(2), (-free + 0.01 * sharp) / np.sqrt(2)], axis=1)
    tau = np.abs(0.5 * rng.standard_normal(nu.shape))
    draws = Draws(nu, nu, tau, nu, nu, tau)
    found = Population(("a", "b"), problems, HyperPrior(), draws, draws, nu[:, None], (400.0, 400.0), 0.0, 0)
    (one,) = found.combinations()
    exponents = dict(one.parts)
    assert exponents["a"] / exponents["b"] == pytest.approx(2.0, rel=0.02)
    together = exponents["a"] * 0.5 * nu[:, 0] + exponents["b"] * nu[:, 1]
    assert one.std == pytest.approx(together.std())
    assert one.std < 0.03
    kept, effective = found.without_hyperprior(1)
    assert kept.nu[:, 0].std() > 0.9 * nu[:, 0].std()
    assert effective < 200


def varying_by(spread, medians):
    """Warnings about a population of G alone whose spread is known to a tenth of itself."""
    rng, model = np.random.default_rng(1), Vectorised()
    toy = make_problem(model, [1.0, 0.4])
    terms = (PriorTerm.lognormal(model.parameters[0], 1.0, 1.0), *toy.prior.terms[1:])
    named = ((f"set{s}", replace(toy.observations, name=f"set{s}")) for s in range(len(medians)))
    problems = tuple(replace(toy, observations=readings, prior=Prior(terms)) for _, readings in named)
    nu, tau = 0.1 * rng.standard_normal((400, 1)), spread * (1 + 0.1 * rng.standard_normal((400, 1)))
    draws = of_white(terms[:1], nu, tau, rng)
    sets = np.stack([np.array(medians), np.ones(len(medians))], axis=1) * np.exp(
        0.01 * rng.standard_normal((400, 1, 1))
    )
    found = Population(("a",), problems, HyperPrior(odd=0.0), draws, draws, sets, (400.0, 400.0), 0.0, 0)
    return [told for told in _cautions(found) if told.code == "data-sets-differ"]


def test_a_population_that_varies_more_than_one_gel_names_its_sets_in_order():
    (told,) = varying_by(0.6, [17.0, 5.0, 18.0, 6.0])
    assert told.severity == "caution"
    assert "from the lowest to the highest: set1, set3, set0, set2" in told.words
    assert not varying_by(0.25, [9.0, 10.0, 11.0, 12.0])


def test_what_is_a_data_sets_own_follows_what_all_have_in_common():
    """b + offset is what each data set reads, and each knows the offset to 0.3."""
    rng, model = np.random.default_rng(1), Vectorised()
    terms = [PriorTerm.normal(p, 0.0, 1.0) for p in (*model.parameters, READING_OFFSET)]
    problems, kept = [], []
    for s in range(SETS):
        problem = make_problem(model, [1.0, 0.4], seed=s)
        observed = replace(problem.observations, name=f"set{s}")
        problems.append(replace(problem, observations=observed, prior=Prior(tuple(terms))))
        a, b, offset = rng.standard_normal((3, 1000)) * [[0.2], [0.01], [0.3]]
        kept.append(OwnDraws(np.stack([a, 0.1 * s - offset + b, offset], axis=1), 0.0, 500.0, 0))
    found = population_of(problems, [k.z[:20] for k in kept], ["a"], 2, kept=kept, effort=SMALL)
    assert found.common == ("reading_offset",)
    assert found.theta.std() == pytest.approx((1 + SETS * (0.3**-2 - 1)) ** -0.5, rel=0.1)
    read = found.sets[:, :, 1] + found.theta
    np.testing.assert_allclose(read.mean(axis=0), 0.1 * np.arange(SETS), atol=0.01)
    assert np.all(read.std(axis=0) < 0.02)


def test_common_quantities_are_as_certain_as_what_the_data_sets_leave_of_them():
    """Each reads a + 2(d − offset) and d − offset, which the priors of d and offset leave open to √2."""
    rng, model = np.random.default_rng(2), Vectorised()
    terms = [PriorTerm.normal(p, 0.0, 1.0) for p in (*model.parameters, READING_OFFSET)]
    terms.append(PriorTerm.lognormal(READING_SCALE, 1.0, 1.0))
    columns, errors = np.array([[1.0, 0.0, 2.0, -2.0], [0.0, 0.0, 1.0, -1.0]]), np.array([0.02, 0.1])
    inverse = np.eye(4) + (columns.T / errors**2) @ columns
    problems, kept, read = [], [], []
    for s in range(SETS):
        problem = make_problem(model, [1.0, 0.4], seed=s)
        observed = replace(problem.observations, name=f"set{s}")
        problems.append(replace(problem, observations=observed, prior=Prior(tuple(terms))))
        read.append(columns @ [0.5 + 0.01 * rng.standard_normal(), 0.0, 0.8, -0.4] + errors * rng.standard_normal(2))
        z = rng.multivariate_normal(
            np.linalg.solve(inverse, columns.T @ (read[-1] / errors**2)), np.linalg.inv(inverse), 2000
        )
        kept.append(OwnDraws(z, 0.0, 1000.0, 0))
    found = population_of(problems, [k.z[:20] for k in kept], ["a"], 2, kept=kept, effort=SMALL)
    of_combination = 1 / (1 / 2 + SETS / errors[1] ** 2)
    mean, combination = np.mean(read, axis=0)
    variance = 1 / (1 + 1 / (4 * of_combination))  # of ν ~ N(0, 1), beside which spread and errors are small
    expected = variance / (4 * of_combination) * (mean - 2 * combination * of_combination * SETS / errors[1] ** 2)
    assert found.posterior.nu.mean() == pytest.approx(expected, abs=0.15 * np.sqrt(variance))
    assert found.posterior.nu.std() == pytest.approx(np.sqrt(variance), rel=0.1)


@pytest.mark.slow
def test_a_linear_hierarchy_with_priors_of_their_own():
    problems, hyper = linear(), HyperPrior(1.0, 0.5)
    start = [0.3 * np.random.default_rng(s).standard_normal((20, 2)) for s in range(SETS)]
    found = population_of(problems, start, ["a"], 2, hyper=hyper, effort=SMALL)
    weights, nu, tau, means, variances = exact(problems, hyper)
    size = np.sqrt(found.size)
    mean = weights.sum(axis=1) @ nu
    std = np.sqrt(weights.sum(axis=1) @ nu**2 - mean**2)
    assert found.posterior.mean.mean() == pytest.approx(mean, abs=4 * std / size)
    assert found.posterior.between.mean() == pytest.approx(weights.sum(axis=0) @ tau, rel=0.1)
    for s in range(SETS):  # what each data set is, given all of them
        middle = np.sum(weights * means[s])
        spread = np.sqrt(np.sum(weights * (variances[s] + means[s] ** 2)) - middle**2)
        assert found.sets[:, s, 0].mean() == pytest.approx(middle, abs=4 * spread / size)
        assert found.sets[:, s, 0].std() == pytest.approx(spread, rel=0.15)
    following = np.sqrt(np.sum(weights * (nu[:, None] ** 2 + tau**2)) - mean**2)
    assert found.posterior.next.std() == pytest.approx(following, rel=0.15)


@pytest.mark.slow
def test_changes_of_the_state_are_each_bubbles_own():
    """y' = r, and y changes at one knot or at two: as if later readings shared an error, which is another way to it."""
    times, steps = np.linspace(0.25, 3.0, 12), (0.4, 0.6)
    with_changes, shared = [], []
    for seed in range(SETS):
        rng, knots = np.random.default_rng([5, seed]), KNOTS[: 1 + seed % 2]
        after = np.stack([q * (times > knot) for q, knot in zip(steps, knots, strict=False)], axis=1)
        values = 1 + (0.5 + 0.3 * rng.standard_normal()) * times + after @ rng.standard_normal(len(knots))
        observed = make_observations(times, values + 0.05 * rng.standard_normal(12), 0.05, name=f"set{seed}")
        model = Batched()
        model.compiled = True  # sampled, as cheap models are
        prior = Prior((PriorTerm.normal(model.parameters[0], 0.0, 1.0),))
        plain = InverseProblem(model, model.observables[0], observed, prior)
        changes = [
            StateChanges.of(model, model.layout.fields[0], [knot], q, relative=False)
            for q, knot in zip(steps, knots, strict=False)
        ]
        merged = replace(changes[0], knots=knots, changes=tuple(_numbered(changes)))
        with_changes.append(plain.varied([merged]))
        std, common = SharedErrors.beside(observed.noise.std, after)
        shared.append(replace(plain, observations=replace(observed, noise=noise_of(std, correlation=common))))
    found, other = (
        population_of(problems, [np.zeros((20, len(p.prior.names))) for p in problems], ["r"], 2, effort=SMALL)
        for problems in (with_changes, shared)
    )
    assert found.sets.shape == other.sets.shape
    std = other.posterior.mean.std()
    assert found.posterior.mean.mean() == pytest.approx(other.posterior.mean.mean(), abs=0.2 * std)
    assert found.posterior.mean.std() == pytest.approx(std, rel=0.15)
    assert found.sets.mean(axis=0) == pytest.approx(other.sets.mean(axis=0), abs=0.05)


def _numbered(changes):
    """The terms of several changes of one field, in order."""
    for k, change in enumerate(changes, 1):
        (term,) = change.changes
        yield replace(term, parameter=replace(term.parameter, name=f"y_change_{k}"))


def test_parameters_that_walk_or_have_several_priors_have_no_population():
    model = Batched()
    first = PriorTerm.normal(model.parameters[0], 0.0, 1.0)
    observed = make_observations(np.arange(1.0, 5.0), np.ones(4), 0.1)
    problem = InverseProblem(model, model.observables[0], observed, Prior((first,)))
    walking = problem.varied([RandomWalk.of(model, first, (2.0,), 0.3)])
    with pytest.raises(ConfigError, match="do not vary in time"):
        population_of([walking] * 3, [np.zeros((20, 2))] * 3, ["r"], 2)
    other = replace(problem, prior=Prior((replace(first, std=2.0),)))
    with pytest.raises(ConfigError, match=r"r: its prior must be the same .* with one configuration"):
        population_of([problem, other, problem], [np.zeros((20, 1))] * 3, ["r"], 2)
