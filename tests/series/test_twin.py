"""Twin experiments: their random numbers, their scores, and what the schemes reach on the field's test-beds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from en4dvar.config import load_twin
from en4dvar.data.noise import Correlation
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.report.sequence import ranks
from en4dvar.schemes.filters import ETKF, EnKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.moments import InnovationRecorder
from en4dvar.series.problem import SeriesProblem
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.series import CycleSeries
from en4dvar.series.settings import Inflation
from en4dvar.series.start import InitialEnsemble
from en4dvar.series.twin import TwinExperiment, TwinResult, conduct, observe_truth
from en4dvar_lorenz import Lorenz63, Lorenz96
from en4dvar_lorenz.lorenz63 import Lorenz63Settings
from en4dvar_lorenz.lorenz96 import Lorenz96Settings

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
L63 = {"x": 2**0.5, "y": 2**0.5, "z": 2**0.5}


def lorenz63(scheme, cycles, members=10, inflation=1.02, burn_in=50):
    """Sakov, Oliver & Bertino (2012), Table 1."""
    model = Lorenz63.from_settings(Lorenz63Settings())
    settings = SequentialSettings(scheme, Inflation(inflation), rotation=True)
    start = InitialEnsemble(model, L63, None, model.defaults)
    return TwinExperiment(start, settings, members, cycles, 0.25, L63, burn_in)


def lorenz96(scheme, cycles, members=25, inflation=1.02, burn_in=100):
    """Sakov & Oke (2008)."""
    model = Lorenz96.from_settings(Lorenz96Settings())
    settings = SequentialSettings(scheme, Inflation(inflation), rotation=True)
    start = InitialEnsemble(model, {"x": 0.001**0.5}, None, model.defaults)
    return TwinExperiment(start, settings, members, cycles, 0.05, {"x": 1.0}, burn_in)


def begun(experiment, **changes):
    """The same from another start."""
    return replace(experiment, start=replace(experiment.start, **changes))


def rmse(experiment, seed=1, kind="analysis"):
    return conduct(experiment, seed).scores[kind].mean_rmse


def test_the_same_seed_gives_the_same_bits_for_any_executor():
    experiment = lorenz63(IEnKS(1), 20)
    one, again, other = conduct(experiment, 1), conduct(experiment, 1, ThreadsExecutor(2)), conduct(experiment, 2)
    assert np.array_equal(one.run.members, again.run.members)
    assert np.array_equal(one.truth, again.truth)
    assert not np.array_equal(one.truth, other.truth)


def test_draws_stay_as_they_were():
    """More members leave the first ones, more cycles the earlier truth and observations."""
    small = lorenz96(ETKF(), 20, members=5)
    large = replace(small, members=9, cycles=30)
    assert np.array_equal(large.start.members(9, 3)[:5], small.start.members(5, 3))
    (a, y), (b, z) = observe_truth(small, 3), observe_truth(large, 3)
    assert np.array_equal(b[:20], a)
    assert np.array_equal(z.values[:20], y.values)
    assert np.std(z.values - b[:, :40]) == pytest.approx(1.0, abs=0.1)


def test_what_is_observed():
    experiment = replace(lorenz63(ETKF(), 400), error_std={"z": 0.5, "x": 0.1})
    truth, series = observe_truth(experiment, 1)
    assert [o.name for o in experiment.observables] == ["x", "z"]
    assert series.std.tolist() == [0.1, 0.5]
    assert np.std(series.values - truth[:, [0, 2]], axis=0) == pytest.approx([0.1, 0.5], rel=0.15)


@pytest.mark.parametrize("spread", [0.05, 1.0, 20.0])
def test_a_reliable_ensemble_has_flat_ranks(spread):
    """Of 10 members in place of 95 % of the bars none lay in the band, and the ends were 6 % in place of 10 %."""
    rng = np.random.default_rng(5)
    forecasts, truth = spread * rng.standard_normal((400, 10, 20)), spread * rng.standard_normal((400, 20))
    values = truth + rng.standard_normal(truth.shape)
    series = CycleSeries(np.arange(400.0), values, np.ones(20))
    recorder = InnovationRecorder(series, of_data=False)
    for cycle, forecast in enumerate(forecasts):
        recorder.put(cycle, forecast)
    recorder.moments()
    (panel,) = ranks(recorder.ranks).rows[0].panels
    band, bars = (next(m for m in panel.marks if m.kind == kind) for kind in ("span", "line"))
    outside = (bars.y[1:-1:2] < band.y[0]) | (bars.y[1:-1:2] > band.top[0])
    assert outside.sum() <= 2
    again = InnovationRecorder(series, of_data=False)
    again.put(3, forecasts[3])
    again.moments()
    assert np.array_equal(again.ranks[3], recorder.ranks[3])  # whatever cycles share its block


def test_correlated_errors(tmp_path):
    """Drawn and assimilated with the same R, read from a table; knowing R helps."""
    correlation = 0.9 ** np.abs(np.subtract.outer(np.arange(3), np.arange(3)))
    np.savetxt(tmp_path / "c.csv", correlation, delimiter=",")
    text = (CONFIGS / "lorenz63_ienks.yaml").read_text().replace("  burn_in:", "  error_correlation: c.csv\n  burn_in:")
    (tmp_path / "twin.yaml").write_text(text)
    config = load_twin(tmp_path / "twin.yaml", {"twin.cycles": 400, "twin.burn_in": 50})
    truth, series = observe_truth(config.experiment, 1)
    assert np.array_equal(series.correlation.matrix, correlation)
    errors = (series.values - truth[:, :3]) / series.std
    assert np.corrcoef(errors.T) == pytest.approx(correlation, abs=0.06)
    assert str(tmp_path / "c.csv") in config.resolved
    known = conduct(config.experiment, 1)
    blind = run_sequential(
        config.experiment.model,
        config.experiment.observables,
        config.experiment.start.members(config.experiment.members, 1),
        replace(series, correlation=None),
        config.experiment.sequential,
        1,
    )
    rmse_blind = np.sqrt(np.mean((blind.analysis.mean - truth)[50:, :3] ** 2, axis=1)).mean()
    assert known.scores["analysis"].mean_rmse < rmse_blind
    small = replace(config.experiment, error_correlation=Correlation(np.eye(2)))
    with pytest.raises(En4dvarError, match=r"twin\.error_correlation: correlation \(2, 2\) does not match 3"):
        conduct(small, 1)


def test_scores_by_hand():
    experiment = lorenz63(IEnKS(2), 12, burn_in=4)
    result = conduct(experiment, 1)
    error = result.run.analysis.mean[:, :3] - result.truth[:, :3]
    by_hand = np.sqrt(np.sum(error**2, axis=1) / 3)
    score = result.scores["analysis"]
    assert score.rmse == pytest.approx(by_hand)
    assert score.mean_rmse == pytest.approx(by_hand[4:].mean())
    assert score.spread == pytest.approx(np.sqrt(np.sum(result.run.analysis.std[:, :3] ** 2, axis=1) / 3))
    smoothed = result.scores["smoothed"]
    assert np.isnan(smoothed.rmse).tolist() == [False] * 10 + [True] * 2
    assert smoothed.mean_rmse == pytest.approx(smoothed.rmse[4:10].mean())
    assert "smoothed" not in conduct(lorenz63(ETKF(), 6), 1).scores


class Decay(ForwardModel):
    """Two decaying variables; the rates are carried in a field of another name."""

    parameters = (Parameter("a", "1/s"), Parameter("b", "1/s"))
    layout = StateLayout((Field("x", 2), Field("theta", 2)))
    observables = (Observable("x", "1", StateField("x")),)
    in_place = False

    def initial_state(self, theta):
        return np.array([1.0, 2.0, theta["a"], theta["b"]])

    def step(self, x, t0, t1):
        if not self.in_place:
            x = x.copy()
        x[:2] *= np.exp(-x[2:] * (t1 - t0))
        return x


class Named(Decay):
    layout = StateLayout((Field("x", 2), Field("a"), Field("b")))


class InPlace(Named):
    in_place = True


def decay(model, **changes):
    rates = {"a": 0.1, "b": 0.2}
    start = InitialEnsemble(model, {"x": 0.1}, None, rates)
    experiment = TwinExperiment(start, SequentialSettings(ETKF()), 8, 6, 0.5, {"x": 0.1})
    return replace(experiment, **changes)


def test_parameters_in_a_field_of_another_name_are_told_for_they_count_as_state():
    hidden, named = conduct(decay(Decay()), 1), conduct(decay(Named()), 1)
    assert hidden.scores["analysis"].rmse * 2**0.5 == pytest.approx(named.scores["analysis"].rmse)
    assert len(hidden.warnings) == 1
    assert hidden.warnings[0].startswith("2 variables of theta never change and have the values of parameters")
    assert named.warnings == ()
    prior = Prior((PriorTerm.normal(Decay.parameters[0], 0.1, 0.01),))
    assert "2 variables of theta" in conduct(begun(decay(Decay()), prior=prior, fixed={"b": 0.2}), 1).warnings[0]


def test_an_ensemble_that_has_lost_the_truth_is_told():
    lost = begun(decay(Named()), initial_std={"x": 1e-6})
    truth, series = observe_truth(lost, 1)
    members = lost.start.members(lost.members, 1) + np.array([0.5, 0.5, 0, 0])
    problem = SeriesProblem(lost.start, lost.observables, series, lost.sequential, lost.members)
    run = run_sequential(lost.model, lost.observables, members, series, lost.sequential)
    (warning,) = TwinResult(problem, 1, run, lost, truth).warnings
    assert "far too sure of itself" in warning


def test_a_step_may_work_in_place():
    """The members at the start of a window stay as they are."""
    for scheme in (SequentialSettings(ETKF()), SequentialSettings(IEnKS(2))):
        one, other = (conduct(decay(model, sequential=scheme), 1) for model in (Named(), InPlace()))
        assert np.array_equal(one.run.analysis.mean, other.run.analysis.mean)
        assert np.array_equal(one.truth, other.truth)


def test_an_initial_state_that_does_not_fit_is_told():
    class Short(Named):
        def initial_state(self, theta):
            return np.array([1.0, theta["a"], theta["b"]])

    class Misspelt(Named):
        def initial_state(self, theta):
            return np.array([1.0, 2.0, theta["A"], theta["b"]])

    with pytest.raises(En4dvarError, match=r"initial_state returned shape \(3,\), but the layout has \(4,\)"):
        conduct(decay(Short()), 1)
    with pytest.raises(En4dvarError, match="the initial state cannot be made: KeyError: 'A'"):
        conduct(decay(Misspelt()), 1)


def test_truth_that_cannot_be_integrated():
    experiment = begun(lorenz96(ETKF(), 5), initial_std={"x": 1e200})
    with pytest.raises(En4dvarError, match="truth cannot be integrated: non-finite state"):
        conduct(experiment, 1)


def test_analysis_is_better_than_forecast_and_than_the_observations():
    """Observation error 1.41 a variable; DAPPER's averages over long runs are 0.60 and 0.31."""
    filtered, smoothed = (conduct(lorenz63(scheme, 300), 1).scores for scheme in (ETKF(), IEnKS(1)))
    assert filtered["analysis"].mean_rmse < 0.75 < filtered["forecast"].mean_rmse
    assert smoothed["analysis"].mean_rmse < min(0.4, 0.75 * filtered["analysis"].mean_rmse)
    assert smoothed["smoothed"].mean_rmse < smoothed["analysis"].mean_rmse
    for scores in (filtered, smoothed):
        assert 0.7 < scores["analysis"].mean_spread / scores["analysis"].mean_rmse < 1.6


