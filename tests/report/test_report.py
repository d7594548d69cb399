"""The report of a run directory: one HTML file that needs no network and escapes what it is given, figures, a table."""

from __future__ import annotations

import base64
import csv
import hashlib
import re
import shutil
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from itertools import islice
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image
from run_files import add_to_pack

from en4dvar import report
from en4dvar.diagnosis.diagnostics import chi2_interval, member_quantiles
from en4dvar.estimation.summary import ParameterSummary
from en4dvar.executor import SerialExecutor, WorkerLostError
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import OutputError
from en4dvar.priors.prior import Prior
from en4dvar.report import write_pages
from en4dvar.report.figures import FIGURES, all_figures, pairs, traces
from en4dvar.report.history import history
from en4dvar.report.html import render
from en4dvar.report.page import LISTED, SetSummary, judge_chi2, overview_figures, render_overview
from en4dvar.report.result import Result, load_result
from en4dvar.report.svg import draw
from en4dvar.results.pack import PACK
from en4dvar.results.provenance import provenance

VOID = {"meta", "link", "br", "img", "path", "use"}


@pytest.fixture
def write_run(tmp_path):
    def write(analysis, config="name: test\n", file="posterior.nc"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        Result.from_analysis(analysis, provenance(config)).save(tmp_path / file)
        return tmp_path

    return write


@pytest.fixture
def run_dir(write_run, analysis):
    return write_run(analysis)


@pytest.fixture(scope="module")
def names(analysis):
    """Of the figures of its page."""
    result = Result.from_analysis(analysis, provenance("name: test\n"))
    return [name for name, _, there, _ in FIGURES if there(result)]


@pytest.fixture(scope="module")
def reported(analysis, tmp_path_factory):
    """A run directory with its report, to be read only."""
    folder = tmp_path_factory.mktemp("run")
    Result.from_analysis(analysis, provenance("name: test\n")).save(folder / "posterior.nc")
    write_pages(folder, files=True)
    return folder


@pytest.fixture(scope="module")
def html(reported):
    return (reported / "report.html").read_text(encoding="utf-8")


class Page(HTMLParser):
    """Collects what can go wrong in a page: unbalanced tags, repeated or dangling identifiers; and its addresses."""

    def __init__(self, html):
        super().__init__()
        self.open, self.ids, self.targets, self.faults, self.tags, self.text = [], [], [], [], [], []
        self.links = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            if key in ("href", "src") and value.startswith("#"):
                self.targets.append(value[1:])
            elif key in ("href", "src") and not value.startswith("data:"):
                self.links.append(value)
            self.targets += re.findall(r"url\(#([^)]+)\)", value or "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag not in VOID and (not self.open or self.open.pop() != tag):
            self.faults.append(f"</{tag}> closes something else")

    def handle_data(self, data):
        self.text.append(data)


def test_page_is_well_formed_and_self_contained(html, names):
    page = Page(html)
    assert page.faults == []
    assert page.links == []
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert set(page.targets) <= set(page.ids)
    assert page.tags.count("svg") == len(names)
    assert page.tags.count("script") == 1  # that of charts and tables
    assert not re.search(r"(?:https?:)?//[\w.-]+\.\w", html)
    assert "prefers-color-scheme: dark" in html


def test_a_further_figure_is_on_the_page(write_run, analysis, names, monkeypatch):
    further = ("further", "Traces once more.", lambda result: True, traces)
    monkeypatch.setattr("en4dvar.report.figures.FIGURES", (further, *FIGURES))
    page = Page(write_pages(write_run(analysis)).read_text(encoding="utf-8"))
    assert page.faults == []
    assert page.tags.count("svg") == len(names) + 1
    assert "Traces once more." in "".join(page.text)


def test_page_says_what_was_estimated_and_how_well(html):
    result_text = " ".join("".join(Page(html).text).split())
    for phrase in (
        "2.80", "kPa", "Pa·s", "µm", "determined by the data", "not narrowed by the data", "collapse too violent",
        "step norm below 1e-3", "23 of 24", "far-field pressure", "101.325", "name: test",
    ):  # fmt: skip
        assert phrase in result_text, phrase


def test_settings_are_written_as_in_a_configuration(html):
    assert "<td>what if</td><td>true</td>" in html
    assert "<td>localisation</td><td>null</td>" in html  # not as Python writes them


def test_colours_follow_the_scheme(html):
    drawings = re.findall(r"<svg.*?</svg>", html, flags=re.S)
    assert all("var(--ink)" in drawing for drawing in drawings)
    literal = {colour for drawing in drawings for colour in re.findall(r"#[0-9a-f]{6}\b", drawing)}
    assert literal == set(), "a colour that stays the same in the dark scheme"


def with_parameters(analysis, *parameters):
    """The analysis as if its parameters were these."""
    terms = tuple(replace(t, parameter=p) for t, p in zip(analysis.problem.prior.terms, parameters, strict=False))
    return replace(analysis, problem=replace(analysis.problem, prior=Prior(terms)))


def test_a_warning_has_the_units_of_the_page(write_run, analysis):
    told = replace(analysis, cautions=(caution("misfit", "the reading at 18.2 us of data.path 'a 3 user'"),))
    html = write_pages(write_run(told)).read_text(encoding="utf-8")
    assert "the reading at 18.2 µs of data.path &#39;a 3 user&#39;" in html


def test_a_symbol_that_is_the_label_is_said_once(write_run, analysis):
    first, *others = analysis.parameters
    plain = with_parameters(analysis, replace(first, label="k", symbol="k"), *others)
    html = write_pages(write_run(plain)).read_text(encoding="utf-8")
    assert '<th scope="row"></th>' in html
    assert '<th scope="row">K</th>' not in html
    assert '<span class="quiet">k</span>' not in html


@pytest.mark.slow
def test_strings_of_data_and_configuration_are_escaped(write_run, analysis, renamed):
    evil = "<script>alert(1)</script>"
    bad = replace(analysis, cautions=(Caution(evil, "serious", evil, evil),), stop_reason=evil)
    first, *others = analysis.parameters
    bad = renamed(with_parameters(bad, replace(first, label=evil), *others), evil)
    html = write_pages(write_run(bad, config=f"name: '{evil}'\n")).read_text(encoding="utf-8")
    assert evil not in html
    assert html.count("&lt;script&gt;alert(1)") >= 5
    assert Page(html).tags.count("script") == 1


@pytest.mark.slow
def test_figures_are_drawn_as_pdf_and_png(reported, names):
    for name in names:
        assert (reported / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        with Image.open(reported / "figures" / f"{name}.png") as image:
            assert image.info["dpi"] == pytest.approx((200, 200), abs=0.01)
            pixels = np.asarray(image.convert("RGB"), dtype=float)
        assert pixels.std() > 10, name
        assert np.unique(pixels.reshape(-1, 3), axis=0).shape[0] > 20, name
    assert len(list((reported / "figures").iterdir())) == 2 * len(names)


@pytest.mark.slow
def test_report_is_the_same_every_time(reported):
    files = sorted(p for p in reported.rglob("*") if p.is_file())
    before = [p.read_bytes() for p in files]
    write_pages(reported, files=True)
    assert [p.read_bytes() for p in files] == before
    assert sorted(p for p in reported.rglob("*") if p.is_file()) == files


def test_summary_table(reported, analysis):
    with (reported / "summary.csv").open(encoding="utf-8") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == [p.name for p in analysis.parameters]
    alive = np.delete(analysis.posterior[:, 2], 3) * 1e6
    assert rows["R0"]["unit"] == "um"
    assert float(rows["R0"]["mean"]) == pytest.approx(alive.mean(), rel=1e-12)
    assert float(rows["R0"]["q95"]) == pytest.approx(member_quantiles(alive, 0.95), rel=1e-12)
    assert float(rows["R0"]["dfs"]) == pytest.approx(analysis.dfs_per_parameter[2], rel=1e-12)


@pytest.fixture(scope="module")
def campaign_dir(analysis, renamed, tmp_path_factory):
    """The report of three data sets, one with a name that must be escaped and quoted."""
    folder = tmp_path_factory.mktemp("campaign")
    for name, file in (("one", "one"), ("two", "two"), ("<script>alert('é')</script>", "é 100%")):
        result = Result.from_analysis(renamed(analysis, name), provenance("name: test\n"))
        add_to_pack(folder, file, result)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.report.page.all_figures", first_figure)
        write_pages(folder)
    return folder


def first_figure(result):
    return islice(all_figures(result), 1)


def test_campaign_is_a_table_with_a_page_for_each_data_set(campaign_dir):
    html = (campaign_dir / "report.html").read_text(encoding="utf-8")
    page = Page(html)
    assert page.faults == []
    assert len(page.ids) == len(set(page.ids))
    assert page.tags.count("script") == 1  # that of charts and tables
    assert "<script>alert" not in html
    addresses = {"pages/one.html": "one", "pages/two.html": "two", "pages/%C3%A9%20100%25.html": "alert('é')"}
    assert set(page.links) == set(addresses)
    for address, name in addresses.items():
        own = Page((campaign_dir / unquote(address)).read_text(encoding="utf-8"))
        assert own.faults == []
        assert name in "".join(own.text)
        assert "../report.html" in own.links
        assert all((campaign_dir / "pages" / unquote(link)).is_file() for link in own.links)
    assert not (campaign_dir / "figures").exists()
    assert (campaign_dir / "summary.csv").read_text(encoding="utf-8").count("\n") == 13


def test_the_script_that_runs_is_the_one_the_policy_names(campaign_dir):
    html = (campaign_dir / "report.html").read_text(encoding="utf-8")
    (script,) = re.findall(r"<script>(.*?)</script>", html, flags=re.S)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    assert unescape(policy).startswith("default-src 'none';")
    assert f"script-src 'sha256-{digest}'" in unescape(policy)


@pytest.mark.slow
def test_large_campaign_gets_pages_on_demand(campaign_dir, tmp_path, monkeypatch):
    shutil.copy(campaign_dir / PACK, tmp_path)
    monkeypatch.setattr("en4dvar.report.page.all_figures", first_figure)
    monkeypatch.setattr(report, "PAGES", 1)
    html = write_pages(tmp_path).read_text(encoding="utf-8")
    assert [p.stem for p in (tmp_path / "pages").iterdir()] == ["one"]
    assert "2 data sets have no page of their own" in html
    html = write_pages(tmp_path, ["two"], files=True).read_text(encoding="utf-8")
    assert "1 data set has no page of its own" in html
    assert set(Page(html).links) == {"pages/one.html", "pages/two.html"}
    kept = {f"{name}.{kind}" for name in ("estimates", "two_posterior") for kind in ("pdf", "png")}
    assert {p.name for p in (tmp_path / "figures").iterdir()} == kept
    with pytest.raises(OutputError, match="no data set 'tow'; did you mean 'two'"):
        write_pages(tmp_path, ["tow"])


def test_the_table_has_the_digits_of_the_run(campaign_dir, tmp_path, monkeypatch):
    shutil.copy(campaign_dir / PACK, tmp_path)
    monkeypatch.setattr("en4dvar.report.page.all_figures", first_figure)
    write_pages(tmp_path)
    assert (tmp_path / "summary.csv").read_bytes() == (campaign_dir / "summary.csv").read_bytes()


def contents(run):
    return {p.relative_to(run).as_posix(): p.read_bytes() for p in run.rglob("*.*") if p.is_file()}


@pytest.mark.slow
def test_processes_draw_the_same_pages(campaign_dir, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "SHARE", 1)
    one, two = tmp_path / "one", tmp_path / "two"
    for run in (one, two):  # two data sets are enough
        for name in ("one", "two"):
            add_to_pack(run, name, load_result(campaign_dir / PACK / name))
    write_pages(one)
    monkeypatch.setattr(report, "render_set", None)  # this process draws no page
    write_pages(two, workers=2)
    assert len(list((two / "pages").iterdir())) == 2
    assert contents(one) == contents(two)
    (two / "pages" / "two.html").unlink()
    (two / "pages" / "two.html").mkdir()
    with pytest.raises(OutputError, match=r"two\.html"):
        write_pages(two, workers=2)


def test_the_page_of_a_process_that_dies_is_drawn_here(campaign_dir, tmp_path, monkeypatch):
    class Deadly(SerialExecutor):
        def __init__(self, workers):
            assert workers == 2

        def map(self, function, calls, hear=None):
            return ((i, WorkerLostError("killed") if i == 1 else function(*call)) for i, call in enumerate(calls))

    shutil.copy(campaign_dir / PACK, tmp_path)
    monkeypatch.setattr("en4dvar.report.page.all_figures", first_figure)
    for name, value in {"SHARE": 1, "ProcessesExecutor": Deadly}.items():
        monkeypatch.setattr(report, name, value)
    write_pages(tmp_path, workers=2)
    assert len(list((tmp_path / "pages").iterdir())) == 3


def test_overview_of_many_data_sets_stays_small(analysis):
    one = SetSummary.of(Result.from_analysis(analysis, provenance("name: test\n")), "set")
    sets = [replace(one, name=f"set {i:04d}", stem=f"set_{i:04d}", cautions=()) for i in range(20_000)]
    sets[7_777] = replace(sets[7_777], cautions=one.cautions)
    html = render_overview(sets, pages={}, failures={}, headlines=(), figures=draw(overview_figures(sets)))
    assert len(html.encode()) < 3e6
    assert html.count("<tr>") == LISTED + 1 + 4  # the heading, and the numbers of four parameters
    assert '<th scope="row">set 7777</th>' in html
    assert "Of 20000 data sets the 2000 with the gravest warnings are listed" in html


def test_half_of_the_data_sets_is_half_of_those_to_be_trusted(analysis):
    one = SetSummary.of(Result.from_analysis(analysis, provenance("name: test\n")), "set")
    name, row = next(iter(one.rows.items()))
    rows = [replace(row, mean=value, std=0.1, untrusted=("misfit",) * (value > 5)) for value in (1.0, 2.0, 3.0, 70.0)]
    sets = [replace(one, rows={name: own}) for own in rows]
    html = render_overview(sets, pages={}, failures={}, headlines=(), figures=draw(overview_figures(sets)))
    assert "half of the data sets: 1.50 to 2.50" in html
    assert html.index("posteriors come with") < html.index('<figure id="estimates"')


@pytest.mark.slow
@pytest.mark.parametrize("survivors", [0, 1])
def test_lost_ensemble_still_gets_a_report(write_run, make_analysis, survivors):
    base = make_analysis()
    n = len(base.posterior)

    def lose(values):
        return np.where(np.arange(n)[:, None] < survivors, values, np.nan)

    dead = replace(
        base,
        posterior=lose(base.posterior),
        posterior_predictions=lose(base.posterior_predictions),
        posterior_trajectories=lose(base.posterior_trajectories),
        posterior_failures=tuple("" if i < survivors else "gone" for i in range(n)),
    )
    html = write_pages(write_run(dead)).read_text(encoding="utf-8")
    assert f"{survivors} of {n}" in html
    assert "nan" not in "".join(Page(html).text).split()


def test_single_parameter_has_no_pairs(write_run, analysis, monkeypatch):
    one = replace(
        with_parameters(analysis, analysis.parameters[0]),
        prior=analysis.prior[:, :1],
        posterior=analysis.posterior[:, :1],
        centre=analysis.centre[:1],
        dfs_per_parameter=analysis.dfs_per_parameter[:1],
        modes=(),
        iterations=tuple(replace(r, members=r.members[:, :1], centre=r.centre[:1]) for r in analysis.iterations),
    )
    run_dir = write_run(one)
    two = tuple(figure for figure in FIGURES if figure[0] in ("posterior", "pairs"))
    assert len(two) == 2
    monkeypatch.setattr("en4dvar.report.figures.FIGURES", two)
    write_pages(run_dir, files=True)
    assert not (run_dir / "figures" / "pairs.pdf").exists()
    assert (run_dir / "figures" / "posterior.pdf").exists()


@pytest.mark.parametrize(("chi2", "attention"), [(1.0, False), (1.4, False), (4.0, True), (0.05, True), (np.nan, True)])
def test_chi2_in_words(chi2, attention):
    words, needs_attention = judge_chi2(chi2, 40, 2.0)
    assert needs_attention is attention
    low, high = (f"{value / 40:.2g}" for value in chi2_interval(38.0))
    assert (f"expected are {low} to {high}" in words) is bool(np.isfinite(chi2))


def test_nothing_to_report_is_one_clear_error(tmp_path):
    with pytest.raises(OutputError, match="no such file or directory"):
        write_pages(tmp_path / "absent")
    with pytest.raises(OutputError, match=r"holds no posterior\.nc"):
        write_pages(tmp_path)


def test_a_page_says_what_the_file_lacks():
    """Which whoever reads the file tells with its name; anybody can write a file with a good seal."""
    with pytest.raises(LookupError, match="no attribute 'members'"):
        render(
            "cycles.html.j2",
            attributes={"name": "a", "scheme": "b"},
            kind="",
            what="",
            copies=False,
            cycle="",
            iterations=1,
        )


def test_unwritable_run_directory_is_one_clear_error(run_dir):
    (run_dir / "figures").write_text("in the way")
    with pytest.raises(OutputError, match="figures: cannot be created"):
        write_pages(run_dir, files=True)


def test_no_band_of_a_positive_quantity_is_negative(analysis):
    result = Result.from_analysis(analysis, {})

    def changed(path, name, values):
        group = result.groups[path]
        variables = {**group.variables, name: replace(group[name], values=values)}
        return Result({**result.groups, path: replace(group, variables=variables)})

    spread = np.random.default_rng(1).lognormal(sigma=3, size=result.iterations["G"].shape)
    (band,) = (
        mark for mark in traces(changed("/iterations", "G", spread)).rows[0].panels[0].marks if mark.kind == "band"
    )
    assert (spread.mean(axis=1) < spread.std(axis=1)).all()
    assert band.y.min() > 0
    readings = result.observed_data["R"].values
    low = changed("/observed_data", "R", readings - 0.99 * readings.min())
    assert history(low).rows[0].panels[0].ylim[0] == 0


def test_a_pair_of_parameters_shows_its_correlation_by_its_colour(analysis):
    """Half of the figure was empty but for numbers."""
    result = Result.from_analysis(analysis, {})
    rows = pairs(result).rows
    first, second = (result.members("posterior", row.name) for row in result.rows[:2])
    shown = rows[0].panels[1]
    correlation = float(np.corrcoef(first, second)[0, 1])
    (mark,) = shown.marks
    assert mark.kind == "span"
    assert mark.colour == ("centre" if correlation < 0 else "posterior")
    assert mark.alpha == pytest.approx(0.6 * abs(correlation))
    assert shown.words == f"{correlation:+.2f}".replace("-", "−")
    ((_, _, svg),) = draw([("pairs", "", pairs(result))])
    count = len(result.rows) * (len(result.rows) - 1) // 2
    assert len(re.findall(r'<path d="M[^"]*z"[^>]*opacity="0\.\d+"[^>]*/></g><text', svg)) == count


def test_one_of_a_thing_is_not_called_several(analysis):
    sets = [SetSummary.of(Result.from_analysis(replace(analysis, cautions=()), {}), "a")]
    page = render_overview(sets, pages={}, failures={"b": "no readings"}, headlines=(), figures=())
    for words in ("<h1>1 data set</h1>", "1 data set without a posterior", "No warnings in any of 1 posterior."):
        assert words in page
    assert "The median of the data sets" in page
    fields = render_overview([replace(sets[0], rows={})], pages={}, failures={}, figures=())
    assert "The median of the data sets" not in fields  # which are of no parameter


def test_the_mean_of_a_prior_about_zero_is_zero_and_no_rounding(analysis):
    """A summary said that the prior mean of t_s is 3.47e-18."""
    p = analysis.parameters[0]
    members = np.array([-0.3, -0.1, 0.1, 0.3]) + 3.47e-18
    assert members.mean() != 0
    assert ParameterSummary.of(p, members, members + 1.0, 1.0, 0.5, ()).prior_mean == 0
    assert ParameterSummary.of(p, members + 1e-9, members, 1.0, 0.5, ()).prior_mean == pytest.approx(1e-9)


def test_a_page_that_is_shared_names_no_folder_of_the_machine(write_run, analysis):
    readings = replace(analysis.observations, source="/home/jane/secret gel/bubble_1.csv")
    page = write_pages(write_run(replace(analysis, problem=replace(analysis.problem, observations=readings))))
    text = page.read_text(encoding="utf-8")
    assert "<td>…/bubble_1.csv</td>" in text
    assert "jane" not in text
