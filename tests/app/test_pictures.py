"""Frames of a movie in any order, with room for a few of them only; and the axis of a table's plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from en4dvar_app import pictures


def test_a_radius_has_the_digits_that_its_error_allows(tmp_path):
    """The inspector said "R 143.0873 ± 0.005155 µm"."""
    head = "frame,t_us,R_um,R_std_um,t_std_us,x_um,y_um,used,reason"
    rows = "0,0.0,143.0873,0.005155,0,1,1,yes,\n1,1.0,,,,,,no,no bubble"
    (tmp_path / "a.csv").write_text(f"# en4dvar track; pixel: 2.5 um;\n{head}\n{rows}\n")
    first, second = pictures.readings(tmp_path / "a.csv")["rows"]
    assert first["R"] == "143.0873 ± 0.0052"
    assert first["R_um"] == 143.0873
    assert "R" not in second


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_are_the_same_in_any_order_with_little_room(tmp_path, monkeypatch, dtype):
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(3)
    frames = rng.integers(0, np.iinfo(dtype).max, (20, 32, 48)).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", frames)
    monkeypatch.setattr(pictures, "HELD", 4 * frames[0].nbytes)
    opened = pictures.Pictures(tmp_path / "a.tif")
    assert opened.count == 20
    order = [*range(6), 5, 4, 19, 18, 0, *rng.integers(0, 20, 30)]
    seen = [opened.frame(int(n)) for n in order]
    assert np.array_equal(seen, frames[order])
    assert len(opened._room) == 4


@pytest.mark.slow
def test_the_numbers_beside_a_plot_leave_room_for_the_name_of_its_axis(browser):
    page = browser.new_page()
    page.set_content("<canvas id=c style='width: 400px; height: 200px'></canvas>")
    page.add_script_tag(content=(Path(pictures.__file__).parent / "plot.js").read_text(encoding="utf-8"))
    lefts = page.evaluate(
        """() => {
        const lefts = [], pen = CanvasRenderingContext2D.prototype, write = pen.fillText;
        pen.fillText = function (text, x, y) {
          if (this.textAlign === "right") lefts.push(x - this.measureText(text).width);
          write.call(this, text, x, y);
        };
        for (const top of [4e-4, 400, 4e9]) plot(c, [{ x: 0, y: 0 }, { x: 1, y: top }], "t s", "R m");
        return lefts;
        }"""
    )
    page.close()
    assert len(lefts) > 9
    assert min(lefts) > 14 + 4  # where the name stands, and what hangs below its line
