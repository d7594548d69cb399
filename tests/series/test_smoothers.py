"""EnKS and EnRTS: the Kalman smoother of a linear model, each other elsewhere, and members that are lost."""

from __future__ import annotations

import numpy as np
import pytest
import test_model_error as with_error
from test_exact import CYCLES, batch_posterior, chaotic_twin, close, linear_twin
from test_loop import Breaking, Forced, members, series

from en4dvar.schemes.baselines import Climatology
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.esrf import ESRF
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.smoothers import EnKS, EnRTS


@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("smoother", [EnKS(1), EnKS(3), EnKS(CYCLES + 2), EnRTS()])
@pytest.mark.parametrize(("scheme", "n_members"), [(ETKF(), 5), (ETKF(), 30), (ESRF(), 12)])
def test_smoothed_moments_are_those_of_the_kalman_smoother(scheme, n_members, smoother, rotation):
    model, observed, start, y = linear_twin(n_members)
    settings = SequentialSettings(scheme, rotation=rotation, smoother=smoother)
    result = run_sequential(model, observed, start, y, settings)
    plain = run_sequential(model, observed, start, y, SequentialSettings(scheme, rotation=rotation))
    assert np.array_equal(result.analysis.mean, plain.analysis.mean)  # the filter does not notice
    assert np.isnan(plain.smoothed.mean).all()
    for k in range(1, CYCLES + 1):
        upto = min(CYCLES, k + getattr(smoother, "lag", CYCLES))
        mean, cov = batch_posterior(model, start, y, upto, k)
        close(result.smoothed.mean[k - 1, :8], mean, 1e-11)
        close(result.smoothed.std[k - 1, :8], np.sqrt(np.diag(cov)), 1e-11)


def test_both_are_the_same_in_the_space_of_a_small_ensemble():
    """Fewer members than variables, chaos, inflation and rotation: J_k then is exact along every anomaly."""
    model, start, y = chaotic_twin(n_members=12)
    results = [
        run_sequential(
            model, model.observables, start, y, SequentialSettings(EnKFN(), Inflation(1.1), rotation=True, smoother=one)
        )
        for one in (EnKS(20), EnRTS())
    ]
    assert results[0].smoothed.mean == pytest.approx(results[1].smoothed.mean, abs=1e-8)
    assert results[0].smoothed.std == pytest.approx(results[1].smoothed.std, abs=1e-8)


@pytest.mark.parametrize("smoother", [EnKS(2), EnRTS()])
def test_the_past_of_lost_members_is_not_smoothed(smoother):
    """Members fail in the third cycle; nothing is learned after the first, so what is smoothed are the survivors."""
    start, blind = members(), series(std=1e9)
    lost = np.abs(start[:, 1]) > 1.2
    result = run_sequential(
        Breaking(1.2, 2.5), Forced.observables, start, blind, SequentialSettings(ETKF(), smoother=smoother)
    )
    alone = start[~lost, 1]
    assert len(result.failures) == lost.sum() > 0
    assert result.analysis.mean[1, 1] == pytest.approx(start[:, 1].mean(), abs=1e-9)
    assert result.smoothed.mean[1, 1] == pytest.approx(alone.mean(), abs=1e-9)
    assert result.smoothed.std[1, 1] == pytest.approx(alone.std(ddof=1), abs=1e-9)


def test_enrts_smooths_over_the_model_error():
    """The mean is that of the Rauch–Tung–Striebel smoother with Q; what draws leave of the spread tends to its."""
    errors = []
    for n_members in (12, 400):
        model, observed, start, y = with_error.twin(n_members)
        settings = SequentialSettings(ETKF(), model_error=ModelError(with_error.RATE), smoother=EnRTS())
        result = run_sequential(model, observed, start, y, settings)
        exact = with_error.given(model, start, y, with_error.RATE)
        last, variables = len(y.times), slice(0, with_error.N)
        for k in range(last):
            mean, std = exact(last, k + 1)
            assert result.smoothed.mean[k, variables] == pytest.approx(mean, abs=1e-10)
            errors.append(np.abs(result.smoothed.std[k, variables] / std - 1).max())
    assert max(errors[last:]) < 0.06
    assert max(errors[last:]) < 0.5 * max(errors[:last])


def test_what_takes_no_smoother():
    local = BlockLocalisation([np.arange(2)], np.ones((1, 2)))
    for scheme in (IEnKS(1), Climatology()):
        with pytest.raises(ValueError, match="behind a filter that is cycled"):
            SequentialSettings(scheme, smoother=EnRTS())
    with pytest.raises(ValueError, match="with localisation use enrts"):
        SequentialSettings(ETKF(), localisation=local, smoother=EnKS(2))
    with pytest.raises(ValueError, match="must be at least 1, not 0"):
        EnKS(0)
