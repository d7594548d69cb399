"""The page in a real Chromium, by clicks and keys alone; the files are those that the printed commands write."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from app_page import clicks_counted, from_movie_to_interval, pull
from run_files import assert_same_results, command

ROOT = Path(__file__).resolve().parents[2]
MOVIE = ROOT.parent / "shared" / "data" / "PAstiff_xy002.mp4"
LOOK = (ROOT / "tests" / "browser" / "look.js").read_text(encoding="utf-8")
LONG = 240_000  # ms: a command of a step
pytestmark = pytest.mark.slow


@pytest.fixture
def visit(browser, serve):
    """``visit(folder)``: a page on a server of its own; a complaint of the browser fails the test."""
    contexts, complaints = [], []

    def opened(server, width=1280, prepare=lambda page: None):
        contexts.append(browser.new_context(viewport={"width": width, "height": 900}))
        page = contexts[-1].new_page()
        prepare(page)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: complaints.append(r.url) if "127.0.0.1" not in r.url[:30] else None)
        page.goto(f"http://127.0.0.1:{server.port}{server.secret}")
        until(page, "state !== null")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert [words for words in complaints if not words.startswith(("data:", "blob:"))] == []


def until(page, expression):
    """Wait until an expression of JavaScript is true; Playwright's own way is what the page's policy forbids."""
    for _ in range(LONG // 100):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{expression} is never true; the page says: {page.inner_text('#message')}")


def done(page, step, ended="done"):
    """Click a step and wait for its end; the words of its command."""
    page.click(f"button[data-step={step}]")
    box = {"prior": "validate", "resume": "run", "export": "compare"}.get(step, step)
    page.wait_for_selector(f"#job-{box}.running", timeout=LONG)
    page.wait_for_selector(f"#job-{box}.{ended}", timeout=LONG)
    return words_of(page, box)


def words_of(page, box):
    """The words of the command that a box of the page prints."""
    return shlex.split(re.search(r"^\$ en4dvar (.*)$", page.inner_text(f"#job-{box} pre"), re.M)[1])


def point_of(page, frame):
    """Where the reading of a frame is on the canvas of R(t)."""
    point = page.evaluate(f"document.getElementById('history').points.find((p) => p.frame === {frame})")
    return {"x": point["left"], "y": point["top"]}


def repeat(folder, *commands):
    for words in commands:
        subprocess.run(command(*words), cwd=folder, check=True, capture_output=True)


@pytest.fixture
def german(tmp_path):
    """A folder with a table as a German spreadsheet writes it."""
    lines = (ROOT / "configs" / "data" / "agarose_synthetic.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if not line.startswith("#")][1:]
    folder = tmp_path / "tables"
    folder.mkdir()
    text = "Zeit;Radius\n" + "".join(f"{t};{r}\n".replace(".", ",") for t, r in rows)
    (folder / "messung.csv").write_text(text, encoding="utf-8")
    return folder


def proposed(page, table, **fields):
    """Choose columns and units of a table, and propose a model."""
    page.select_option("#table", table)
    for key, value in fields.items():
        select = key.endswith("column")
        (page.select_option if select else page.fill)(f"#{key.replace('_', '-')}", value)
    words = done(page, "init")
    until(page, "document.getElementById('text').value !== ''")
    return words


def test_a_german_table_to_an_interval(visit, serve, german, tmp_path):
    server = serve(german)
    page = visit(server)
    page.select_option("#table", "messung.csv")
    until(page, "document.getElementById('about-table').innerText.includes('decimal commas')")
    units = {"time_column": "Zeit", "radius_column": "Radius", "time_unit": "us", "radius_unit": "um"}
    commands = [proposed(page, "messung.csv", **units)]
    text = page.input_value("#text")
    page.fill("#text", text.replace("members: 48", "members: many"))
    done(page, "validate", "failed")
    page.click("#faults button")
    start, end = page.evaluate("[text.selectionStart, text.selectionEnd]")
    assert page.input_value("#text")[start:end].strip() == "members: many"
    page.fill("#text", text.replace("gas: heat", "gas: polytropic"))
    done(page, "prior")
    until(page, "document.querySelector('#job-validate img').naturalWidth > 300")
    commands.append(done(page, "run"))
    with page.context.expect_page() as opened:
        page.click("#job-run a")
    opened.value.wait_for_load_state()
    assert opened.value.title().endswith("– en4dvar")
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(german / "messung.csv", other)
    repeat(other, commands[0])
    assert (other / "messung.yaml").read_text(encoding="utf-8") == text
    shutil.copy(german / "messung.yaml", other)
    repeat(other, commands[1])
    assert_same_results(german / "runs" / "messung", other / "runs" / "messung")


def test_cancelled_and_resumed_after_the_window_and_the_server_are_gone(visit, serve, german, tmp_path):
    server = serve(german)
    page = visit(server)
    units = {"time_column": "Zeit", "radius_column": "Radius", "time_unit": "us", "radius_unit": "um"}
    proposed(page, "messung.csv", **units)
    page.click("button[data-step=run]")
    until(page, "document.getElementById('log').innerText.includes('iteration')")
    page.click("#cancel")
    page.wait_for_selector("#job-run.stopped", timeout=LONG)
    page.fill("#run", "messung")
    page.click("button[data-step=resume]")
    page.wait_for_selector("#job-run.running", timeout=LONG)
    page.close()
    server.end()
    page = visit(serve(german))
    page.wait_for_selector("#job-run.done", timeout=LONG)
    shutil.copytree(german, tmp_path / "other", ignore=shutil.ignore_patterns("runs", ".*"))
    repeat(tmp_path / "other", ["run", "messung.yaml", "--out=runs/messung"])
    assert_same_results(german / "runs" / "messung", tmp_path / "other" / "runs" / "messung")


def test_a_campaign_compared_and_written(visit, serve, german):
    (german / "gels").mkdir()
    for name in ("a", "b"):
        shutil.copy(german / "messung.csv", german / "gels" / f"{name}.csv")
    page = visit(serve(german))
    proposed(page, "gels", time_column="Zeit", radius_column="Radius", time_unit="us", radius_unit="um")
    text = page.input_value("#text").replace("gas: heat", "gas: polytropic")
    page.fill("#text", text)
    done(page, "run")
    told = page.inner_text("#job-run pre")
    assert re.search(r"^a +G ", told, re.M), told
    assert re.search(r"^b +G ", told, re.M)
    page.fill("#run", "again")
    done(page, "run")
    for box in page.query_selector_all("#runs input"):
        box.check()
    done(page, "compare")
    page.wait_for_selector("#pages a")
    done(page, "export")
    assert (german / "again_results.csv").is_file()


@pytest.fixture
def two_bubbles(tmp_path):
    """A folder with a movie of two bubbles side by side, and their centres (2, 2)."""
    tifffile = pytest.importorskip("tifffile")
    from nasty_movies import film

    filmed = film("side by side, pointed at", 0)
    tifffile.imwrite(tmp_path / "two.tif", np.array(filmed.frames))
    return tmp_path, np.nanmedian(filmed.centre, axis=1)


def at(page, x, y):
    """Where a place in the frame, pixels, is on the canvas."""
    box = page.evaluate("(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(frame)")
    return {"x": x * box[0] / page.evaluate("movie.width"), "y": y * box[1] / page.evaluate("movie.height")}


def test_of_two_bubbles_the_clicked_one_is_read(visit, serve, two_bubbles):
    folder, centres = two_bubbles
    page = visit(serve(folder))
    until(page, "!!movie?.picture")
    page.fill("#pixel", "1 um")
    page.fill("#frame-rate", "100 kHz")
    for n, centre in enumerate(centres):
        page.check("input[value=bubble]")
        page.click("#frame", position=at(page, *centre))
        words = done(page, "track")
        assert ("--force" in words) == bool(n)
        until(page, "movie.readings !== null")
        place = page.evaluate(
            "movie.readings.rows.filter((r) => r.x_um).map((r) => [r.x_um, r.y_um, movie.readings.pixel])"
        )
        x, y, pixel = np.median(place, axis=0)
        assert np.hypot(*(np.array([x, y]) / pixel - centre)) < 5


def test_corrections_are_those_of_the_file_in_every_window(visit, serve, two_bubbles):
    folder, _ = two_bubbles
    file = folder / "two.corrections.txt"
    file.write_text("3 out  blurred\n# mine\n")
    server = serve(folder)
    page, other = visit(server), visit(server)
    for each in (page, other):
        until(each, "!!movie?.picture")
        assert each.input_value("#corrections") == file.read_text()
    page.focus("#frame")
    for key in ("ArrowRight", "Shift+ArrowRight", "ArrowLeft", "o"):
        page.keyboard.press(key)
    until(page, "kept.includes('10 out')")
    assert file.read_text() == "3 out  blurred\n# mine\n10 out\n"
    page.keyboard.press("k")
    until(page, "kept.includes('10 ok')")
    page.mouse.wheel(0, 0)
    page.keyboard.press("ArrowRight")
    pull(page, (40, 50), (60, 50))
    until(page, "/^11 [\\d. ]+$/m.test(kept)")
    x, y, radius = map(float, file.read_text().splitlines()[-1].split()[1:])
    assert np.allclose([x, y, radius], [39.5, 49.5, 20], atol=0.6)
    page.keyboard.press("Delete")
    until(page, "!kept.includes('11 ')")
    before = file.read_text()
    other.fill("#corrections", "4 out\n")
    other.press("#corrections", "Tab")
    until(other, "message.innerText.includes('another window or program has changed it')")
    assert file.read_text() == before
    other.reload()
    until(other, "corrections.value.includes('10 ok')")


def test_the_public_movie_to_an_interval(visit, serve, tmp_path):
    if not MOVIE.is_file():
        pytest.skip(f"{MOVIE} is not there")
    folder, other = tmp_path / "movies", tmp_path / "other"
    for each in (folder, other):
        each.mkdir()
        shutil.copy(MOVIE, each / "gel.mp4")
    server = serve(folder)
    page = visit(server, prepare=clicks_counted)
    from_movie_to_interval(page, lambda expression: until(page, expression))
    page.click("#history", position=point_of(page, 40))
    until(page, "at === 40")
    assert int(page.evaluate("name")) <= 12
    value, unit = page.input_value("#pixel").split()
    assert unit == "um"
    assert float(value) == pytest.approx(2.76, rel=0.01)
    correction = (folder / "gel.corrections.txt").read_text().split()
    assert np.allclose(np.array(correction, float), [28, 270.5, 67.5, 16], atol=0.6)
    fields = page.inner_text("#job-run pre").split(" G ")[1].split()
    low, high = float(fields[3]), float(fields[5])
    assert fields[0] == "kPa"
    assert low < 7.7 < high  # Estrada et al. 2018, the same gel
    commands = [words_of(page, step) for step in ("track", "init")]
    assert "--corrections=gel.corrections.txt" in commands[0]
    shutil.copy(folder / "gel.corrections.txt", other)
    repeat(other, *commands)
    for name in ("gel.csv", "gel.yaml"):
        assert (folder / name).read_bytes() == (other / name).read_bytes()
    page.fill("#exposure", "500 ns")
    page.press("#exposure", "Tab")
    page.reload()
    until(page, "!!movie?.picture")
    new = visit(server)
    until(new, "!!movie?.picture")
    for each, exposure in ((page, "500 ns"), (new, "")):
        fields = [each.input_value(field) for field in ("#pixel", "#frame-rate", "#exposure")]
        assert fields == [f"{value} um", "270 kHz", exposure]


@pytest.mark.parametrize("width", [1280, 1920, 400])
def test_everything_has_a_name_and_can_be_read(visit, serve, two_bubbles, width):
    page = visit(serve(two_bubbles[0]), width)
    until(page, "!!movie?.picture")
    page.evaluate(LOOK)
    faint = page.evaluate("window.look.faint()")
    assert faint["seen"] > 40
    assert faint["found"] == []
    assert page.evaluate("window.look.unnamed()") == []
    wide = page.evaluate("window.look.wide()")
    assert wide["scroll"] <= wide["width"]
    nameless = """[...document.querySelectorAll("input, select, textarea, button")].filter(
        (e) => e.getClientRects().length && !e.labels?.length && !e.getAttribute("aria-label") && !e.innerText.trim()
    ).map((e) => e.id)"""
    assert page.evaluate(nameless) == []
    for landmark in ("main", "h1", "html[lang=en]"):
        assert page.locator(landmark).count() == 1
