"""The page by keys alone: from a table to an interval, and a frame of a movie corrected; no mouse is moved."""

from __future__ import annotations

import re

import pytest
from clicking import LONG, until

pytestmark = pytest.mark.slow
MOST = 120  # presses of Tab from anywhere on the page to anywhere


def reach(page, selector):
    """Tab on until an element has the focus, which must then be seen: an outline about it."""
    for _ in range(MOST):
        page.keyboard.press("Tab")
        if page.evaluate(f"document.activeElement.matches({selector!r})"):
            assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
            return
    raise AssertionError(f"no Tab leads to {selector}")


def write(page, selector, words):
    reach(page, selector)
    page.keyboard.press("Control+a")
    page.keyboard.type(words)


def choose(page, selector, value):
    """In a list, by its first letters."""
    reach(page, selector)
    page.keyboard.type(value)
    assert page.evaluate("document.activeElement.value") == value


def press(page, step):
    reach(page, f"button[data-step={step}]")
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#job-{step}.running", timeout=LONG)
    page.wait_for_selector(f"#job-{step}.done", timeout=LONG)


@pytest.fixture
def still(visit, serve):
    """``still(folder)``: a page on which a press of the mouse fails the test."""
    pages = []

    def opened(folder):
        pages.append(visit(serve(folder), prepare=lambda page: page.add_init_script(
            "addEventListener('pointerdown', () => { name = 'a mouse'; }, true)")))  # fmt: skip
        return pages[-1]

    yield opened
    assert [page.evaluate("name") for page in pages] == [""]


def test_a_table_to_an_interval_without_a_mouse(still, german):
    page = still(german)
    choose(page, "#table", "messung.csv")
    until(page, "document.getElementById('about-table').innerText.includes('decimal commas')")
    choose(page, "#time-column", "Zeit")
    write(page, "#time-unit", "us")
    choose(page, "#radius-column", "Radius")
    write(page, "#radius-unit", "um")
    press(page, "init")
    until(page, "document.getElementById('text').value !== ''")
    reach(page, "[aria-label='G: width']")
    page.keyboard.press("Control+a")
    page.keyboard.type("0.9")
    page.keyboard.press("Tab")
    page.wait_for_selector("#job-validate.done", timeout=LONG)
    assert "log_std: 0.9" in (german / "messung.yaml").read_text(encoding="utf-8")
    press(page, "run")
    assert re.search(r"^messung +G +kPa +\S+", page.inner_text("#job-run pre"), re.M)
    reach(page, "#job-run a")
    with page.context.expect_page() as opened:
        page.keyboard.press("Enter")
    opened.value.wait_for_load_state()
    assert opened.value.title().endswith("– en4dvar")


def test_a_movie_is_read_and_corrected_without_a_mouse(still, two_bubbles):
    folder, centres = two_bubbles
    page = still(folder)
    until(page, "!!movie?.picture")
    write(page, "#pixel", "1 um")
    write(page, "#frame-rate", "100 kHz")
    write(page, "#bubble", "{:.0f},{:.0f}".format(*centres[1]))
    reach(page, "input[name=tool]")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.querySelector('input[name=tool]:checked').value") == "bubble"
    reach(page, "#frame")
    for key in ("ArrowRight", "Shift+ArrowRight", "o"):
        page.keyboard.press(key)
    until(page, "kept === '11 out\\n'")
    reach(page, "#number")
    page.keyboard.press("ArrowRight")
    until(page, "at === 12")
    x, y = centres[1]
    for field, value in (("#x", x), ("#y", y), ("#radius", 14)):
        write(page, field, f"{value:.1f}")
    reach(page, "#circle")
    page.keyboard.press("Enter")
    until(page, "kept.includes('12 ')")
    press(page, "track")
    until(page, "movie.readings !== null")
    rows = {row["frame"]: row for row in page.evaluate("movie.readings.rows")}
    assert (rows[11]["used"], rows[11]["R_um"]) == (0, None)
    assert "by hand" in rows[12]["reason"]
    assert abs(rows[12]["x_um"] - x) < 5
