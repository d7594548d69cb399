"""``en4dvar init`` of tables whose times are numbers of frames, or whose radii are pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from init_files import UNITS, call, proposed, write

from en4dvar.assembly.build import build

pytestmark = pytest.mark.usefixtures("own_folder")


def test_pixels_and_frame_numbers(tmp_path: Path) -> None:
    """The configuration reads the same histories as one with the sizes multiplied in."""
    t, R = np.loadtxt(write(tmp_path / "b.csv"), delimiter=",", skiprows=1).T
    rows = zip(np.rint(t / 0.7), R / 2.5, strict=True)
    Path("px.csv").write_text("\n".join(["frame,R_px", *(f"{n:g},{r:.17g}" for n, r in rows), ""]))
    scales = ("--pixel", "2.5 um", "--frame-rate", "1.4285714285714286 MHz")
    for more in ((), ("--time-unit", "frame", "--radius-unit", "px")):
        done = call("init", "--data", "px.csv", *scales, *more, "--force")
        assert done.exit_code == 0, done.output
        assert "seems to" not in done.stderr
        (read,) = build(proposed(Path("px.yaml")))
        assert call("init", "--data", "b.csv", *UNITS, "--force").exit_code == 0
        (known,) = build(proposed(Path("b.yaml")))
        assert read.observations.values == pytest.approx(known.observations.values, rel=1e-12)
        assert read.observations.times == pytest.approx(known.observations.times, rel=1e-12)


def frames_without_names(path: Path, every: int = 1) -> Path:
    t, R = np.loadtxt(write(path), delimiter=",", skiprows=1).T
    path.write_text("".join(f"{every * n:.0f},{r:g}\n" for n, r in zip(np.rint(t / 0.7), R, strict=True)))
    return path


NAMELESS = ("--time-column", "c1", "--radius-column", "c2", "--radius-unit", "um")


@pytest.mark.parametrize(
    ("every", "rate", "more"),
    [(1, "2 MHz", ()), (1, "2 MHz", ("--time-unit", "frame")), (3, "2 MHz", ("--time-unit", "frame")),
     (1, "1 MHz", ("--time-unit", "us"))],
)  # fmt: skip
def test_numbers_that_rise_by_one_are_frames_beside_a_rate(
    tmp_path: Path, every: int, rate: str, more: tuple[str, ...]
) -> None:
    data = frames_without_names(tmp_path / "n.csv", every)
    done = call("init", "--data", data, *NAMELESS, "--frame-rate", rate, *more)
    assert done.exit_code == 0, done.output
    (time,) = (line.strip() for line in Path("n.yaml").read_text().splitlines() if line.strip().startswith("time: "))
    assert time == f'time: {{name: c1, unit: "1/({rate.replace(" ", "*")})"}}'


def test_a_unit_of_time_beside_a_frame_rate_that_contradicts_it_is_refused(tmp_path: Path) -> None:
    data = frames_without_names(tmp_path / "n.csv")
    done = call("init", "--data", data, *NAMELESS, "--frame-rate", "2 MHz", "--time-unit", "us")
    assert done.exit_code == 2
    told = "--frame-rate makes c1 numbers of frames of 0.5 us, --time-unit times in us: give the one that is right"
    assert told in done.stderr
    header = write(tmp_path / "b.csv", "Bild,R_um")
    assert "makes Bild numbers" in call("init", "--data", header, *UNITS, "--frame-rate", "270 kHz").stderr


def test_the_advice_for_numbers_that_may_be_frames_leads_to_their_clock(tmp_path: Path) -> None:
    done = call("init", "--data", frames_without_names(tmp_path / "n.csv"), *NAMELESS)
    assert "--time-unit UNIT (e.g. us, or 'frame' beside --frame-rate where c1 counts frames)" in done.stderr
    done = call("init", "--data", frames_without_names(tmp_path / "n.csv", 3), "--frame-rate", "2 MHz")
    assert "add --time-column NAME, --radius-column NAME, --radius-unit" in done.stderr
    done = call("init", "--data", "n.csv", "--frame-rate", "2 MHz", *NAMELESS)
    assert "--time-unit UNIT (e.g. us, or 'frame' beside --frame-rate where c1 counts frames)" in done.stderr


@pytest.mark.parametrize("header", ["R_um", "R_um,quality"])
def test_a_table_without_times_needs_the_frame_rate_alone(tmp_path: Path, header: str) -> None:
    R = np.loadtxt(write(tmp_path / "b.csv"), delimiter=",", skiprows=1)[:, 1]
    Path("rows.csv").write_text("\n".join([header, *(f"{r:g}{',1' * header.count(',')}" for r in R), ""]))
    done = call("init", "--data", "rows.csv", "--frame-rate", f"{1 / 0.7:.17g} MHz")
    assert done.exit_code == 0, done.output
    assert "warning: each row is taken for the next frame: one that has no row" in done.stderr
    (read,) = build(proposed(Path("rows.yaml")))
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    (known,) = build(proposed(Path("b.yaml")))
    assert read.observations.times == pytest.approx(known.observations.times, rel=1e-9)
    assert read.observations.values == pytest.approx(known.observations.values, rel=1e-12)


def test_a_column_that_may_be_times_is_not_passed_over_for_the_frame_rate(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv", "clock,R_um"), "--frame-rate", "270 kHz")
    assert done.exit_code == 2
    assert "add --time-unit UNIT" in done.stderr


@pytest.mark.parametrize(
    ("options", "needed", "following"),
    [
        ((), "--frame-rate RATE (e.g. '270 kHz', where frame", "--frame-rate RATE --pixel LENGTH"),
        (("--time-unit", "frame", "--pixel", "2 um"), "add --frame-rate RATE", "--frame-rate RATE"),
        (("--frame-rate", "270 kfps", "--radius-unit", "px"), "add --pixel LENGTH", "--pixel LENGTH"),
    ],
)
def test_pixels_and_frames_without_their_size_end_with_the_next_command(
    tmp_path: Path, options: tuple[str, ...], needed: str, following: str
) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv", "frame,R_px"), *options)
    assert done.exit_code == 2
    assert needed in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("next: en4dvar ")
    assert last.endswith(following)