def test_parameter_is_estimated_with_the_state():
    model = Lorenz96.from_settings(Lorenz96Settings())
    term = PriorTerm.normal(model.parameters[0], 8.0, 0.5)
    experiment = begun(lorenz96(ETKF(), 400, members=40, inflation=1.01), prior=Prior((term,)), fixed={})
    result = conduct(experiment, 1)
    truth, estimate = result.truth[0, 40], result.run.analysis.mean[-1, 40]
    assert np.all(result.truth[:, 40] == truth)
    assert abs(truth - 8.0) > 0.1
    assert abs(estimate - truth) < 0.06
    assert result.run.analysis.std[-1, 40] < 0.1 * result.run.forecast.std[0, 40]
    assert result.scores["analysis"].mean_rmse < 0.25


EXPECTED = {  # config: (cycles, burn-in, upper bound of the analysis RMSE, lower bound)
    "linear_etkf": (200, 20, 0.08, 0.01),
    "lorenz63_ienks": (300, 50, 0.40, 0.20),
    "lorenz96_etkf": (300, 100, 0.21, 0.15),
    "lorenz96_ienks": (300, 100, 0.20, 0.14),
    "lorenz96_letkf": (250, 100, 0.26, 0.16),
    "lorenz96_parameter": (300, 150, 0.24, 0.15),
}


