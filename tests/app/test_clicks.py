"""The page in a real Chromium, by clicks and keys alone; the files are those that the printed commands write."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from app_page import clicks_counted, from_movie_to_interval, pull
from clicking import LONG, at, done, point_of, proposed, repeat, require_accessible, until, words_of
from run_files import assert_same_results

ROOT = Path(__file__).resolve().parents[2]
MOVIE = ROOT.parent / "shared" / "data" / "PAstiff_xy002.mp4"
LOOK = (ROOT / "tests" / "browser" / "look.js").read_text(encoding="utf-8")
pytestmark = pytest.mark.slow


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
    page.click("button[data-step=resume]")
    until(page, "message.innerText.includes('choose a configuration first')")
    page.select_option("#start", "laser")
    until(page, "message.innerText === ''")
    units = {"time_column": "Zeit", "radius_column": "Radius", "time_unit": "us", "radius_unit": "um"}
    proposed(page, "messung.csv", **units)
    page.click("button[data-step=run]")
    until(page, "document.getElementById('log').innerText.includes('iteration')")
    until(page, "document.querySelectorAll('#bands svg .read').length > 2")  # a panel a parameter
    page.click("#cancel")
    page.wait_for_selector("#job-run.stopped", timeout=LONG)
    before = (german / "runs" / "messung" / "run.log").read_text(encoding="utf-8")
    assert "converged" not in before
    page.reload()
    until(page, "document.getElementById('run').value === 'messung'")
    page.click("button[data-step=resume]")
    page.wait_for_selector("#job-run.running", timeout=LONG)
    page.close()
    server.end()
    page = visit(serve(german))
    until(page, "document.getElementById('run').value === 'messung'")
    assert page.input_value("#config") == "messung.yaml"
    assert page.input_value("#text") == (german / "messung.yaml").read_text(encoding="utf-8")
    until(page, "document.getElementById('bands').innerText.includes('G (kPa)')")  # from the log, in a new window
    page.wait_for_selector("#job-run.done", timeout=LONG)
    until(page, "document.getElementById('live').hidden")
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
    page.click("button[data-step=run]")
    until(page, "document.querySelectorAll('#sets td').length === 6")
    rows = [row.locator("td").all_text_contents() for row in page.locator("#sets tbody tr").all()]
    assert [row[0] for row in rows] == ["a", "b"]
    page.wait_for_selector("#job-run.done", timeout=LONG)
    told = page.inner_text("#job-run pre")
    assert re.search(r"^a +G ", told, re.M), told
    assert re.search(r"^b +G ", told, re.M)
    until(page, "document.getElementById('live').hidden")
    require_accessible(page)
    page.fill("#run", "again")
    done(page, "run")
    for box in page.query_selector_all("#runs input"):
        box.check()
    done(page, "compare")
    page.wait_for_selector("#pages a")
    done(page, "export")
    assert (german / "again_results.csv").is_file()


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


def test_a_circle_is_moved_and_resized_and_a_scale_bar_drawn(visit, serve, two_bubbles):
    page = visit(serve(two_bubbles[0]))
    until(page, "!!movie?.picture")
    page.focus("#frame")
    for x, y, radius, drag in (
        (39.5, 49.5, 20, ((40, 50), (60, 50))),  # a new one
        (44.5, 46.5, 20, ((42, 51), (47, 48))),  # moved from within
        (44.5, 46.5, 30, ((65, 47), (75, 47))),  # its edge
    ):
        pull(page, *drag)
        until(page, f"Math.abs(circle(at).r - {radius}) < 0.7 && Math.abs(circle(at).x - {x}) < 0.7")
        until(page, "kept.startsWith('0 ')")
        assert page.evaluate("circle(at).y") == pytest.approx(y, abs=0.7)
    page.check("input[value=scale]")
    pull(page, (10, 20), (60, 20))
    until(page, "message.innerText.includes('Type the length')")
    page.fill("#length", "100 um")
    page.press("#length", "Tab")
    value, unit = page.input_value("#pixel").split()
    assert (float(value), unit) == (pytest.approx(2.0, rel=0.02), "um")


def test_a_server_that_is_gone_is_told_and_nothing_is_lost(visit, serve, two_bubbles):
    folder, _ = two_bubbles
    server = serve(folder)
    page = visit(server)
    until(page, "!!movie?.picture")
    page.focus("#frame")
    page.keyboard.press("o")
    until(page, "kept === '0 out\\n'")
    server.end()
    until(page, "message.innerText.includes('The server does not answer. Nothing is lost')")
    page = visit(serve(folder))
    until(page, "document.getElementById('corrections').value === '0 out\\n'")


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
    folder, name = two_bubbles[0], "as_long_as_a_name_may_be" + "_" * 200
    (folder / f"{name}.csv").write_text("t_us,R_um\n0,1\n1,2\n2,3\n")
    (folder / f"{name}.yaml").write_text("name: long\n")
    (folder / "runs" / name).mkdir(parents=True)
    page = visit(serve(folder), width)
    page.select_option("#table", f"{name}.csv")
    page.select_option("#config", f"{name}.yaml")
    until(page, "!!movie?.picture && table !== null && text.value !== ''")
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
    require_accessible(page)
    for landmark in ("main", "h1", "html[lang=en]"):
        assert page.locator(landmark).count() == 1


def test_a_file_that_is_dropped_on_the_page_is_told_where_to_go(visit, serve, german):
    """The browser showed the file in the page's place; of a single table the page said "1 file(s)"."""
    page = visit(serve(german))
    drop = """() => {
      const dataTransfer = new DataTransfer(), how = { dataTransfer, bubbles: true, cancelable: true };
      dataTransfer.items.add(new File(["t_us,R_um"], "mine.csv"));
      return ["dragover", "drop"].map((kind) => !document.body.dispatchEvent(new DragEvent(kind, how)));
    }"""
    assert page.evaluate(drop) == [True, True]  # what the browser would do is prevented
    assert f"put mine.csv into the folder {german}" in page.inner_text("#message")
    (german / "mine.csv").write_text("t_us,R_um\n0,1\n1,2\n2,3\n")
    until(page, "[...$('table').options].some((o) => o.value === 'mine.csv')")
    page.select_option("#table", "mine.csv")
    until(page, "document.getElementById('about-table').innerText.startsWith('mine.csv. Units are those at')")


