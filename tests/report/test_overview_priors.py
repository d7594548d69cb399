"""Priors in the overview of a campaign: exact, and one where they are one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from en4dvar.report.page import SetSummary, overview_figures
from en4dvar.report.result import Result
from en4dvar.results.provenance import provenance


@pytest.mark.parametrize("count", [3, 50])
def test_priors_of_the_overview_are_each_data_set_s_own_where_they_differ(analysis, count):
    one = SetSummary.of(Result.from_analysis(analysis, provenance("name: test\n")), "set")
    name, row = next(iter(one.rows.items()))
    sets = [
        replace(
            one,
            rows={**one.rows, name: replace(row, mean=10.0 * i, q05=0.0, q95=1e3)},
            priors={**one.priors, name: (10.0 * i - 1, 10.0 * i + 1)},
        )
        for i in range(count)
    ]
    (_, _, drawn), (_, _, others) = overview_figures(sets, [name])
    ((panel,),) = (line.panels for line in drawn.rows)
    grey = [mark for mark in panel.marks if mark.colour == "prior"]
    assert sorted(v for mark in grey for v in {*mark.y}) == [10.0 * i - 1 for i in range(count)]
    assert sorted(v for mark in grey for v in {*mark.top}) == [10.0 * i + 1 for i in range(count)]
    assert len(others.rows) == len(one.rows) - 1
    for line in others.rows:
        assert [mark.kind for mark in line.panels[0].marks if mark.colour == "prior"] == ["span"]


def test_one_prior_is_one_in_the_overview_however_its_members_scatter(analysis):
    """Members of a lognormal prior whose logarithm has a std of 1.5 had stds of 12 to 150 kPa, and 40 sets 40 bars."""
    one = SetSummary.of(Result.from_analysis(analysis, provenance("name: test\n")), "set")
    name, row = next(iter(one.rows.items()))
    sets = [replace(one, rows={name: replace(row, prior_std=std * row.prior_std)}) for std in (1.0, 3.0, 9.0)]
    ((_, _, drawn),) = overview_figures(sets)
    (mark,) = (mark for mark in drawn.rows[0].panels[0].marks if mark.colour == "prior")
    assert mark.kind == "span"
    score = np.array([-1.0, 1.0]) * ndtri(0.95)
    term = analysis.problem.prior.terms[0]
    exact = 1e-3 * term.to_physical(term.mean + term.std * score)  # in kPa
    assert one.priors[name] == pytest.approx(exact, rel=0.01)
