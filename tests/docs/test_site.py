"""The site as a reader gets it: built strictly, complete, and in need of no network (extra ``docs``)."""

from __future__ import annotations

import doctest
import html
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from doc_pages import ROOT, hook

import en4dvar
import en4dvar_bubble
from en4dvar.config.data import Data
from en4dvar.config.load import Estimation
from en4dvar.config.schema import Assimilation
from en4dvar_bubble.settings import BubbleSettings

pytest.importorskip("mkdocs", reason="the extra docs is not installed")
pytest.importorskip("latex2mathml", reason="the extra docs is not installed")
pytestmark = pytest.mark.slow
BROWSER = shutil.which(os.environ.get("CHROMIUM", "chromium"))
TAG = r"<(?:script|img|iframe|source|link(?! rel=.canonical)) [^>]*"
REMOTE = re.compile(TAG + r"(?:src|href)=[\"']?(https?://[^\"' >]+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]  # not quiet: it counts
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_there_and_can_be_found(site):
    home = (site / "index.html").read_text(encoding="utf-8")
    generated = {"reference_yaml", "reference_cli", "reference_api", "reference_warnings"}
    for name in {p.stem for p in (ROOT / "docs").glob("*.md")} | generated:
        assert (site / f"{name}.html").is_file()
        assert f'href="{name}.html"' in home or name == "index", f"{name} is not in the navigation"


def test_nothing_is_loaded_from_elsewhere(site):
    for page in site.rglob("*.html"):
        assert REMOTE.findall(page.read_text(encoding="utf-8")) == [], page.name
    for sheet in site.rglob("*.css"):
        assert re.findall(r"url\([\"']?https?:", sheet.read_text(encoding="utf-8")) == [], sheet.name


def test_signatures_are_wrapped(site):
    page = (site / "reference_api.html").read_text(encoding="utf-8")
    signatures = re.findall(r'<div class="[^"]*doc-signature[^>]*>.*?</div>', page, re.DOTALL)
    assert len(signatures) > 50
    for signature in signatures:
        lines = html.unescape(re.sub(r"<[^>]+>", "", signature)).splitlines()
        assert all(len(line) <= 80 or '"' in line for line in lines), lines[0]  # texts are not cut


def test_formulas_are_drawn_by_the_browser(site):
    total = 0
    for page in site.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert "arithmatex" not in text, f"{page.name} holds a formula that was not converted"
        formulas = re.findall(r"<math .*?</math>", text, re.S)
        assert not [f for f in formulas if "\\" in html.unescape(f)]
        total += len(formulas)
    assert total > 100


def test_the_reference_is_complete(site):
    keys = (site / "reference_yaml.html").read_text(encoding="utf-8")
    for section, prefix in ((Estimation, ""), (Data, "data."), (Assimilation, "assimilation.")):
        for name in section.model_fields:
            assert f">{prefix}{name}<" in keys, name
    for name in BubbleSettings.model_fields:
        assert f">{name}<" in keys, name
    python = (site / "reference_api.html").read_text(encoding="utf-8")
    for name in [*(n for n in dir(en4dvar) if not n.startswith("_")), *en4dvar_bubble.__all__]:
        assert re.search(rf'id="en4dvar[\w.]*\.{name}"', python), name


def test_nothing_runs_out_of_the_screen(site, browser):
    """Help was cut at the right, names of variables broken within words, and a formula made a page of 696 pixels."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((site / "reference_cli.html").as_uri())
    blocks = "[...document.querySelectorAll('pre > code')].filter((e) => e.scrollWidth > e.clientWidth)"
    long_examples = "filter((e) => !/^ +en4dvar .{80,}$/m.test(e.innerText))"
    assert page.evaluate(f"{blocks}.{long_examples}.map((e) => e.innerText)") == []
    page.goto((site / "reference_netcdf.html").as_uri())
    words = "[...document.querySelectorAll('td code')].flatMap((e) => [...e.childNodes]).filter((e) => e.data)"
    lines = "((e) => { const r = new Range(); r.selectNode(e); return r.getClientRects().length; })"
    assert page.evaluate(f"{words}.filter((e) => /^\\w+$/.test(e.data) && {lines}(e) > 1).map((e) => e.data)") == []
    assert "``" not in (site / "reference_yaml.html").read_text(encoding="utf-8")
    page.set_viewport_size({"width": 390, "height": 900})
    for file in sorted(site.glob("*.html")):
        page.goto(file.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") == 390, file.name
    page.close()


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_the_search_works_from_a_file(site):
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom"]
    page = f"{(site / 'index.html').as_uri()}?q=Kirchhoff"
    shown = subprocess.run([*command, page], capture_output=True, text=True, timeout=120).stdout
    assert re.search(r"md-search-result__meta\">\s*\d+ matching", shown)


def test_docstrings_become_markdown():
    result = doctest.testmod(hook("docstrings"))
    assert result.attempted
    assert result.failed == 0


@pytest.mark.parametrize(("tex", "understood"), [(r"\frac{a}{b} \le \mathcal H", True), (r"\nonsense{a}", False)])
def test_a_formula_that_is_not_understood_is_a_warning(tex, understood, caplog):
    page = SimpleNamespace(file=SimpleNamespace(src_path="page.md"))
    with caplog.at_level(logging.WARNING):
        made = hook("formulas").on_page_content(rf'<p><span class="arithmatex">\({tex}\)</span></p>', page)
    assert ("<math" in made and "ℋ" in made) or not understood
    assert bool(caplog.records) is not understood


def test_a_page_that_loads_from_elsewhere_is_a_warning(caplog):
    page = SimpleNamespace(file=SimpleNamespace(src_path="page.md"), url="page.html")
    with caplog.at_level(logging.WARNING):
        hook("no_network").on_post_page('<script src="https://unpkg.com/iframe-worker/shim">', page)
        assert not caplog.records
        hook("no_network").on_post_page('<img src="https://example.org/a.png">', page)
    assert len(caplog.records) == 1