def test_a_table_in_pixels_and_frames_has_fields_for_both(visit, serve, tmp_path):
    """The page told to add --pixel and --frame-rate, for which it had no fields."""
    rows = (ROOT / "configs" / "data" / "laser_halved.csv").read_text(encoding="utf-8").splitlines()[4:]
    lines = [f"{n},{float(row.split(',')[1]) / 2.5:.2f}\n" for n, row in enumerate(rows)]
    (tmp_path / "film.csv").write_text("frame,R_px\n" + "".join(lines))
    server = serve(tmp_path)
    page = visit(server)
    page.select_option("#table", "film.csv")
    until(page, "table !== null")
    done(page, "init", "failed")
    words = proposed(page, "", table_pixel="2.5 um", table_frame_rate="714 kHz")
    assert words[:4] == ["init", "--data=film.csv", "--time-column=frame", "--radius-column=R_px"]
    assert set(words[4:]) == {"--frame-rate=714 kHz", "--pixel=2.5 um", "--out=film.yaml"}
    assert 'unit: "2.5*um"' in page.input_value("#text")
    page.reload()
    until(page, "table !== null")
    for each in (page, visit(server)):
        each.select_option("#table", "film.csv")
        until(each, "table !== null")
        assert [each.input_value(f"#table-{field}") for field in ("pixel", "frame-rate")] == ["2.5 um", "714 kHz"]
