"""All bubbles of one gel estimated together, and where no single gel fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.joint import estimate_jointly, sharing
from en4dvar.plumbing.caution import caution
from en4dvar.priors.prior import member_stream
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_agarose import report, run
from en4dvar_agarose.fits import Fit
from en4dvar_agarose.run import _Parts

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_sets_that_lose_a_reading_of_no_bubble_are_as_many_as_the_page_says():
    sets = [p.observations for gel in ("03", "10") for p in build(load_config(CONFIGS / f"agarose_{gel}_qlkv.yaml"))]
    lost = [y for y in sets if any("left out, for they are 0 or below" in doubt.words for doubt in y.doubts)]
    assert all(y.values.min() > 0 for y in sets)
    page = (CONFIGS.parent / "docs" / "agarose_study.md").read_text(encoding="utf-8")
    assert f"{len(lost)} of the {len(sets)} sets lose their last reading" in page


@pytest.mark.slow
def test_bubbles_of_one_gel_are_recognised_and_those_of_several_are_not():
    base = build(load_config(CONFIGS / "agarose_10_qlkv.yaml"))[:4]
    prior, stream = base[0].prior, member_stream(3, "one gel")
    truth = np.tile(prior.mean, (4, 1))
    truth[:, 3:] += 0.5 * prior.std[3:] * stream.standard_normal((4, 2))
    exact = [forecast(problem, x[None]).predictions[0] for problem, x in zip(base, truth, strict=True)]
    problems = []
    for s, problem in enumerate(base):
        o = problem.observations
        values = exact[s] + o.std * stream.standard_normal(len(o))
        problems.append(replace(problem, observations=replace(o, values=values)))
    names, settings = ["G", "alpha", "mu"], AssimilationSettings(refine="none", what_if=False)
    one = estimate_jointly(sharing(problems, names), settings, 1)
    assert 0.5 < one.chi2.mean() < 1.6
    assert one.shared_mode[2] == pytest.approx(0.15, rel=0.05)  # viscosity is what is told best
    several = estimate_jointly(sharing(base, names), settings, 1)  # the twin's bubbles differ in G, α and μ
    assert several.chi2.mean() > 3


def test_doubts_about_the_evidence_of_a_gel_leave_it_without_a_verdict(monkeypatch):
    """Laplace's evidence of one law, from a descent that went on; what is no doubt about a number is not told."""
    codes = {"nh": ("not-converged", "non-gaussian", "data-sets-differ"), "qlkv": ("non-gaussian",)}
    config = SimpleNamespace(assimilation=None)
    keep = SimpleNamespace(of=lambda kind, compute, *words: compute())
    parts = _Parts(SimpleNamespace(configs={"gel": dict.fromkeys(codes, config)}, seed=1), None, print, keep, {})
    fits = {m: Fit("gel", m, tuple(build(load_config(CONFIGS / f"agarose_10_{m}.yaml"))[:1]), None, ()) for m in codes}
    monkeypatch.setattr(Fit, "log_evidence", np.zeros(1))
    monkeypatch.setattr(run, "sharing", lambda problems, names: names)

    def estimate(names, *_):
        cautions = [caution(code, "words") for code in codes["qlkv" if "alpha" in names else "nh"]]
        return SimpleNamespace(log_evidence=1.0, chi2=np.ones(1), cautions=cautions)

    monkeypatch.setattr(run, "estimate_jointly", estimate)
    compared = parts._comparison(fits, dict.fromkeys(codes))

    def verdict_of(comparison):
        return report._comparison(SimpleNamespace(fits={"gel": fits}, comparisons={"gel": comparison}))[-1][-1]

    assert verdict_of(compared) == "no verdict: its evidence is in doubt (not-converged, non-gaussian)"
    misfits = verdict_of(replace(compared, chi2=(7.5, 8.0)))
    assert misfits.endswith("non-gaussian); no single gel fits (χ² per reading 7.5 and 8.0)")
    assert verdict_of(replace(compared, doubts=())) == "undecidable"
