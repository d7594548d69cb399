"""Climatology and optimal interpolation of a linear model: free moments, and one analysis of each by averages of them.

Optimal interpolation is written here with covariances in the space of the state, as Whitaker & Hamill (2002) do.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import sqrtm
from test_exact import CYCLES, DT, SEEN, STD, close, flow, linear_twin

from en4dvar.schemes.filters import Climatology, OptimalInterpolation
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.settings import Inflation


def test_members_run_freely_and_each_analysis_starts_from_them():
    model, observed, start, series = linear_twin(30)
    free = run_sequential(model, observed, start, series, SequentialSettings(Climatology()))
    # inflation acts on what is told of an analysis, never on the free members
    settings = SequentialSettings(OptimalInterpolation(), Inflation(1.5), rotation=True)
    oi = run_sequential(model, observed, start, series, settings)
    mean, cov = start[:, :8].mean(axis=0), np.cov(start[:, :8].T)
    m, h, r = flow(model, DT), np.eye(8)[SEEN], STD**2 * np.eye(3)
    every = []
    for k in range(CYCLES):
        mean, cov = m @ mean, m @ cov @ m.T
        every.append(cov)
        averaged = np.average(every, axis=0, weights=range(1, len(every) + 1))
        root = np.real(sqrtm(h @ averaged @ h.T + r))
        gain = averaged @ h.T @ np.linalg.inv(root @ root)
        left = np.eye(8) - averaged @ h.T @ np.linalg.inv(root).T @ np.linalg.inv(root + sqrtm(r)) @ h
        for moments in (free.forecast, free.analysis, oi.forecast):
            close(moments.mean[k, :8], mean)
            close(moments.std[k, :8], np.sqrt(np.diag(cov)))
        close(oi.analysis.mean[k, :8], mean + gain @ (series.values[k] - h @ mean))
        close(oi.analysis.std[k, :8], 1.5 * np.sqrt(np.diag(left @ cov @ left.T)))
    assert free.forward_runs == CYCLES * 30
