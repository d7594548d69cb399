"""Climatology and optimal interpolation of a linear model: free moments, and one Kalman analysis of each."""

from __future__ import annotations

import numpy as np
from test_exact import CYCLES, DT, SEEN, STD, close, flow, linear_twin

from en4dvar.schemes.baselines import Climatology, OptimalInterpolation
from en4dvar.schemes.inflation import Inflation
from en4dvar.series.sequential import SequentialSettings, run_sequential


def test_members_run_freely_and_each_analysis_starts_from_them():
    model, observed, start, series = linear_twin(30)
    free = run_sequential(model, observed, start, series, SequentialSettings(Climatology()))
    # inflation acts on what is told of an analysis, never on the free members
    settings = SequentialSettings(OptimalInterpolation(), Inflation(1.5), rotation=True)
    oi = run_sequential(model, observed, start, series, settings)
    mean, cov = start[:, :8].mean(axis=0), np.cov(start[:, :8].T)
    m, h = flow(model, DT), np.eye(8)[SEEN]
    for k in range(CYCLES):
        mean, cov = m @ mean, m @ cov @ m.T
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + STD**2 * np.eye(3))
        for moments in (free.forecast, free.analysis, oi.forecast):
            close(moments.mean[k, :8], mean)
            close(moments.std[k, :8], np.sqrt(np.diag(cov)))
        close(oi.analysis.mean[k, :8], mean + gain @ (series.values[k] - h @ mean))
        close(oi.analysis.std[k, :8], 1.5 * np.sqrt(np.diag(cov - gain @ h @ cov)))
    assert free.forward_runs == CYCLES * 30
