"""Priors as fields beside the text of a configuration, by clicks in a real Chromium."""

from __future__ import annotations

import pytest
import yaml
from clicking import done, proposed, require_accessible, until

UNITS = {"time_column": "Zeit", "radius_column": "Radius", "time_unit": "us", "radius_unit": "um"}
pytestmark = pytest.mark.slow


def changed(page, label, value):
    page.get_by_label(label, exact=True).fill(value)
    page.keyboard.press("Tab")


def invalid(page):
    return page.evaluate(
        "[...document.querySelectorAll('[aria-invalid=true]')].map((e) => e.getAttribute('aria-label'))"
    )


def test_a_prior_changed_in_its_fields_is_that_of_the_text(visit, serve, german):
    page = visit(serve(german))
    proposed(page, "messung.csv", **UNITS)
    text = page.input_value("#text").splitlines()
    at = next(i for i, line in enumerate(text) if line.startswith("  G: "))
    names = page.eval_on_selector_all("#priors th[scope=row]", "cells => cells.map((c) => c.innerText)")
    own = yaml.safe_load("\n".join(text))["parameters"]
    assert names == [name for name, term in own.items() if "prior" in term]
    changed(page, "G: unit", "kPaa")
    until(page, "document.querySelectorAll('#faults button').length === 1")
    assert f"line {at + 1}: " in page.inner_text("#faults")
    assert "did you mean" in page.inner_text("#faults")
    assert invalid(page) == ["G: median or mean", "G: unit", "G: width"]
    require_accessible(page)
    changed(page, "G: median or mean", "700")
    changed(page, "G: unit", "Pa")
    changed(page, "G: width", "0.9")
    until(page, "!document.querySelector('#faults button')")
    until(page, "!!document.querySelector('#job-validate.done')")
    assert invalid(page) == []
    after = (german / "messung.yaml").read_text(encoding="utf-8").splitlines()
    assert [i for i, (a, b) in enumerate(zip(text, after, strict=True)) if a != b] == [at]
    prior = yaml.safe_load("\n".join(after))["parameters"]["G"]
    assert prior == {"prior": "lognormal", "median": "700 Pa", "log_std": 0.9}
    before = page.input_value("#text")
    changed(page, "mu: width", "0.5, extra: 3")
    until(page, "message.innerText.includes('Give a number')")
    assert page.input_value("#text") == before
    page.fill("#text", before.replace("median: 700 Pa", "median: 800 Pa"))
    assert page.get_by_label("G: median or mean", exact=True).input_value() == "800"
    page.get_by_label("mu: width", exact=True).fill("1.1")
    done(page, "prior")  # clicked while the change is checked
    assert "log_std: 1.1" in (german / "messung.yaml").read_text(encoding="utf-8")
