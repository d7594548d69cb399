"""``en4dvar init``: what it notices of units, scales, names and files that cannot be right."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from init_files import UNITS, call, proposed, rebounding, simulate, write
from scipy.io import savemat

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.inputs.parts import Column
from en4dvar.inputs.readers import read_series
from en4dvar_bubble.collapse import RAYLEIGH

pytestmark = pytest.mark.usefixtures("own_folder")


def test_units_that_cannot_be_right_are_noticed(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), "--time-unit", "ms", "--radius-unit", "um")
    assert done.exit_code == 0, done.output
    assert "are the units of both columns right?" in done.stderr
    assert "# WARNING: the collapse takes" in Path("b.yaml").read_text()
    done = call("init", "--data", "b.csv", "--time-unit", "s", "--radius-unit", "m", "--force")  # both, by as much
    assert (
        "no bubble has such a radius; are the units of both columns right? Units 1000000 times smaller" in done.stderr
    )
    Path("s.csv").write_text(_in_other_units(Path("b.csv")))
    done = call("init", "--data", "s.csv", *UNITS)
    told = "R_max 0.195 um, read every 0.0007 us: only ultrasound of small amplitude leaves a bubble such a radius; "
    told += "are the units of both columns right? "
    assert f"{told}Units 1000 times larger would make it a usual one" in done.stderr


def test_a_file_of_several_shots_is_proposed_for_the_first_and_said_to_be_one(tmp_path: Path) -> None:
    """The window ended with the last shot where the first has no second minimum."""
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    cells = [[float(cell) for cell in row.split(",")] for row in rows]
    later = [f"{t + 1e3:.9g},{0.9 * r:.9g}" for t, r in cells]
    Path("shots.csv").write_text("\n".join([head, *rows, *later, ""]))
    told = {name: call("init", "--data", f"{name}.csv", *UNITS).stderr for name in ("b", "shots")}
    words = f"behind {cells[-1][0]:.6g} us another bubble begins"
    assert [words in it for it in told.values()] == [False, True]
    one, shots = (build(load_config(f"{name}.yaml"))[0] for name in told)
    assert len(shots.observations) == len(one.observations)
    assert "this is a proposal for the one before" in told["shots"]
    smaller = [f"{t:.9g},{0.9 * r:.9g}" for t, r in cells]  # the larger one comes second
    Path("second.csv").write_text("\n".join([head, *smaller, *[f"{t + 1e3:.9g},{r:.9g}" for t, r in cells], ""]))
    of_second = call("init", "--data", "second.csv", *UNITS).stderr
    assert f"{words}, larger than the one before" in of_second
    assert "this is a proposal for the larger one" in of_second
    Path("folder").mkdir()
    for name in told:
        Path(f"{name}.csv").rename(f"folder/{name}.csv")
    assert words in call("init", "--data", "folder", *UNITS).stderr
    assert [len(it.observations) for it in build(load_config("folder.yaml"))] == [len(one.observations)] * 2


def test_a_driven_bubble_whose_times_are_in_another_unit_is_noticed() -> None:
    simulate("acoustic", "5 us:28 us:1 us", "1.4 um", Path("pulse.csv"))
    told = [call("init", "--data", "pulse.csv", "--time-unit", unit, "--radius-unit", "um", "--start", "acoustic",
                 "--out", f"{unit}.yaml").stderr for unit in ("us", "ns", "ms")]  # fmt: skip
    assert ["are the units of both columns right?" in it for it in told] == [False, True, True]


def _in_other_units(path: Path) -> str:
    """The same bubble in ms and mm, under the same names."""
    head, *rows = path.read_text().splitlines()
    return "\n".join([head, *(",".join(f"{float(cell) / 1e3:.9g}" for cell in row.split(",")) for row in rows), ""])


def test_a_file_in_other_units_than_the_rest_of_its_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "gel").mkdir()
    for n in range(3):
        write(tmp_path / "gel" / f"b{n}.csv", scale=1 + n / 4)
    assert "than the median" not in call("init", "--data", "gel", *UNITS).stderr
    Path("gel/b1.csv").write_text(_in_other_units(Path("gel/b1.csv")))
    said = call("init", "--data", "gel", *UNITS, "--force").stderr
    assert re.search("b1: the largest radius is .* times smaller than the .* files; is it in mm, not in um", said)
    assert "warning: b1: the time between readings is 1000 times smaller" in said
    assert "is it in ms, not in us?" in said
    assert said.count("than the median") == 2


def test_frames_without_a_bubble_change_nothing_but_a_note(tmp_path: Path) -> None:
    """Codes of dropped frames, before the collapse and after the window: all is as if their cells were blank."""
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    written = {}
    for name, code in (("blank", ""), ("coded", "0"), ("coded_too", "-1")):
        dropped = [f"{row.split(',')[0]},{code}" if i in (12, 30, 55) else row for i, row in enumerate(rows)]
        Path(f"{name}.csv").write_text("\n".join([head, *dropped, ""]))
        done = call("init", "--data", f"{name}.csv", "--out", f"{name}.yaml")
        told = f"warning: {name}: 3 readings of 0 or below are frames without a bubble, left out\n"
        assert (told in done.stderr) == (name != "blank")
        text = Path(f"{name}.yaml").read_text().replace(name, "blank")
        written[name] = [line for line in text.splitlines() if "frames without" not in line]
        (problem,) = build(load_config(f"{name}.yaml"))
        written[name] += [problem.observations.times.tolist()]
    assert written["blank"] == written["coded"] == written["coded_too"]
    said = call("validate", "coded.yaml").stderr
    assert "note: coded: readings left out, for they are 0 or below, as a missing reading may be written: 3 of" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "options", "told"),
    [
        ("t_us,R [mm]", UNITS, ["the name of column 'R [mm]' says mm, but its unit is given as um"]),
        ("time (ms),R_um", UNITS, ["the name of column 'time (ms)' says ms, but its unit is given as us"]),
        ("frame,R_um", UNITS, ["'frame' seems to count frames; if so, give --frame-rate instead of a unit"]),
        ("t_us,D_um", UNITS, ["'D_um' seems to hold diameters; if so, give half their unit, --radius-unit '0.5*um'"]),
        ("t_us,D_um", ("--time-unit", "us", "--radius-unit", "0.5*um"), []),
        ("t_us,radius_px", UNITS, ["'radius_px' seems to hold pixels; if so, give --pixel"]),
        ("t_us,radius_px", ("--time-unit", "us", "--pixel", "1.0 um"), []),
        ("t_us,R_um", ("--time-unit", "us", "--pixel", "1.1 um"), ["'R_um' says um, but its unit is given as 1.1*um"]),
        ("t_us,R_um", UNITS, []),
        ("Time (µs),R [µm]", UNITS, []),
        ("t,radius at equator", UNITS, []),
    ],
)
def test_a_name_that_says_something_else_is_noticed(
    tmp_path: Path, header: str, options: tuple[str, ...], told: list[str]
) -> None:
    text = write(tmp_path / "b.csv").read_text()
    Path("b.csv").write_text(text.replace("t_us,R_um", header), encoding="utf-8")
    time, radius = header.split(",")
    done = call("init", "--data", "b.csv", *options, "--time-column", time, "--radius-column", radius)
    assert done.exit_code == 0, done.output
    doubts = [line for line in done.stderr.splitlines() if "seems to" in line or "the name of column" in line]
    assert len(doubts) == len(told)
    assert all(words in doubts[0] for words in told)


def test_what_is_advised_for_a_few_readings_can_be_run(tmp_path: Path) -> None:
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    Path("bubble.csv").write_text("\n".join([head, *rows[:49:12], ""]))
    said = call("init", "--data", "bubble.csv").stderr
    assert "(en4dvar init --start laser, without --data)" in said
    assert call("init", "--start", "laser").exit_code == 0
    (problem,) = build(proposed(Path("bubble.yaml")))
    assert len(problem.observations.times) == 5
    words = Path("bubble.yaml").read_text().replace("to: end}", "to: trough 2}")
    Path("bubble.yaml").write_text(words)
    assert "only 0 minima" in (said := call("validate", "bubble.yaml").stderr)
    assert "end it elsewhere ('to: trough 2 or end', or at a time)" in said


def test_growth_alone_and_rows_before_the_bubble_are_told_in_words_of_the_recording(tmp_path: Path) -> None:
    """And what is advised leads to a configuration that can be run."""
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    grown = [f"{0.7 * i - 5.55:.3f},{195 - (7 - i) ** 2:.2f}" for i in range(8)]
    film = [f"{6 + float(row.split(',')[0]):g},{row.split(',')[1]}" for row in rows]
    Path("growth.csv").write_text("\n".join([head, *grown, ""]))
    done = call("init", "--data", "growth.csv")
    assert done.exit_code == 2
    assert "growth: the recording ends with the maximum, reading 8 of 8: it shows only growth" in done.stderr
    assert call("init", "--data", "growth.csv", "--start", "acoustic").exit_code == 0
    proposed(Path("growth.yaml"))
    empty = [f"{0.7 * i - 80:g},{3 + i % 3}" for i in range(100)]
    Path("pre.csv").write_text("\n".join([head, *empty, *grown, *film, ""]))
    assert call("init", "--data", "pre.csv").exit_code == 0  # of a laser's bubble the window begins at the top
    (problem,) = build(proposed(Path("pre.yaml")))
    assert problem.observations.values[0] == pytest.approx(195e-6, rel=0.01)
    done = call("init", "--data", "pre.csv", "--start", "acoustic", "--force")
    assert "pre: the first 100 readings are small beside the bubble, which appears at -5.55 us" in done.stderr
    assert "next: " in done.stderr
    assert done.stderr.rstrip().endswith("--since '-5.55 us'")
    done = call("init", "--data", "pre.csv", "--start", "acoustic", "--force", "--since", "-5.55 us")
    assert done.exit_code == 0, done.output
    proposed(Path("pre.yaml"))


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (
            "mean,77\nstd,60\n",
            "'mean' in column 't_us' is not a number; delete lines 62 to 63, below the readings",
        ),
        ("n = 60,,\n", "'n = 60' in column 't_us' is not a number; delete line 62, below the readings"),
        (
            "t_us,R_um\n0,1\n",
            "names the columns again: if another series begins here, give it a file of its own",
        ),
    ],
)
def test_what_stands_below_the_readings_is_told_with_what_to_do(tmp_path: Path, more: str, told: str) -> None:
    """And no column is asked for that the file has."""
    path = write(tmp_path / "b.csv")
    path.write_text(path.read_text() + more)
    done = call("init", "--data", "b.csv")
    assert done.exit_code == 2
    assert done.stderr.endswith(f"{told}\n")
    assert "--time-column" not in done.stderr


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--pixel", "2.76"), "2.76 has no unit; write e.g. '2.76 um'"),
        (("--frame-rate", "270"), "270 has no unit; write e.g. '270 kHz'"),
        (("--time-step", "3.7"), "3.7 has no unit; write e.g. '3.7 us'"),
    ],
)
def test_units_that_are_proposed_are_those_of_a_bubble(tmp_path: Path, options: tuple[str, str], told: str) -> None:
    write(tmp_path / "b.csv", "t_us,R_px")
    assert call("init", "--data", "b.csv", *options, *["--pixel", "1 um"] * ("--pixel" not in options)).stderr.endswith(
        f"{told}\n"
    )
    write(tmp_path / "b.csv")
    assert call("init", "--data", "b.csv").exit_code == 0
    Path("b.yaml").write_text(re.sub(r"\n  R_eq: .*", "", Path("b.yaml").read_text()))
    assert "write e.g. 'R_eq: {prior: normal, mean: 1 um, std: 0.1 um}'" in call("validate", "b.yaml").stderr


def test_decimal_commas_are_noticed(tmp_path: Path) -> None:
    text = write(tmp_path / "b.csv").read_text().replace(",", ";").replace(".", ",")
    Path("b.csv").write_text(text)
    done = call("init", "--data", "b.csv", *UNITS)
    assert done.exit_code == 0, done.output
    assert "b.csv, decimal commas: t_us (60 values, 0 to 41.3)" in done.stderr
    config = proposed(Path("b.yaml"))
    assert config.document.data["data"]["decimal"] == ","
    assert build(config)[0].observations.values.max() == pytest.approx(195e-6, rel=0.01)


def test_rows_of_a_matrix_are_columns_where_it_is_flat(tmp_path: Path) -> None:
    rows = np.loadtxt(write(tmp_path / "b.csv"), delimiter=",", skiprows=1).T
    savemat("b.mat", {"data": rows})
    done = call("init", "--data", "b.mat", *UNITS)
    assert "columns with numbers: data(1,:), data(2,:); units are never guessed: add --time-column NAME" in done.stderr
    done = call("init", "--data", "b.mat", *UNITS, "--time-column", "data(1,:)", "--radius-column", "data(2,:)")
    assert done.exit_code == 0, done.output
    (problem,) = build(proposed(Path("b.yaml")))
    assert problem.observations.values.min() == pytest.approx(1e-6 * rows[1].min())


@pytest.mark.parametrize("name", ["dR_um", "R_err_um", "sigma_um", "radius_std", "R std [nm]", "± SE (um)", "± (nm)"])
def test_a_column_that_looks_like_errors_is_told_and_can_be_used_as_said(tmp_path: Path, name: str) -> None:
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    Path("b.csv").write_text("\n".join([f"{head},{name}", *(f"{row},{1 + i % 2}" for i, row in enumerate(rows)), ""]))
    done = call("init", "--data", "b.csv")
    assert done.exit_code == 0, done.output
    (entry,) = re.findall(f"column '{re.escape(name)}' looks like errors .* in the section error '(.*)'", done.stderr)
    text = Path("b.yaml").read_text()
    Path("b.yaml").write_text(re.sub("radius_std: .* um ", f"{entry} ", text, count=1))
    (problem,) = build(load_config("b.yaml"))
    stds = problem.observations.noise.std[:2] * (1e9 if "nm" in name else 1e6)
    assert sorted(stds) == pytest.approx([1, 2])


def test_errors_in_per_cent_are_told(tmp_path: Path) -> None:
    head, *rows = write(tmp_path / "b.csv").read_text().splitlines()
    Path("b.csv").write_text("\n".join([f"{head},err (%)", *(f"{row},2" for row in rows), ""]))
    done = call("init", "--data", "b.csv")
    assert done.exit_code == 0, done.output
    assert "'err (%)' looks like errors of the radii, and is not used; to use them, write them" in done.stderr


def test_the_columns_that_most_files_of_a_folder_have_are_taken(tmp_path: Path) -> None:
    (tmp_path / "gel").mkdir()
    for n in range(4):
        write(tmp_path / "gel" / f"b{n}.csv", scale=1 + n / 20)
    Path("gel/a.csv").write_text(_in_other_units(Path("gel/b3.csv")).replace("t_us,R_um", "t_ms,R_mm"))
    done = call("init", "--data", "gel")
    assert done.exit_code == 0, done.output
    assert done.stderr.startswith(f"{tmp_path}/gel/b0.csv: t_us")
    assert "a.csv: no column 'R_um'; the columns are: t_ms, R_mm" in done.stderr
    assert "one of 5 files" in done.stderr
    assert "4 bubbles" in done.stdout


def test_vectors_that_a_mat_file_hides_are_told(tmp_path: Path) -> None:
    savemat("b.mat", {"film": {"note": "by hand"}})
    done = call("init", "--data", "b.mat", *UNITS)
    assert (done.exit_code, done.stderr) == (2, f"{tmp_path}/b.mat: film is a struct; save what is in it as vectors\n")
    savemat("b.mat", {"t": np.arange(9.0), "R": np.ones((3, 9))})
    done = call("init", "--data", "b.mat", *UNITS)
    assert "b.mat: R is an array of 3 x 9; its columns are R(:,1), R(:,2), …, its rows R(1,:), …\n" in done.stderr
    assert "R(:,9); units are never guessed: add --radius-column 'R(:,*)'" in done.stderr


def test_bubbles_side_by_side_are_named_by_a_pattern() -> None:
    """The answer can be typed: a name with a blank is quoted. Columns that are no bubbles of one kind have none."""
    rows = "\n".join(f"{t},1,2,3" for t in range(9))
    for names, told in (("bubble A,bubble B,bubble C", "'bubble *'"), ("X,Area,Perimeter", "NAME"), ("X,Y,Z", "NAME")):
        Path("b.csv").write_text(f"t,{names}\n{rows}\n")
        done = call("init", "--data", "b.csv", "--time-column", "t", *UNITS)
        assert f"units are never guessed: add --radius-column {told}" in done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,R\nus,um\n", "b.csv:2: 'us' in column 't' is not a number"),
        ("t,R\n", "b.csv: no data: no line follows the header"),
    ],
)
def test_without_a_column_of_numbers_the_reason_is_told(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "b.csv").write_text(text)
    done = call("init", "--data", "b.csv", *UNITS)
    assert done.exit_code == 2
    assert message in done.stderr
    assert "columns with numbers" not in done.stderr


def test_a_scale_that_cannot_be_is_told_and_no_prior_is_taken_from_it(tmp_path: Path) -> None:
    """At 0.7 of its collapse time a laser bubble is one in a very stiff gel: the prior of G stays that of usual ones.
    At 0.4 of it there is no such gel.
    """
    data = simulate("laser", "0 us:70 us:0.63 us", "1 um", tmp_path / "bubble.csv")
    done = call("init", "--data", data, *UNITS)
    assert "Rayleigh time 0.915" not in done.stderr
    assert "first guess from collapse time" in Path("bubble.yaml").read_text()
    series = read_series(data, Column("t_us", "us", "us"), Column("radius_um", "um", "um"))
    t, R = series.times, series.values
    rows = "".join(f"{a},{b}\n" for a, b in zip(0.68 * t, R, strict=True))
    Path("fast.csv").write_text(f"t_us,radius_um\n{rows}")
    done = call("init", "--data", "fast.csv", *UNITS)
    assert "or the time step 1.38" in done.stderr
    written = Path("fast.yaml").read_text()
    assert "first guess from collapse time" not in written
    assert "# WARNING: the collapse takes 0.7" in written
    assert "median: 10 kPa" in written
    assert "within what gels usually are, for the collapse is doubted" in written
    done = call("validate", "fast.yaml")
    assert "warning: fast: the collapse takes 0.7" in done.stderr
    rows = "".join(f"{a},{b}\n" for a, b in zip(0.4 * t, R, strict=True))
    Path("none.csv").write_text(f"t_us,radius_um\n{rows}")
    assert call("init", "--data", "none.csv", *UNITS).exit_code == 0
    written = Path("none.yaml").read_text()
    assert "# WARNING: the collapse takes 0.4" in written
    assert "doubted" not in written


def test_a_rebound_that_no_gel_gives_is_named_and_not_the_collapse(tmp_path: Path) -> None:
    """A polytropic gas loses no heat. Without the frame of the collapse, or with a blank in it, all is the same."""
    t, R = rebounding(0.07)
    rows = [f"{13.8 * a:.4f},{140 * b:.4f}" for a, b in zip(t, R, strict=True)]
    least = int(np.argmin(np.where(t < 1.3, R, 1.0)))
    blank, missing = rows.copy(), rows[:least] + rows[least + 1 :]
    blank[least] = f"{13.8 * t[least]:.4f},"
    for name, lines in (("whole", rows), ("blank", blank), ("missing", missing)):
        (tmp_path / f"{name}.csv").write_text("\n".join(["t_us,R_um", *lines, ""]))
        done = call("init", "--data", f"{name}.csv", *UNITS)
        assert re.search(r"R_max 140 um, collapse 12\.\d us later, (0.99|1.00|1.01) of the Rayleigh time", done.stdout)
        told = next(line for line in done.stderr.splitlines() if "no G and mu of neo-hookean-kelvin-voigt will" in line)
        assert re.search(r"will give this rebound to 0\.\d\d R_max: is 17 um its radius at rest \(R_eq\)", told)
        assert "model.gas" in told
        assert "frame rate" not in told
    (problem,) = build(proposed(Path("missing.yaml")))
    assert len(problem.observations.times) > 20  # to the second minimum
    liquid = call("init", "--data", "whole.csv", *UNITS, "--law", "newtonian", "--force")
    assert "no mu of newtonian will give this rebound" in liquid.stderr


def test_a_rate_that_the_times_contradict_is_told(tmp_path: Path) -> None:
    write(tmp_path / "b.csv")
    done = call("init", "--data", "b.csv", *UNITS, "--frame-rate", "270 kHz")
    told = "the times are 0.7 us apart, which is not a whole number of frames: at the given rate one takes 3.704 us"
    assert told in done.stderr
    assert f"# WARNING: {told}" in Path("b.yaml").read_text()
    assert f"warning: b: {told}" in call("validate", "b.yaml").stderr
    (problem,) = build(load_config("b.yaml"))
    assert [c.code for c in problem.observations.doubts] == ["implausible-data"]
    assert call("init", "--data", "b.csv", "--frame-rate", f"{1 / 0.7} MHz", "--force").exit_code == 0
    assert build(load_config("b.yaml"))[0].observations.doubts == ()
    Path("b.yaml").write_text(Path("b.yaml").read_text().replace("MHz", "parsec"))
    assert "b.yaml:" in call("validate", "b.yaml").stderr
    assert "data.columns.time.rate: " in call("validate", "b.yaml").stderr


def test_rows_of_summaries_are_taken_where_their_units_leave_no_doubt(tmp_path: Path) -> None:
    radius = np.array([365e-6, 399e-6, 298e-6])
    rows = np.column_stack([radius, [6.1, 5.9, 6.3], 0.9 * RAYLEIGH * radius / 10])
    savemat("b.mat", {"pIMR_array": rows})
    done = call("init", "--data", "b.mat")
    assert done.exit_code == 0
    assert "pIMR_array(:,3) are 3 rows of R_max, R_max/R_eq and collapse time in SI units" in done.stdout
    savemat("b.mat", {"a": rows * [1e6, 1, 1]})  # in micrometres, which nobody said
    assert "--radius-column NAME" in call("init", "--data", "b.mat", "--out", "c.yaml").stderr


def test_a_pixel_that_the_file_holds_is_told(tmp_path: Path) -> None:
    savemat("b.mat", {"R": np.arange(9.0), "deltat": 3.7e-6, "deltax": 2.76e-6})
    done = call("init", "--data", "b.mat", "--time-unit", "s")
    assert "add --pixel LENGTH (the size of one, e.g. '2.76e-06 m' if deltax is in m; or" in done.stderr


def test_a_top_that_leaves_the_picture_is_left_out_by_init_and_doubted_without(tmp_path: Path) -> None:
    t, r = rebounding(0.04)
    r = np.minimum(np.round(r + 0.004 * np.random.default_rng(3).standard_normal(len(t)), 2), 0.935)
    rows = [f"{24 * time:.4g},{250 * radius:.5g}" for time, radius in zip(t, r, strict=True)]
    (tmp_path / "b.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", "b.csv", *UNITS)
    assert "us are one largest number though those beside them lead higher" in done.stderr, done.output
    text = Path("b.yaml").read_text()
    assert text.count("  outliers: leave out\n") == 1
    top = re.search(r"R_max: {prior: normal, mean: ([\d.]+) um, std: ([\d.]+) %", text)
    assert top
    assert float(top[1]) == pytest.approx(250, rel=1.645 * float(top[2]) / 100)
    assert "data.outliers: leave out" not in call("validate", "b.yaml").stderr
    Path("b.yaml").write_text(text.replace("  outliers: leave out\n", ""))
    assert "lead higher, as where a bubble leaves the picture: leave them out" in call("validate", "b.yaml").stderr


def test_a_hole_where_a_bubble_collapses_is_told_and_makes_no_first_guess() -> None:
    """What follows the hole is a later minimum, and no rebound behind it is the first."""
    t, R = rebounding(0.05)
    t, R = 20 * (t + 1), 200 * R + 0.3 * np.random.default_rng(1).standard_normal(len(t))
    for name, until in {"whole": 0.0, "frames": 40.5, "hole": 66.0}.items():
        kept = (t < 36) | (t > until)
        rows = [f"{a:.2f},{r:.3f}" for a, r in zip(t[kept], R[kept], strict=True)]
        Path(f"{name}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
        done = call("init", "--data", f"{name}.csv")
        assert done.exit_code == 0, done.output
        told = "no readings from 35 to 67 us, where it collapses; "
        assert (told in done.stderr) == (name == "hole"), done.stderr
    whole, hole = (re.search(r"collapse (\S+) us later", Path(f"{n}.yaml").read_text()) for n in ("whole", "hole"))
    assert whole
    assert hole
    assert float(hole[1]) == pytest.approx(float(whole[1]), rel=0.03)
    assert "first guess from collapse time, may be off" in Path("hole.yaml").read_text()
