"""Regions, workbooks and several bubbles in one file, by clicks in a real Chromium."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from app_page import pull
from clicking import done, proposed, repeat, until
from PIL import Image

from en4dvar_app.pictures import readings

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "agarose_synthetic.csv"
pytestmark = pytest.mark.slow


def opened(visit, serve, folder):
    """The page with the movie of two bubbles and its scales, and height and width of a frame."""
    page = visit(serve(folder))
    until(page, "!!movie?.picture")
    page.fill("#pixel", "1 um")
    page.fill("#frame-rate", "100 kHz")
    return page, page.evaluate("[movie.height, movie.width]")


def seen_at(folder):
    """Median place of the bubble that was read, and in how many frames, in pixels."""
    table = readings(folder / "two.csv")
    seen = np.array([[row["x_um"], row["y_um"]] for row in table["rows"] if row["x_um"]]) / table["pixel"]
    return np.median(seen, axis=0), len(seen)


def test_what_lies_outside_the_drawn_region_is_not_read(visit, serve, two_bubbles, tmp_path):
    folder, centres = two_bubbles
    page, (height, width) = opened(visit, serve, folder)
    middle = centres[:, 0].mean()
    page.check("input[value=region]")
    for n, (start, end) in enumerate(((1, middle), (middle, width - 1))):
        pull(page, (start, 1), (end, height - 1))
        words = done(page, "track")
        x, _, w, _ = map(int, next(word for word in words if word.startswith("--region=")).split("=")[1].split(","))
        assert np.allclose([x, x + w], [start, end], atol=1.6)
        place, frames = seen_at(folder)
        assert frames > 20
        assert np.hypot(*(place - centres[n])) < 5
    before = (folder / "two.csv").read_bytes()
    repeat(folder, words)
    assert (folder / "two.csv").read_bytes() == before


def drawn(page, *places):
    """Draw on the frame and wait until the new mask is shown."""
    page.evaluate("() => { window.old = covered; }")
    pull(page, *places)
    until(page, "covered !== window.old")
    assert page.input_value("#mask") == "two.mask.png"


def test_what_is_covered_on_the_frame_is_not_read(visit, serve, two_bubbles):
    folder, centres = two_bubbles
    page, (height, width) = opened(visit, serve, folder)
    middle = round(centres[:, 0].mean())
    left, right = ([(x, 0), (x + middle, 0), (x + middle, height), (x, height)] for x in (0, middle))
    page.check("input[value=mask]")
    for n, cover in ((0, right), (1, left)):
        if n:
            page.keyboard.down("Shift")
            drawn(page, *right)
            page.keyboard.up("Shift")
        drawn(page, *cover)
        light = np.asarray(Image.open(folder / "two.mask.png"))
        assert light.shape == (height, width)
        sides = light[5:-5, 5 : middle - 5], light[5:-5, middle + 5 : -5]
        assert [side.mean() for side in sides] == ([0, 255] if n else [255, 0])
        words = done(page, "track")
        assert "--mask=two.mask.png" in words
        assert np.hypot(*(seen_at(folder)[0] - centres[n])) < 5
    page.click("#frame")
    until(page, "mask.value === ''")
    assert "--mask" not in " ".join(done(page, "track"))
    (folder / "two.mask.png").write_text("of somebody else")
    pull(page, *left)
    until(page, "message.innerText.includes('cannot be read as a picture')")
    assert (folder / "two.mask.png").read_text() == "of somebody else"


@pytest.fixture
def workbook(tmp_path):
    """A folder with a workbook of two sheets, of which one has two bubbles below each other."""
    book = pytest.importorskip("openpyxl").Workbook()
    book.active.append(["written by", "nobody"])
    sheet = book.create_sheet("Film 3")
    sheet.append(["gel", "time", "radius"])
    lines = [line.split(",") for line in DATA.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    for name in ("hard", "soft"):
        for t, r in lines[1:]:
            sheet.append([name, float(t), float(r)])
    folder = tmp_path / "tables"
    folder.mkdir()
    book.save(folder / "messung.xlsx")
    return folder


def test_two_bubbles_of_a_workbook_are_two_intervals(visit, serve, workbook, tmp_path):
    (workbook / "plots").mkdir()
    for n in (1, 2):  # pictures that are no movie, which nobody chooses
        Image.new("L", (10, 10 * n)).save(workbook / "plots" / f"{n}.png")
    page = visit(serve(workbook))
    page.wait_for_load_state("networkidle")
    assert (page.input_value("#movie"), page.inner_text("#message")) == ("plots", "")
    page.select_option("#movie", "plots")
    until(page, "message.innerText.includes('plots')")
    page.select_option("#table", "messung.xlsx")
    until(page, "message.innerText.includes('2 sheets hold something; say which in the field Sheet')")
    page.fill("#sheet", "Film 3")
    page.press("#sheet", "Tab")
    until(page, "[...by.options].some((o) => o.value === 'gel')")
    page.select_option("#by", "gel")
    columns = {"time_column": "time", "radius_column": "radius", "time_unit": "us", "radius_unit": "um"}
    words = proposed(page, "", **columns)
    until(page, "text.value.includes('by: gel')")
    text = page.input_value("#text")
    other = tmp_path / "other"
    other.mkdir()
    (other / "messung.xlsx").write_bytes((workbook / "messung.xlsx").read_bytes())
    repeat(other, words)
    assert (other / "messung.yaml").read_text(encoding="utf-8") == text
    page.fill("#text", text.replace("gas: heat", "gas: polytropic"))
    done(page, "run")
    told = page.inner_text("#job-run pre")
    rows = {line.split()[0] for line in told.splitlines() if " G " in line and "kPa" in line}
    assert {"messung_hard", "messung_soft"} <= rows, told
    page.reload()
    until(page, "state !== null")
    page.select_option("#table", "messung.xlsx")
    until(page, "by.value === 'gel' && document.getElementById('time-unit').value === 'us'")
    assert page.input_value("#sheet") == "Film 3"
