"""Axes that are logarithmic: of data sets over what they have in common, and of what varies in time."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from en4dvar.report import figures, responses
from en4dvar.report.together import forest
from en4dvar.results.netcdf import Group, Variable

ABOUT = {"units": "1", "display_units": "1", "symbol": "x"}


@pytest.mark.parametrize(("lowest", "logarithmic"), [(0.2, True), (-0.2, False)])
def test_an_interval_that_reaches_below_zero_is_drawn(lowest, logarithmic):
    """Of data sets that differ by a factor of 160 it was on a logarithmic axis, and had no width."""
    alone = Variable(("dataset", "quantile"), np.array([[0.01, 0.1, 0.3], [0.5, 1.0, 1.6]]), ABOUT)
    groups = SimpleNamespace(group=lambda name: Group({"x": alone} if name == "alone" else {}), doubts=())
    draws = Variable(("chain", "draw"), np.linspace(lowest, 1.0, 100)[None], ABOUT)
    ((panel,),) = (row.panels for row in forest(groups, ("a", "b"), {"x": draws}).rows)
    assert panel.x_logarithmic == logarithmic
    assert panel.limits()[0][0] < panel.marks[0].x[0]


@pytest.mark.parametrize(("lowest", "logarithmic"), [(0.02, True), (-1.0, False)])
def test_a_prior_that_reaches_below_zero_is_drawn_below_what_varies(monkeypatch, lowest, logarithmic):
    posterior, prior = np.array([[0.1], [0.12], [0.15]]), np.array([[lowest], [1.0], [3.0]])
    walk = figures.StoredWalk("k", "rate", "k", "1", "s", np.array([0.0, 1.0]), posterior, prior)
    monkeypatch.setattr(figures, "stored_walks", lambda result: (walk,))
    monkeypatch.setattr(responses, "time_label", lambda result: "time")
    (((panel,),),) = ((row.panels for row in figures.bands(None).rows),)
    assert panel.logarithmic == logarithmic
