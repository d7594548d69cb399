"""Pages of a run, a campaign and a comparison, opened by a headless Chromium (tests/chromium.py)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from run_files import add_to_pack

from en4dvar.plumbing.caution import caution
from en4dvar.report import write_pages
from en4dvar.report.compare import compare_runs, write_comparison
from en4dvar.report.figures import all_figures
from en4dvar.report.result import Result
from en4dvar.results.provenance import provenance

EVIL = "<script>window.hacked=1</script><img src=x onerror='window.hacked=2'>"


@dataclass
class Seen:
    """A page of the browser with what it asked for and complained about."""

    page: Any
    requests: list[str]
    complaints: list[str]


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """``opened(path, scheme="light", width=1200)``: the page at ``path``, from file://."""
    contexts = []

    def open_page(path: Path, scheme: str = "light", width: int = 1200) -> Seen:
        context = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": 900})
        contexts.append(context)
        seen = Seen(context.new_page(), [], [])
        seen.page.on("request", lambda request: seen.requests.append(request.url))
        seen.page.on("console", lambda message: seen.complaints.append(message.text))
        seen.page.on("pageerror", lambda error: seen.complaints.append(str(error)))
        seen.page.goto(path.as_uri())
        return seen

    yield open_page
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def pages(analysis: Any, renamed: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Kind of page → its file. One data set of the campaign has a name made to break out of the page."""
    with pytest.MonkeyPatch.context() as patch:  # the PDF and PNG copies of the figures are no part of a page
        patch.setattr(import_module("en4dvar.report.svg"), "save_chart", lambda *_: None)
        return _write_pages(analysis, renamed, tmp_path_factory.mktemp("pages"))


def _write_pages(analysis: Any, renamed: Any, folder: Path) -> dict[str, Path]:
    found = {}
    notes = (caution("misfit", f"bad {EVIL}"), *analysis.cautions, caution("not-informed", "mu is hardly informed"))
    single = replace(analysis, cautions=notes, log_evidence=-100.0)
    calm = replace(single, cautions=(), log_evidence=-100.5, posterior=1.1 * analysis.posterior)
    for name, one in (("single", single), ("calm", calm)):
        run = folder / name
        run.mkdir()
        Result.from_analysis(one, provenance("name: test\n")).save(run / "posterior.nc")
    found["single"] = write_pages(folder / "single")
    comparison = compare_runs([folder / "single", folder / "calm"])
    found["compare"] = write_comparison(comparison, folder / "compare")
    campaign = folder / "campaign"
    for i, (stem, name) in enumerate((("b", "beta"), ("a", "alpha"), ("c", EVIL))):
        one = replace(renamed(calm, name), posterior=(1 + 0.2 * i) * calm.posterior, cautions=notes[:i])
        add_to_pack(campaign, stem, Result.from_analysis(one, provenance("name: test\n")))
    with pytest.MonkeyPatch.context() as patch:  # two figures on each page tell as much as five
        patch.setattr("en4dvar.report.page.all_figures", lambda result: islice(all_figures(result), 2))
        found["campaign"] = write_pages(campaign)
    found["set"] = campaign / "pages" / "c.html"
    return found