def test_a_constant_that_perturbed_observations_make_too_sure_is_told():
    term = PriorTerm.normal(Lorenz63.parameters[1], 28, 1)
    made = begun(lorenz63(EnKF(), 200, members=12, inflation=1.0), prior=Prior((term,)))
    fixed = {name: value for name, value in made.start.fixed.items() if name != term.parameter.name}
    told = conduct(begun(made, fixed=fixed), 1).warnings
    assert any(words.startswith("perturbed observations move and narrow rho by chance") for words in told)


def test_every_twin_configuration_is_run():
    twins = {p.stem for p in CONFIGS.glob("*.yaml") if "\ntwin:" in p.read_text(encoding="utf-8")}
    assert twins == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_shipped_configuration(name):
    cycles, burn_in, upper, lower = EXPECTED[name]
    config = load_twin(CONFIGS / f"{name}.yaml", {"twin.cycles": cycles, "twin.burn_in": burn_in})
    assert lower < rmse(config.experiment, config.seed) < upper


def test_few_members_need_localisation():
    """Ten members, fewer than the unstable directions: without localisation the filter diverges."""
    local = load_twin(CONFIGS / "lorenz96_letkf.yaml", {"twin.cycles": 150, "twin.burn_in": 50}).experiment
    everywhere = replace(local, sequential=replace(local.sequential, localisation=None))
    assert rmse(local) < 0.5 < 2.0 < rmse(everywhere)


