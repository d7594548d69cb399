"""A model run piece by piece: its paths, what may fail, what may not vary."""

from __future__ import annotations

import numpy as np
import pytest
from toy_models import Oscillator, OscillatorSettings
from varying_models import KNOTS, Batched, Ending, Ramp, Steep

from en4dvar.model.forward import Failure, Trajectory
from en4dvar.model.state import Field
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying import PiecewiseModel, RandomWalk, StateChanges

TIMES = np.array([0.25, 1.0, 1.5, 3.0, 4.0, 5.0])


def ramp(kind=Ramp, knots=KNOTS, **options):
    model = kind(**options)
    return PiecewiseModel(model, [RandomWalk.of(model, PriorTerm.normal(model.parameters[0], 1.0, 1.0), knots, 0.5)])


def theta(members=4):
    rng = np.random.default_rng(2)
    values = {"r": rng.standard_normal(members)}
    return values | {f"r_change_{k}": 0.5 * rng.standard_normal(members) for k in (1, 2, 3)}


def expected(theta, times):
    """y (N, K) in closed form."""
    rates = np.cumsum(np.stack(list(theta.values())), axis=0)
    edges = np.array([0.0, *KNOTS, 100.0])
    spent = np.clip(times[:, None] - edges[:-1, None], 0.0, np.diff(edges)[:, None])
    return 1.0 + np.einsum("pn,npk->nk", rates, spent)


def own_times(members=4):
    """Instants (N, K) that differ by a shift, so that members pass the knots at different observations."""
    return TIMES + np.linspace(0.0, 0.6, members)[:, None]


@pytest.mark.parametrize("kind", [Ramp, Batched])
def test_paths_in_closed_form(kind):
    model, values, times = ramp(kind), theta(), own_times()
    paths = model.trajectories(model.initial_states(values), times)
    y = np.stack([path["y"] for path in paths])
    assert y == pytest.approx(expected(values, times), abs=1e-13)
    rates = np.cumsum(np.stack(list(values.values())), axis=0)
    for i, path in enumerate(paths):
        which = np.searchsorted(KNOTS, times[i])
        assert path["y"] == pytest.approx(y[i])
        assert path["r"] == pytest.approx(rates[which, i])
        assert path.largest("r") >= np.abs(path["r"]).max()
        assert np.array_equal(path["r_pieces"], np.tile(path["r_pieces"][0], (len(TIMES), 1)))
        assert path.states.shape == (len(TIMES), model.layout.size)
        assert np.array_equal(path.states[:, 0], path["y"])
        assert np.array_equal(path.states[:, 2:], path["r_pieces"])


@pytest.mark.parametrize("kind", [Ramp, Batched])
def test_resumed_from_any_state_of_the_path(kind):
    model, values = ramp(kind), theta(1)
    (whole,) = model.trajectories(model.initial_states(values), TIMES)
    for k in range(len(TIMES) - 1):
        start = whole.states[[k]]
        (rest,) = model.resumed(start, TIMES[[k]], TIMES[None])
        assert rest["y"][k:] == pytest.approx(whole["y"][k:], abs=1e-13)
        assert rest["y"][:k] == pytest.approx(whole["y"][k])
        assert model.step(start[0], TIMES[k], TIMES[-1])[0] == pytest.approx(whole["y"][-1], abs=1e-13)


@pytest.mark.parametrize("kind", [Steep, Ending])
def test_a_member_that_fails_in_some_piece_does_not_disturb_the_others(kind):
    values, times = theta(6), own_times(6)
    rates = np.cumsum(np.stack(list(values.values())), axis=0)
    failing = (rates > 1.0).any(axis=0)
    assert 0 < failing.sum() < 6
    well = ramp({Steep: Ramp, Ending: Batched}[kind])
    paths = well.trajectories(well.initial_states(values), times)
    model = ramp(kind, limit=1.0)
    outcomes = model.trajectories(model.initial_states(values), times)
    for outcome, path, failed in zip(outcomes, paths, failing, strict=True):
        if failed:
            assert isinstance(outcome, Failure)
            assert "too steep" in outcome.reason
        else:
            assert isinstance(outcome, Trajectory)
            assert np.array_equal(outcome.states, path.states)
    everyone = ramp(kind, limit=-100.0).trajectories(model.initial_states(values), times)
    assert all(isinstance(outcome, Failure) for outcome in everyone)


def test_a_logarithm_walks_and_stays_within_bounds():
    model = Oscillator(OscillatorSettings(mass="2 g"))
    walk = RandomWalk.of(model, PriorTerm.lognormal(model.parameters[1], 3.0, 0.3), (0.01, 0.02), 0.2)
    pieces = walk.pieces({"k": np.array([3.0]), "k_change_1": np.array([-np.log(2)]), "k_change_2": np.array([0.1])})
    assert pieces == pytest.approx(np.array([[3.0, 1.5, 1.5 * np.exp(0.1)]]))
    assert [change.parameter.label for change in walk.changes] == [
        "change of ln stiffness at 0.01 s", "change of ln stiffness at 0.02 s",
    ]  # fmt: skip
    assert [change.parameter.symbol for change in walk.changes] == ["Δ1 ln k", "Δ2 ln k"]
    varied = PiecewiseModel(model, [walk])
    given = {"A": np.array([1e-4]), "k": np.array([3.0]), "c": np.array([0.0]), "k_change_2": np.array([0.0])}
    assert varied.initial_states(given | {"k_change_1": np.array([0.1])}).shape == (1, 7)
    with pytest.raises(ValueError, match=r"a piece of k outside \[0, inf\] N/m"):
        varied.initial_states(given | {"k_change_1": np.array([1e4])})
    outside = walk.pieces({"k": np.array([-1.0, np.nan]), "k_change_1": np.zeros(2), "k_change_2": np.zeros(2)})
    assert np.isnan(outside).all()


def test_a_state_that_changes():
    """y' = r with steps of y at 1 and 2: by an amount, by a factor, out of its bounds, and resumed anywhere."""
    model = Ramp()
    for relative in (False, True):
        steps = StateChanges.of(model, model.layout.fields[0], (1.0, 2.0), 0.5, relative)
        varied = PiecewiseModel(model, [steps])
        change = {f"y_change_{k}": np.array([value]) for k, value in ((1, 0.5), (2, -0.2))}
        x = varied.initial_states({"r": np.array([2.0])} | change)
        (path,) = varied.trajectories(x, TIMES)
        at_1 = 3.0 * np.exp(0.5) if relative else 3.5
        at_2 = (at_1 + 2.0) * np.exp(-0.2) if relative else at_1 + 1.8
        assert path["y"] == pytest.approx([1.5, 3.0, at_1 + 1.0, at_2 + 2.0, at_2 + 4.0, at_2 + 6.0])
        for k in range(len(TIMES)):
            (rest,) = varied.resumed(path.states[[k]], TIMES[[k]], TIMES[None])
            assert rest["y"][k:] == pytest.approx(path["y"][k:])
    bounded = StateChanges(Field("y", unit="m", bounds=(0.0, np.inf)), False, (1.0, 2.0), steps.changes)
    varied = PiecewiseModel(model, [bounded])
    change = {"y_change_1": np.array([0.1, -9.0]), "y_change_2": np.array([0.1, 0.1])}
    well, lost = varied.trajectories(varied.initial_states({"r": np.array([2.0, 2.0])} | change), TIMES)
    assert isinstance(well, Trajectory)
    assert lost == Failure("y outside (0, inf) m after its change", 1.0)
