"""What a reader meets: pages open from a folder, ask for nothing, and can be read in the dark, on a phone, on paper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from en4dvar.report.figures import all_figures
from en4dvar.report.page import LISTED, SetSummary, overview_figures, render_overview
from en4dvar.report.svg import draw
from en4dvar.results.pack import PACK
from en4dvar.results.store import load_stored

pytestmark = pytest.mark.slow  # a browser takes half a minute of the processor
LOOK = (Path(__file__).parent / "look.js").read_text(encoding="utf-8")
KINDS = ("single", "campaign", "set", "compare")
FIGURES = {"campaign": 1, "set": 2, "compare": 1}


def look(seen, question):
    seen.page.evaluate(LOOK)
    return seen.page.evaluate(f"window.look.{question}()")


@pytest.mark.parametrize("kind", KINDS)
def test_opens_without_a_complaint_and_asks_for_nothing(opened, pages, kind):
    seen = opened(pages[kind])
    assert seen.page.title().endswith("– en4dvar")
    count = FIGURES.get(kind) or len([*all_figures(load_stored(pages[kind].parent / "posterior.nc"))])
    assert look(seen, "drawings") == [True] * count
    assert seen.complaints == []
    assert seen.requests == [pages[kind].as_uri()]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", KINDS)
def test_contrast_is_adequate(opened, pages, kind, scheme):
    seen = opened(pages[kind], scheme=scheme)
    faint = look(seen, "faint")
    assert faint["seen"] > 50
    assert faint["found"] == []
    dark = seen.page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark is (scheme == "dark")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [360, 700, 960])
def test_fits_a_phone_and_a_narrow_window(opened, pages, kind, width):
    page = opened(pages[kind], width=width).page
    for row in page.locator("table.lead td:last-child").all():
        row.evaluate("e => (e.textContent = 'determined by the data, and partly by its prior')")
    page.evaluate(LOOK)
    wide = page.evaluate("window.look.wide()")
    assert wide["scroll"] <= wide["width"] == width


@pytest.mark.parametrize("kind", KINDS)
def test_a_screen_reader_is_told_what_everything_is(opened, pages, kind):
    seen = opened(pages[kind])
    assert look(seen, "unnamed") == []
    for landmark in ("main", "h1", "html[lang=en]"):
        assert seen.page.locator(landmark).count() == 1


def test_a_fit_is_told_on_three_screens_before_anything_is_unfolded(opened, pages):
    """It took 5 600 pixels, of which the fit itself was the last 2 200."""
    page = opened(pages["single"], width=1280).page
    assert page.evaluate("document.querySelector('#d0-history').getBoundingClientRect().bottom") < 1600
    assert page.evaluate("document.documentElement.scrollHeight") < 2800


def test_the_table_of_data_sets_names_its_rows_and_can_be_skipped_by_key(opened, pages):
    page = opened(pages["campaign"]).page
    assert page.locator("table.sets").get_by_role("rowheader").count() == 3
    link = page.get_by_role("link", name="Skip the table")
    while not link.evaluate("e => e === document.activeElement"):
        page.keyboard.press("Tab")
    assert link.bounding_box()["height"] > 10  # it can be seen where it is
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('table')") is None


def test_a_page_of_20000_data_sets_is_as_small_as_one_of_2000(opened, pages, tmp_path):
    """What a browser has to lay out does not grow; the first paint of such a page took 0.3 s."""
    one = SetSummary.of(load_stored(pages["campaign"].parent / PACK / "a"), "a")
    sets = [replace(one, name=f"set{i}", stem=f"set{i}") for i in range(20_000)]
    path = tmp_path / "report.html"
    path.write_text(
        render_overview(sets, pages={}, failures={}, headlines=(), figures=draw(overview_figures(sets))),
        encoding="utf-8",
    )
    seen = opened(path)
    assert seen.complaints == []
    assert seen.page.locator("table.sets tbody tr").count() == LISTED
    assert seen.page.locator("*").count() < 50_000
    assert path.stat().st_size < 5e6


def column(page, i):
    return page.locator("table.sets tbody tr").evaluate_all(f"rows => rows.map(r => r.cells[{i}].textContent.trim())")


def test_the_table_of_a_campaign_of_five_parameters_fits_a_screen(opened, pages):
    script = """() => {
      const table = document.querySelector("table.campaign");
      for (const row of table.rows) {
        const cell = row.cells[2];
        for (let i = row.cells.length; i < 12; i++) cell.after(cell.cloneNode(true));
        row.cells[0].textContent = "bubble_17";
        const told = ["0.53 ± 0.12", "0.0317 ± 0.0075", "0.0991 ± 0.0048", "0.51 ± 0.12", "−0.011 ± 0.012"];
        if (cell.tagName === "TD") told.forEach((words, i) => { row.cells[i + 2].textContent = words; });
      }
      return [table.rows[1].cells.length, table.parentElement.scrollWidth - table.parentElement.clientWidth];
    }"""
    assert opened(pages["campaign"], width=1200).page.evaluate(script) == [12, 0]


def test_the_table_of_a_campaign_of_twelve_parameters_fits_a_screen(opened, pages, tmp_path):
    """Those that ``init`` proposes for a bubble; mean and spread stand below each other, and ± with the spread."""
    one = SetSummary.of(load_stored(pages["campaign"].parent / PACK / "a"), "a")
    row = next(iter(one.rows.values()))
    numbers = {
        "kPa": (2.6, 1.2), "Pa s": (0.0156, 0.0097), "um": (20.4, 1.1), "nm": (238.8, 1.5), "kg/m^3": (1029, 18),
        "m/s": (1525, 20), "MPa": (101.26, 0.94), "us": (0.64, 0.22), "1": (0.416, 0.097), "K": (0.9992, 0.0047),
        "mm": (1.46, 0.52), "ms": (4.9, 1.4),
    }  # fmt: skip
    rows = [replace(row, name=unit, mean=mean, std=std, unit=unit) for unit, (mean, std) in numbers.items()]
    sets = [replace(one, name=f"PolyAcry_12_4{i}", rows={row.name: row for row in rows}) for i in range(3)]
    path = tmp_path / "report.html"
    path.write_text(render_overview(sets, pages={}, failures={}, headlines=(), figures=[]), encoding="utf-8")
    page = opened(path, width=1200).page
    scroll = page.locator("table.campaign").locator("..")
    needed, there = scroll.evaluate("e => [e.scrollWidth, e.clientWidth]")
    assert needed <= there
    assert "± " not in page.locator("table.campaign tbody").inner_text()


@pytest.mark.parametrize("width", [360, 700, 960, 1100, 1200])
def test_the_table_of_parameters_fits_a_screen_with_long_values(opened, pages, width):
    script = """() => {
      for (const fold of document.querySelectorAll("details")) fold.open = true;
      const table = document.querySelector("table.parameters");
      for (const cell of table.querySelectorAll("td[data-label]"))
        cell.textContent = cell.classList.contains("words") ? "determined by the data" : "−0.10852";
      return [table.parentElement.scrollWidth, table.parentElement.clientWidth];
    }"""
    needed, there = opened(pages["single"], width=width).page.evaluate(script)
    assert 0 < needed <= there


def test_a_comparison_fits_a_screen_with_what_is_not_to_be_trusted(opened, pages):
    script = """() => {
      for (const row of document.querySelector("table.sets").tBodies[0].rows) {
        row.cells[0].textContent = "R_max maximum radius, where the bubble is released";
        row.cells[3].innerHTML = "<b>0.0419, not to be trusted</b>";
        row.cells[row.cells.length - 1].textContent = "not to be trusted: model-validity, gas-content";
      }
      return [...document.querySelectorAll(".scroll")].map((e) => e.scrollWidth - e.clientWidth);
    }"""
    assert max(opened(pages["compare"], width=1200).page.evaluate(script)) <= 0


def test_table_sorts_by_click_and_by_key(opened, pages):
    page = opened(pages["campaign"]).page
    names = column(page, 0)
    assert [name[:5] for name in names] == ["alpha", "beta", "<scri"]
    head = page.locator("table.sets th").nth(2)
    assert head.inner_text().startswith("G")
    head.get_by_role("button").click()
    values = [float(text.split()[0].rstrip(",")) for text in column(page, 2)]
    assert values == sorted(values)
    assert len(set(values)) == 3
    assert head.get_attribute("aria-sort") == "ascending"
    head.get_by_role("button").press("Enter")
    assert [float(text.split()[0].rstrip(",")) for text in column(page, 2)] == values[::-1]
    assert head.get_attribute("aria-sort") == "descending"
    page.locator("table.sets th").nth(0).get_by_role("button").click()
    assert column(page, 0) == ["<scri" + names[2][5:], "alpha", "beta"]
    assert head.get_attribute("aria-sort") is None
    page.locator("table.sets th").nth(1).get_by_role("button").click()
    assert column(page, 1) == ["", "serious", "serious"]


def test_a_legend_switches_its_marks_by_click_and_by_key(opened, pages):
    page = opened(pages["single"]).page
    entry = page.locator('.entry[data-label="posterior 90 %"]')
    band = page.locator('g[clip-path] path[data-label="posterior 90 %"]')
    assert entry.get_attribute("aria-pressed") == "true"
    entry.click()
    assert (band.is_visible(), entry.get_attribute("aria-pressed")) == (False, "false")
    entry.press("Enter")
    assert (band.is_visible(), entry.get_attribute("aria-pressed")) == (True, "true")
    assert page.get_by_role("button", name="posterior 90 %").count() == 1


def test_a_panel_says_where_the_pointer_is(opened, pages):
    page = opened(pages["single"]).page
    panel = page.locator("#d0-history rect.read").first
    (low, high), (bottom, top) = (map(float, panel.get_attribute(f"data-{axis}").split()) for axis in "xy")
    panel.hover()  # its middle
    across, up = page.locator("#d0-history .reading").text_content().replace("−", "-").split(", ")
    assert float(across) == pytest.approx((low + high) / 2, abs=0.01 * (high - low))
    assert float(up) == pytest.approx((bottom + top) / 2, abs=0.01 * (top - bottom))


def test_bars_of_shares_begin_below_each_other(opened, pages):
    page = opened(pages["set"].with_name("b.html")).page  # without a warning
    lefts = """() => {
      for (const fold of document.querySelectorAll("details")) fold.open = true;
      const rows = [...document.querySelectorAll("table.parameters .percent")];
      rows.forEach((each, i) => { each.textContent = ["7 %", "−29 %", "100 %"][i % 3]; });
      return rows.map((each) => Math.round(each.previousElementSibling.getBoundingClientRect().left));
    }"""
    found = page.evaluate(lefts)
    assert len(found) > 2
    assert len(set(found)) == 1


def test_data_sets_are_reached_and_left_by_links(opened, pages):
    page = opened(pages["campaign"]).page
    page.get_by_role("link", name="alpha").click()
    assert page.locator("h1").inner_text() == "alpha"
    page.get_by_role("link", name="→").click()
    assert page.locator("h1").inner_text() == "beta"
    page.get_by_role("link", name="All data sets").click()
    assert page.locator("h1").inner_text() == "3 data sets"


@pytest.mark.parametrize("kind", KINDS)
def test_what_came_from_data_does_not_run(opened, pages, kind):
    seen = opened(pages[kind])
    assert seen.page.evaluate("typeof window.hacked") == "undefined"
    if kind != "compare":
        assert "window.hacked" in seen.page.locator("body").inner_text()


@pytest.mark.parametrize("kind", KINDS)
def test_what_escaping_might_miss_would_not_run(opened, pages, kind):
    """The content policy of the page refuses a script of another's and an address."""
    seen = opened(pages[kind])
    seen.page.evaluate(
        "() => { const s = document.createElement('script'); s.textContent = 'window.hacked = 3';"
        " document.body.append(s); const i = new Image(); i.src = 'http://example.org/a.png'; }"
    )
    assert seen.page.evaluate("typeof window.hacked") == "undefined"
    assert len([c for c in seen.complaints if "Content Security Policy" in c]) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_prints_in_full(opened, pages, kind):
    seen = opened(pages[kind], scheme="dark")
    seen.page.emulate_media(media="print", color_scheme="dark")
    assert seen.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    for details in seen.page.locator("details").all():
        assert details.locator("> :not(summary)").first.is_visible()
    assert seen.page.pdf(format="A4").startswith(b"%PDF")


@pytest.mark.parametrize("kind", KINDS)
def test_paper_cuts_nothing_off(opened, pages, kind):
    """Long lines of a configuration are broken, and the words of a figure lie within it, names of data sets too."""
    seen = opened(pages[kind], width=680)  # A4 without its margins
    seen.page.emulate_media(media="print")
    seen.page.evaluate("document.querySelectorAll('pre').forEach(e => e.append('# ' + 'word '.repeat(80)))")
    assert look(seen, "cut") == []
