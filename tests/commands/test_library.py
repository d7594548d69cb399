"""The library without the command line: the sessions of two pages, run block by block."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import pytest
from doc_pages import ROOT, blocks

import en4dvar

pytestmark = pytest.mark.slow  # as the examples of the other pages
PAGES = [ROOT / "docs" / "function_and_arrays.md", ROOT / "docs" / "tutorial_library.md"]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str, Path]:
    """Names that the session leaves, what it printed, and its folder."""
    folder = tmp_path_factory.mktemp("library")
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        for page in PAGES:
            of_page: dict[str, Any] = {}  # each page stands alone
            for block in blocks(page):
                assert block.language == "python"
                exec(compile(block.body, f"{page.name}:{block.line}", "exec"), of_page)
            names.update(of_page)
    return names, printed.getvalue(), folder


def test_the_session_runs_and_recovers_its_truth(session: tuple[dict[str, Any], str, Path]) -> None:
    names, printed, folder = session
    truth = {"G": 420.0, "alpha": 0.029, "mu": 0.086, "R0": 0.43e-6, "t_s": 0.25e-6}
    members = names["members"]
    assert list(members.columns) == list(truth)
    for name, value in truth.items():
        assert abs(members[name].mean() - value) < 3 * members[name].std(), name
    assert names["ahead"].outside == 0
    coffee = names["coffee"].to_dataframe()
    assert (abs(coffee.mean() - [92.0, 0.05]) < 3 * coffee.std()).all()
    assert "exponential is preferred" in printed
    assert (folder / "coffee.html").is_file()
    assert "posterior" in names["inference_data"].groups()
    assert (folder / "posterior.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "runs" / "gel" / "report.html").is_file()
    assert "data.error.radius_std | 1.4 has no unit" in printed
    assert "model.law | unknown law 'quadratik-kelvin-voigt'; did you mean 'quadratic-kelvin-voigt'?" in printed
    assert re.search(r"^gel +mu +Pa s +0\.0", printed, re.MULTILINE)
    assert "2 posteriors, 0 failures" in printed
    assert r"\begin{tabular}" in printed


def test_what_a_session_prints_of_a_result(session: tuple[dict[str, Any], str, Path]) -> None:
    result = session[0]["result"]
    text = str(result)
    assert text.splitlines()[0].split()[:4] == ["data", "set", "parameter", "unit"]
    assert re.search(r"^converged: .*; chi2/K [\d.]+, NRMSE 0\.9\d+, DFS [\d.]+$", text, re.MULTILINE)
    for figure, panels in ((result.plot_histograms(), 5), (result.plot_history(), 2), (result.plot_pairs(), 25)):
        assert len(figure.axes) == panels


def test_nothing_global_changes(session: tuple[dict[str, Any], str, Path]) -> None:
    """A second run beside the first gives the same numbers, whatever ran in between."""
    names, _, folder = session
    with contextlib.chdir(folder):
        again = en4dvar.run(names["config"], force=True)
    assert again.posterior.identical(names["result"].posterior)
