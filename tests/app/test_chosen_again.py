"""What stays of a movie, a table or a text when another is chosen, by clicks in a real Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from clicking import LONG, until

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
TEXT = (CONFIGS / "quickstart.yaml").read_text(encoding="utf-8")
# The quickstart takes 1.3 s from its first intervals to its end, and the page asks once a second: it is held between.
HELD = """import time
from pathlib import Path
from en4dvar_bubble.model import BubbleModel

class Held(BubbleModel):
    'Once the log of the run tells an interval, nothing is computed before the file "asked" is there.'

    def trajectories(self, x, times):
        told = "90 %:" in Path("runs/one/run.log").read_text(encoding="utf-8")
        while told and not Path("asked").exists():
            time.sleep(0.01)
        return super().trajectories(x, times)
"""
pytestmark = pytest.mark.slow


def opened(page, config):
    """Choose a configuration and wait for its text."""
    page.select_option("#config", config)
    until(page, f"document.getElementById('run').value.startsWith('{Path(config).stem}') && text.value !== ''")


def values(page, *fields):
    return [page.input_value(f"#{field}") for field in fields]


@pytest.fixture
def two_movies(tmp_path):
    """A folder with a movie that states its scale, and one that states nothing."""
    tifffile = pytest.importorskip("tifffile")
    frames = np.full((6, 40, 50), 200, dtype=np.uint8)
    stated = {"unit": "um", "finterval": 1e-5}
    tifffile.imwrite(tmp_path / "a.tif", frames, imagej=True, resolution=(0.2, 0.2), metadata=stated)
    tifffile.imwrite(tmp_path / "b.tif", frames)
    return tmp_path


def test_of_another_movie_nothing_stays(visit, serve, two_movies):
    page, fields = visit(serve(two_movies)), ("pixel", "frame-rate", "exposure", "flashes", "bubble", "mask", "length")
    until(page, "movie?.name === 'a.tif'")
    assert values(page, "pixel", "frame-rate") == ["5 um", "100000 Hz"]
    for field in fields[2:]:
        page.fill(f"#{field}", "7")
        page.press(f"#{field}", "Tab")
    page.select_option("#movie", "b.tif")
    until(page, "movie?.name === 'b.tif'")
    assert values(page, *fields) == [""] * len(fields)
    page.fill("#pixel", "2.5 um")
    page.press("#pixel", "Tab")
    page.select_option("#movie", "a.tif")
    until(page, "movie?.name === 'a.tif'")
    assert values(page, *fields) == ["5 um", "100000 Hz", "7", "7", "7", "7", ""]
    page.select_option("#movie", "b.tif")
    until(page, "movie?.name === 'b.tif'")
    assert values(page, *fields) == ["2.5 um", *[""] * (len(fields) - 1)]


def test_a_page_that_is_loaded_again_shows_the_movie_and_the_table_of_before(visit, serve, two_movies):
    for name in ("a", "b"):
        (two_movies / f"{name}.csv").write_text("t,R\n1,1\n2,2\n3,3\n")
    page = visit(serve(two_movies))
    until(page, "movie?.name === 'a.tif'")
    page.select_option("#movie", "b.tif")
    page.select_option("#table", "b.csv")
    until(page, "movie?.name === 'b.tif' && table?.file === 'b.csv'")
    page.reload()
    until(page, "movie?.name === 'b.tif' && table?.file === 'b.csv'")


def test_of_another_table_nothing_stays(visit, serve, german):
    shutil.copy(german / "messung.csv", german / "zwei.csv")
    page, fields = visit(serve(german)), ("time-unit", "radius-unit", "law", "medium", "start", "time-column")
    page.select_option("#table", "messung.csv")
    until(page, "table !== null")
    for field in ("time-unit", "radius-unit", "law", "medium"):
        page.fill(f"#{field}", "ms")
    page.select_option("#start", "laser")
    page.select_option("#time-column", "Zeit")
    page.select_option("#table", "zwei.csv")
    until(page, "table !== null")
    assert values(page, *fields[:5]) == [""] * 5
    page.select_option("#table", "messung.csv")
    until(page, "table !== null")
    assert values(page, *fields) == ["ms", "ms", "ms", "ms", "laser", "Zeit"]


@pytest.mark.parametrize(
    ("what", "shown"),
    [("table", "table?.file"), ("movie", "movie?.name"), ("config", "text.value.match(/: (.*)/)?.[1]")],
)
def test_a_slow_answer_does_not_replace_what_was_chosen_after_it(visit, serve, two_movies, what, shown):
    """The answer about the first is held back until the second is there."""
    names = {"table": ("a.csv", "b.csv"), "movie": ("a.tif", "b.tif"), "config": ("a.yaml", "b.yaml")}[what]
    for name in ("a", "b"):
        (two_movies / f"{name}.csv").write_text(f"t,R\n1,{ord(name)}\n2,2\n3,3\n")
        (two_movies / f"{name}.yaml").write_text(f"name: {name}.yaml\n")
    page, held = visit(serve(two_movies)), []
    until(page, "movie?.name === 'a.tif'")
    page.select_option("#movie", "b.tif")
    until(page, "movie?.name === 'b.tif'")
    page.route(lambda url: "/look/" in url and f"={names[0]}" in url, lambda route: held.append(route))
    page.select_option(f"#{what}", names[0])
    page.wait_for_timeout(300)
    page.select_option(f"#{what}", names[1])
    until(page, f"{shown} === '{names[1]}'")
    assert held
    for route in held:
        route.continue_()
    page.wait_for_timeout(1500)
    assert page.evaluate(shown) == names[1]
    if what == "movie":
        page.focus("#frame")
        page.keyboard.press("o")
        until(page, "kept === '0 out\\n'")
        assert [path.name for path in two_movies.glob("*.corrections.txt")] == ["b.corrections.txt"]


def test_a_mark_that_cannot_be_written_is_not_shown(visit, serve, two_movies):
    (two_movies / "a.corrections.txt").write_text("1 out\n")
    page = visit(serve(two_movies))
    until(page, "!!movie?.picture")
    (two_movies / "a.corrections.txt").unlink()
    (two_movies / "a.corrections.txt").mkdir()
    page.focus("#frame")
    page.keyboard.press("o")
    until(page, "message.innerText !== ''")
    assert page.input_value("#corrections") == "1 out\n"


@pytest.fixture
def two_texts(tmp_path):
    """A folder with two configurations of the same data."""
    (tmp_path / "data").mkdir()
    shutil.copy(CONFIGS / "data" / "agarose_synthetic.csv", tmp_path / "data")
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(TEXT, encoding="utf-8")
    return tmp_path


def test_a_text_that_another_program_changed_is_shown_before_it_is_used(visit, serve, two_texts):
    page, file = visit(serve(two_texts)), two_texts / "one.yaml"
    opened(page, "one.yaml")
    file.write_text(TEXT.replace("0.5 kPa", "90 kPa"))
    page.click("button[data-step=run]")
    until(page, "message.innerText.includes('another window or program has changed the text')")
    assert "median: 90 kPa" in page.input_value("#text")
    assert page.evaluate("state.jobs.length") == 0
    page.fill("#text", TEXT)
    file.write_text(TEXT.replace("0.5 kPa", "80 kPa"))
    page.click("button[data-step=validate]")
    until(page, "message.innerText.includes('load the page again to see it')")
    assert page.input_value("#text") == TEXT
    assert "80 kPa" in file.read_text()
    assert page.evaluate("state.jobs.length") == 0


def test_changes_of_a_text_are_there_again_after_another_was_looked_at(visit, serve, two_texts):
    page, typed = visit(serve(two_texts)), TEXT + "# an hour of typing\n"
    opened(page, "two.yaml")
    page.fill("#text", typed)
    opened(page, "one.yaml")
    assert page.input_value("#text") == TEXT
    opened(page, "two.yaml")
    assert page.input_value("#text") == typed
    assert "are not kept yet" in page.inner_text("#message")
    page.click("#keep")
    until(page, "before === text.value")
    assert (two_texts / "two.yaml").read_text() == typed


def test_a_text_whose_file_is_gone_stays_until_it_is_left(visit, serve, two_texts):
    """The field was empty at the next look at the folder, without a word."""
    page, typed, file = visit(serve(two_texts)), TEXT + "# an hour of typing\n", two_texts / "one.yaml"
    opened(page, "one.yaml")
    page.fill("#text", typed)
    file.unlink()
    until(page, "!state.configs.includes('one.yaml')")
    assert page.input_value("#text") == typed
    page.click("#keep")
    until(page, "message.innerText === 'one.yaml: is not in the folder any more'")
    file.write_text(TEXT)
    page.click("#keep")
    until(page, "before === text.value")
    assert file.read_text() == typed
    file.unlink()
    until(page, "message.innerText === 'one.yaml: is not in the folder any more.'")
    assert page.input_value("#config") == page.input_value("#text") == ""


def test_every_prior_has_its_fields_or_is_told_to_be_in_the_text(visit, serve, tmp_path):
    names = ["combined_acoustic", "combined_laser", "laser_varying", "shell", "shell_heard", "acoustic_design"]
    for name in names:
        shutil.copy(CONFIGS / f"{name}.yaml", tmp_path)
    page = visit(serve(tmp_path))
    for name in names:
        opened(page, f"{name}.yaml")
        own = yaml.safe_load(page.input_value("#text"))["parameters"]
        heads = page.eval_on_selector_all("#priors th[scope=row]", "cells => cells.map((c) => c.innerText)")
        assert heads == [key for key, term in own.items() if "prior" in term], name
        text, priors = (page.locator(part).bounding_box() for part in ("#text", "#priors"))
        assert text["x"] + text["width"] < priors["x"]
        assert page.is_visible("#others") is (name == "acoustic_design")
    opened(page, "shell.yaml")
    page.get_by_label("sigma_0: width", exact=True).fill("2")
    page.keyboard.press("Tab")
    prior = yaml.safe_load(page.input_value("#text"))["parameters"]["sigma_0"]
    assert prior["logit_std"] == 2
    assert len(prior) == 5


def test_a_finished_run_is_told_by_its_result_alone(visit, serve, two_texts):
    (two_texts / "held.py").write_text(HELD, encoding="utf-8")
    (two_texts / "one.yaml").write_text(TEXT.replace("name: bubble", "name: held.py:Held"), encoding="utf-8")
    page = visit(serve(two_texts, "--trust"), 420)
    opened(page, "one.yaml")
    page.click("button[data-step=run]")
    until(page, "document.querySelectorAll('#bands svg .read').length > 0")
    assert "no result yet" in page.inner_text("#live")
    rows = page.eval_on_selector_all("#bands svg .read", "all => new Set(all.map((e) => e.getAttribute('y'))).size")
    assert rows == 3  # of five panels
    until(page, "log.scrollHeight > log.clientHeight")
    assert page.locator("#log").evaluate("(e) => e.scrollHeight - e.clientHeight - e.scrollTop") < 1
    assert page.evaluate("fetch('validate', { method: 'POST', body: '{}' }).then((answer) => answer.status)") == 409
    page.evaluate("post('validate', {})")
    until(page, "message.innerText.startsWith('another command is running')")
    (two_texts / "asked").touch()
    page.wait_for_selector("#job-run.done", timeout=LONG)
    until(page, "message.innerText === ''")
    assert not page.is_visible("#live")
    box = page.locator("#job-run pre").evaluate("(e) => [e.scrollTop + e.clientHeight, e.scrollHeight]")
    assert box[0] >= box[1] - 1
    assert " open the result" in page.inner_text("#runs")
    for part in ("#text", "#priors"):
        inner, outer = (page.locator(at).bounding_box() for at in (part, "#model"))
        assert inner["x"] + inner["width"] <= outer["x"] + outer["width"]
