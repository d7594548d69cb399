"""What the page of a fit says before anything is unfolded: numbers, trust, the fit, the prior itself, what if."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta, lognorm, norm, uniform

from en4dvar import estimate
from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED, member_quantiles
from en4dvar.diagnosis.residuals import Residuals
from en4dvar.model.state import Parameter
from en4dvar.plumbing.caution import caution
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.report.figures import histograms, neighbours
from en4dvar.report.history import history
from en4dvar.report.html import _environment
from en4dvar.report.page import judge_chi2, render_set, trust
from en4dvar.report.result import Result
from en4dvar.results.scalars import SAMPLE_STATS

JARGON = ("whitened", "leverage", "descent", "members alive", "DFS", "NRMSE", "χ²")


def with_terms(analysis, *terms):
    """The analysis as if the priors of its first parameters were these."""
    kept = analysis.problem.prior.terms[len(terms) :]
    return replace(analysis, problem=replace(analysis.problem, prior=Prior((*terms, *kept))))


def densities(analysis):
    """(values, density scaled to its peak) of the prior in each panel, in display units."""
    rows = histograms(Result.from_analysis(analysis, {})).rows
    bands = [
        next(m for m in p.marks if m.kind == "band" and m.colour == "prior") for r in rows for p in r.panels if p.marks
    ]
    return [(band.x, band.top) for band in bands]


def test_the_prior_is_drawn_as_its_density_and_not_from_draws(analysis):
    p = Parameter("G", "Pa", display_unit="kPa", label="modulus")
    cases = (
        (PriorTerm.lognormal(p, 2000.0, 0.5), lognorm(0.5, scale=2.0), np.exp(np.log(2.0) - 0.25)),
        (PriorTerm.normal(p, 2000.0, 300.0), norm(2.0, 0.3), 2.0),
        (PriorTerm.uniform(p, (1000.0, 5000.0)), uniform(1.0, 4.0), 2.0),
    )
    for term, exact, peak in cases:
        x, density = densities(with_terms(analysis, term))[0]
        inner = slice(2, -2)
        np.testing.assert_allclose(density[inner], exact.pdf(x[inner]) / exact.pdf(peak), atol=0.006)
        assert x[0] == pytest.approx(exact.ppf(norm.cdf(-4)))
        assert x[-1] == pytest.approx(exact.ppf(norm.cdf(4)))


def test_a_prior_with_values_that_are_a_bound_to_rounding_is_drawn(analysis):
    x, density = densities(with_terms(analysis, PriorTerm.beta(Parameter("G", "Pa"), (0.0, 1.0), 1.0, 0.1)))[0]
    assert np.all(np.isfinite(density))
    inner = (x > 0.1) & (x < 0.99)
    shape = beta(1.0, 0.1).pdf(x[inner])
    np.testing.assert_allclose(density[inner] / density[inner][0], shape / shape[0], rtol=0.1)


def test_a_result_of_before_shows_the_draws_that_it_holds(analysis):
    result = Result.from_analysis(analysis, {})
    group = result.groups["/sample_stats"]
    kept = {name: variable for name, variable in group.variables.items() if name != "prior_value"}
    old = Result({**result.groups, "/sample_stats": replace(group, variables=kept)})
    heights = np.unique(histograms(old).rows[0].panels[0].marks[0].top)
    assert len(heights) < 12  # steps


def test_what_is_expected_of_a_single_reading_can_be_seen():
    """A band at one instant has no width."""
    prior = {"a": {"prior": "normal", "mean": 2, "std": 1}}
    result = estimate(lambda p, t: p["a"] + 0 * t, ([3.0], [2.5]), prior, error=0.1, progress=False)
    drawn = {mark.label: mark for mark in history(result).rows[0].panels[0].marks}
    for label, members in (("prior 90 %", result.prior), ("posterior 90 %", result.posterior)):
        ends = member_quantiles(members["a"].values, (0.05, 0.95))
        assert drawn[label].kind == "bars"
        np.testing.assert_allclose([*drawn[label].y, *drawn[label].top], ends, rtol=1e-9)
    assert drawn["best fit"].kind == "dashes"


@pytest.mark.parametrize("wide", [1, 1000])
def test_a_prior_that_knew_little_does_not_flatten_the_posterior(analysis, wide):
    analysis = replace(analysis, prior=wide * analysis.prior)
    result = Result.from_analysis(analysis, {})
    for panel in (p for row in histograms(result).rows for p in row.panels if p.xlim):
        (ticks,) = (mark for mark in panel.marks if mark.kind == "ticks")
        assert panel.xlim[0] < np.nanmin(ticks.x)
        assert panel.xlim[1] > np.nanmax(ticks.x)
        assert np.ptp(panel.xlim) < 8 * np.ptp(ticks.x[np.isfinite(ticks.x)])


def page_of(analysis):
    result = Result.from_analysis(analysis, {})
    return render_set(result)


def test_the_page_answers_in_the_order_of_the_questions(analysis):
    page = page_of(replace(analysis, cautions=()))
    body = page[page.index("<body>") :]
    places = [
        body.index(mark)
        for mark in ('class="lead"', 'class="verdict"', 'id="d0-history"', 'id="d0-posterior"', "<h2>More")
    ]
    assert places == sorted(places)
    first = body[: body.index("<h2>More")]
    assert first.count("90 %: ") == len(analysis.parameters) - 1  # the data say nothing new of one
    shown = re.sub(r"<[^>]+>", " ", re.sub(r"<details.*?</details>|title=\"[^\"]*\"", "", first, flags=re.S))
    assert [word for word in JARGON if word.lower() in shown.lower()] == []
    assert 'id="d0-iterations"' in body[body.index("<details") :]


def test_what_the_data_leave_as_stated_is_one_line_unless_they_moved_it(analysis):
    def lead_and_rest(members):
        page = page_of(replace(analysis, posterior=members, cautions=()))
        return page[page.index('class="lead"') :].lower().split("</table>", 1)

    (at,) = [j for j, share in enumerate(analysis.dfs_per_parameter) if share < HARDLY_INFORMED]
    label = analysis.parameters[at].label
    lead, rest = lead_and_rest(analysis.posterior)
    assert label not in lead
    assert re.search(f"what was known before of[^<]*: {label}.</p>", rest)
    moved = analysis.posterior + np.eye(len(analysis.parameters))[at] * analysis.prior[:, at].std()
    lead, rest = lead_and_rest(moved)
    assert label in lead
    assert "what was known before of" not in rest


def test_warnings_stand_where_else_the_trust_is_told(analysis):
    page = page_of(replace(analysis, cautions=(caution("misfit", "it misfits"),)))
    assert 'class="verdict"' not in page
    assert page.index("it misfits") < page.index('id="d0-history"')


def test_a_reading_that_counts_less_is_told_where_else_nothing_is_wrong(analysis):
    """It said "No warnings" beside a reading 14 standard deviations off."""
    far = caution("down-weighted", "1 of 25 observations lies beyond 1.345, down-weighted: at 12 us (14 std off)")
    words = trust(Result.from_analysis(replace(analysis, cautions=(far,)), {}))
    assert words.startswith("No warnings: ")
    assert ". But 1 of 25 observations lies beyond 1.345, down-weighted: at 12 us (14 std off)." in words
    assert "But" not in trust(Result.from_analysis(replace(analysis, cautions=()), {}))


def with_residuals(analysis, white, sensitivity=None):
    """A result with these residuals of readings of such whitened sensitivities, those of none without."""
    result, k = Result.from_analysis(replace(analysis, cautions=()), {}), len(white)
    linear = np.zeros((k, 1)) if sensitivity is None else sensitivity
    residuals = Residuals.of(np.asarray(white), linear, 47.0, np.ones(k), np.arange(k))
    group, name = result.groups["/sample_stats"], f"{result.observable}_whitened_residual"
    variables = {**group.variables, name: replace(group["dfs"], dims=(result.axes[0].time,), values=residuals.white)}
    told = {a.name: a.value(replace(analysis, residuals=residuals)) for a in SAMPLE_STATS if "lag_one" in a.name}
    attrs = {**group.attrs, **{name: value for name, value in told.items() if value is not None}}
    return Result({**result.groups, "/sample_stats": replace(group, variables=variables, attrs=attrs)})


def test_residuals_that_leave_their_band_are_not_called_unrelated(analysis):
    k = len(analysis.observations)
    independent = np.random.default_rng(1).standard_normal(k)
    words = trust(with_residuals(analysis, independent))
    assert "unrelated" in words
    words = trust(with_residuals(analysis, independent + 2.0 * (-1.0) ** np.arange(k)))
    assert "unrelated" not in words
    assert "alternate in sign" in words
    assert "resemble each other" in trust(with_residuals(analysis, np.cumsum(independent)))


def test_residuals_of_a_right_fit_are_called_odd_once_in_20(analysis):
    """Of 10 readings a fit of 5 numbers leaves residuals that alternate: 38 of 100 right fits were to be looked at."""
    rng, k = np.random.default_rng(5), 10
    sensitivity = 20 * np.cos(np.pi * np.outer(np.linspace(0, 1, k), np.arange(5)))
    gain = sensitivity @ np.linalg.solve(47 * np.eye(5) + sensitivity.T @ sensitivity, sensitivity.T)
    odd = 0
    for _ in range(80):
        y = sensitivity @ rng.standard_normal(5) / 47**0.5 + rng.standard_normal(k)
        odd += "unrelated" not in trust(with_residuals(analysis, y - gain @ y, sensitivity))
    assert odd < 12  # of 4 expected: four standard deviations


def test_nothing_is_said_of_neighbours_that_are_few_or_exact(analysis):
    for white in (np.arange(7.0), 1e-5 * np.arange(40.0)):
        assert "neighbouring" not in trust(with_residuals(analysis, white))


def test_the_band_of_neighbours_holds_19_of_20_independent_series():
    rng = np.random.default_rng(3)
    outside = [abs(c[0]) > limit for c, limit in (neighbours(rng.standard_normal(100)) for _ in range(2000))]
    assert np.mean(outside) == pytest.approx(0.05, abs=0.015)


@pytest.mark.parametrize("chi2", [4e-8, 1.0])
def test_a_fit_of_as_many_numbers_as_readings_tells_nothing_of_the_noise(chi2):
    """The page of one reading, of which one number is estimated, said that its noise may be overstated."""
    assert judge_chi2(chi2, 1, 0.999999) == (
        "misfit tells nothing of the noise: the fit determines about as many numbers as it has readings",
        False,
    )
    assert judge_chi2(30.0, 1, 0.999999)[1]


def test_a_box_of_notes_alone_is_called_notes():
    """On the pages of a joint estimate and of a population they stood as warnings, in orange."""
    told = _environment("en4dvar.report").get_template("cautions.html.j2").module.told
    note, grave = caution("down-weighted", "one reading counts less"), caution("misfit", "too large")
    assert '<div class="warnings notes" role="note"><strong>Notes</strong>' in told([note])
    assert '<div class="warnings" role="note"><strong>All: warnings</strong>' in told([grave, note], "All: ")
    assert not told([]).strip()
