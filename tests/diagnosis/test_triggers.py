"""Every warning is provoked by a problem built for it, and says what to do."""

from __future__ import annotations

import pytest
from diagnosis.provoked import PROVOKED, chain_not_converged
from diagnosis.provoked_by_several import OF_SEVERAL

from en4dvar.plumbing.caution import ABOUT, CATALOGUE, SEVERITIES, TRIGGERS, Caution, caution
from en4dvar.sampling import mcmc


@pytest.mark.parametrize("code", PROVOKED)
def test_the_problem_built_for_it_is_warned_of(code):
    cautions = PROVOKED[code]().cautions
    assert code in {c.code for c in cautions}
    assert [SEVERITIES.index(c.severity) for c in cautions] == sorted(SEVERITIES.index(c.severity) for c in cautions)
    for c in cautions:
        assert c.words
        assert c.advice
        assert Caution.parse(c.line) == c


def test_chain_that_has_not_mixed(monkeypatch):
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 60})
    assert "chain-not-converged" in {c.code for c in chain_not_converged().cautions}


def test_every_code_has_its_test():
    assert set(CATALOGUE) == set(ABOUT) == set(TRIGGERS) == {*PROVOKED, *OF_SEVERAL, "chain-not-converged"}


@pytest.mark.parametrize("words", ["plain", "ends — like advice", "two\nlines [misfit] — of it", "<b> & 'quotes' …"])
def test_a_line_of_the_file_is_read_back(words):
    written = caution("misfit", words)
    line = written.line
    assert "\n" not in line
    assert Caution.parse(line) == Caution("misfit", "serious", " ".join(words.split()), written.advice)


def test_a_line_of_another_version_is_kept_as_it_is():
    assert Caution.parse("something odd") == Caution("other", "caution", "something odd", "")