BESIDE_A_FIELD = [
    {"scheme": "etkf", "members": 10, "inflation": 1.04},
    pytest.param({"scheme": "denkf", "members": 24, "inflation": 1.0}, marks=pytest.mark.slow),
    pytest.param({"scheme": "enkf", "members": 24, "inflation": 1.05}, marks=pytest.mark.slow),
    pytest.param({"scheme": "ienks", "members": 24, "inflation": 1.02}, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", BESIDE_A_FIELD)
def test_a_parameter_beside_a_localised_field(scheme):
    """F of Lorenz-96, drawn from N(8, 1), is estimated; errors of F and of the state are as large as their spread."""
    local = {"rotation": True, "localisation": {"radius": 7, "periodic": True}, **scheme}
    uncertain = {"F": {"prior": "normal", "mean": 8, "std": 1}}
    changes = {"twin.cycles": 120, "twin.burn_in": 60, "twin.initial_std.x": 1, "parameters": uncertain}
    experiment = load_twin(CONFIGS / "lorenz96_letkf.yaml", changes | {"assimilation": local}).experiment
    results = [conduct(experiment, seed) for seed in range(4)]
    stds = np.array([result.run.analysis.std[-1, 40] for result in results])
    errors = np.array([result.run.analysis.mean[-1, 40] - result.truth[-1, 40] for result in results])
    scores = [result.scores["analysis"] for result in results]
    assert 0.01 < stds.max() < 0.15
    assert 0.1 < np.sqrt(np.mean((errors / stds) ** 2)) < 2
    assert np.mean([score.mean_rmse for score in scores]) < 1.2 * np.mean([score.mean_spread for score in scores])


@pytest.mark.parametrize("members", [40, 41])
@pytest.mark.parametrize("local", [False, True])
def test_a_square_root_of_fewer_members_than_variables_is_told(members, local):
    twin = lorenz96(ETKF(), 3, members, burn_in=1)
    taper = BlockLocalisation.on_line(np.arange(40.0), np.arange(40.0), 4.0) if local else None
    settings = replace(twin.sequential, localisation=taper, model_error=ModelError(np.ones(41), "square-root"))
    told = [words for words in conduct(replace(twin, sequential=settings), 1).warnings if "square root" in words]
    assert [words[:37] for words in told] == ["40 members are fewer than the 41 that"] * (members == 40)


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
def test_a_taper_of_ones_is_no_localisation(linearisation):
    """Blocks that see every observation in full have the weights of the whole, in every iteration."""
    experiment = lorenz96(IEnKS(2, linearisation, tolerance=1e-6), 12, burn_in=2, members=25)
    size = experiment.model.layout.size
    everywhere = BlockLocalisation([np.arange(0, 15), np.arange(15, size)], np.ones((2, 40)))
    local = replace(experiment, sequential=replace(experiment.sequential, localisation=everywhere))
    assert rmse(local, 3) == pytest.approx(rmse(experiment, 3), rel=1e-6)


@pytest.mark.slow
def test_a_smoother_of_few_members_needs_localisation():
    """Ten members of Lorenz-96 and the IEnKS, lag 1: the whole diverges, the local one is as good as the local ETKF."""
    etkf = load_twin(CONFIGS / "lorenz96_letkf.yaml", {"twin.cycles": 150, "twin.burn_in": 50}).experiment
    smoother = replace(etkf, sequential=replace(etkf.sequential, scheme=IEnKS(1)))
    everywhere = replace(smoother, sequential=replace(smoother.sequential, localisation=None))
    assert rmse(smoother) < 1.05 * rmse(etkf) < 0.5 < 2.0 < rmse(everywhere)


PUBLISHED = [  # DAPPER 1.7.1, its suggested settings: analysis RMSE in long runs; and how many seeds tell 5 % for sure
    (lorenz63, ETKF(), {"members": 10}, 0.60, 24),
    (lorenz63, IEnKS(1), {"members": 10}, 0.31, 8),
    (lorenz96, ETKF(), {"members": 25}, 0.18, 2),
    (lorenz96, IEnKS(1), {"members": 25}, 0.181, 2),
    (lorenz96, IEnKS(4), {"members": 25}, 0.177, 2),
    (lorenz96, ETKF(), {"members": 40, "inflation": 1.01}, 0.18, 2),
    (lorenz96, IEnKS(1), {"members": 40, "inflation": 1.01}, 0.18, 2),
]


@pytest.mark.slow
@pytest.mark.parametrize(("system", "scheme", "options", "published", "seeds"), PUBLISHED)
def test_published_rmse(system, scheme, options, published, seeds):
    """Within 5 %. Lorenz-63 loses its way now and then: its ETKF scatters by 8 % from seed to seed (32 seeds: 0.593 ±
    0.009), and on another processor, which rounds differently, a seed is another run.
    """
    experiment = system(scheme, 3000, burn_in=300, **options)
    assert np.mean([rmse(experiment, seed) for seed in range(seeds)]) < 1.05 * published
