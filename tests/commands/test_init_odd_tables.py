"""Tables as laboratories have them: thousands apart, units below the names, glare, placeholders, German words."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from init_files import call, proposed, write

from en4dvar.assembly.build import data_files, inverse_plan
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.inputs.implausible import outlying, placeholders, scatter_of
from en4dvar.inputs.parts import Layout, read_contents
from en4dvar_bubble.starter.config import AREA
from en4dvar_bubble.starter.grouped import ends_with

TIMES = np.arange(1, 84) * 1.6


def radii(seed: int = 0) -> np.ndarray:
    """A laser's bubble as it grows, collapses at 47 µs, rebounds and comes to rest; um."""
    lobes = [np.maximum(1 - np.abs((TIMES - at) / half) ** 2.2, 0) ** 0.42 for at, half in ((23, 24), (62, 15))]
    R = 250 * lobes[0] + 110 * lobes[1] + 30
    return R + np.random.default_rng(seed).normal(0, 1.5, len(TIMES))


def told(folder: Path, text: str, *words: str) -> tuple[int, str]:
    (folder / "b.csv").write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        result = CliRunner().invoke(main, ["init", "--data", "b.csv", *words])
    return result.exit_code, result.output


def rows(head: str, values: np.ndarray, form: str = "{:.3f},{:.3f}\n") -> str:
    return head + "".join(form.format(t, R) for t, R in zip(TIMES, values, strict=True))


@pytest.mark.parametrize("german", [True, False])
def test_thousands_that_are_set_apart(tmp_path: Path, german: bool) -> None:
    text = "".join(f"{1e3 * t:,.1f};{1e3 * R:,.1f}\n" for t, R in zip(TIMES, radii(), strict=True))
    text = text.translate(str.maketrans(".,", ",.")) if german else text
    code, output = told(tmp_path, f"t [ns];R [nm]\n{text}")
    assert code == 0, output
    assert "(83 values, 1600 to 132800)" in output


def test_a_sign_that_separates_thousands_does_so_in_all_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;R\n0;0,5\n1.600;112.088,9\n3.200;0.500\n1.003.200;7,25\n")
    columns = read_contents(tmp_path / "a.csv", Layout(decimal=",")).columns
    assert columns["t"].tolist() == [0, 1600, 3200, 1003200]
    assert columns["R"].tolist() == [0.5, 112088.9, 0.5, 7.25]


def test_thousands_without_decimals_are_told_by_the_others(tmp_path: Path) -> None:
    text = "".join(f"{t:.1f};{1e3 * R:,.0f}\n" for t, R in zip(TIMES, radii(), strict=True))
    code, output = told(tmp_path, f"t [us];R [nm]\n{text}")
    assert code == 0, output
    assert "R [nm] (83 values, 26695 to 279640)" in output
    assert "R_max 281 um" in output


def test_commas_that_no_number_explains_are_told(tmp_path: Path) -> None:
    code, output = told(tmp_path, rows("t [us];R [um]\n", radii(), "{:.3f};{:.3f}\n").replace(".", ","))
    assert code == 0, output
    assert "no number tells whether 1,600 in column 't [us]' is 1.600, as it is read, or 1600; if commas sep" in output


def test_units_below_the_names_in_german(tmp_path: Path) -> None:
    text = rows("Film vom 3.5.\nZeit\tRadius\nµs\tµm\n", radii(), "{:.3f}\t{:.3f}\n").replace(".", ",")
    code, output = told(tmp_path, text)
    assert code == 0, output
    config = (tmp_path / "b.yaml").read_text(encoding="utf-8")
    assert 'time: {name: Zeit, unit: "µs"}' in config
    assert 'radius: {name: Radius, unit: "µm"}' in config
    (tmp_path / "c.csv").write_text("t,R,note\nus,um,-\n1,2,3\n4,5,6\n")
    assert read_contents(tmp_path / "c.csv").units == {"t": "us", "R": "um"}


@pytest.mark.parametrize(
    ("head", "form"),
    [
        ("frame,t_us,R_um\nnr,us,um\n", "0,{:.3f},{:.3f}\n"),
        ("frame,t_us,R_um\n-,us,um\n", "0,{:.3f},{:.3f}\n"),
        ("t_us,R_um,note\nus,um,\n", "{:.3f},{:.3f},\n"),
        ("nr,us,um\nframe,t,R\n", "0,{:.3f},{:.3f}\n"),
        ("t,R,note\n[us],(um),[-]\n-,-,-\n", "{:.3f},{:.3f},\n"),
        ("Film 3,,\nt [us],R,V\n-,um,mm^3\n", "{:.3f},{:.3f},1\n"),
    ],
)
def test_units_beside_the_names_with_cells_that_are_none(tmp_path: Path, head: str, form: str) -> None:
    code, output = told(tmp_path, rows(head, radii(), form))
    assert code == 0, output
    config = (tmp_path / "b.yaml").read_text(encoding="utf-8")
    assert re.search(r"time: \{name: (t|t_us|\"t \[us\]\"), unit: us\}", config)
    assert re.search("radius: {name: (R|R_um), unit: um}", config)


def test_pixels_below_the_names(tmp_path: Path) -> None:
    code, output = told(tmp_path, rows("Zeit,Radius\n[µs],[px]\n", radii()))
    assert code == 2
    assert "columns with numbers: Zeit, Radius; units are never guessed: add --pixel LENGTH (the size of o" in output


@pytest.mark.parametrize("words", ["--- second buffer ---", "second buffer", "camera restarted;", "second\nus,um"])
@pytest.mark.parametrize("head", ["t_us,R_um\n", "t_us;R_um\n", "Camera;X\nrate;2e6\n\nt_us;R_um\nus;um\n"])
@pytest.mark.parametrize("row", [3, 51])
def test_words_in_the_midst_of_a_table_do_not_name_columns(tmp_path: Path, head: str, words: str, row: int) -> None:
    sign = ";" if ";" in head else ","
    lines = rows(head, radii(), f"{{:.3f}}{sign}{{:.3f}}\n").splitlines()
    at = row + head.count("\n")
    code, output = told(tmp_path, "\n".join([*lines[:at], words, *lines[at:]]))
    assert code == 2
    first = words.splitlines()[0].strip(sign)
    assert f"b.csv:{at + 1}: '{first}' in column 't_us' is not a number; nothing in the line is" in output
    assert "delete it, or if another series begins here, give it a file of its own" in output


@pytest.mark.parametrize("words", ["laser", "laser fired", "laser fired now,"])
@pytest.mark.parametrize("head", ["t,R\n", ""])
@pytest.mark.parametrize("row", [1, 2])
def test_words_that_name_no_columns_stand_in_the_midst_below_any_reading(
    tmp_path: Path, head: str, words: str, row: int
) -> None:
    """The readings above them were left out without a word."""
    lines = [*head.splitlines(), "0,9", "1,8", "2,7", "3,6", "4,5"]
    at = row + bool(head)
    (tmp_path / "a.csv").write_text("\n".join([*lines[:at], words, *lines[at:]]), encoding="utf-8")
    contents = read_contents(tmp_path / "a.csv")
    assert contents.columns["R" if head else "c2"][0] == 9
    fault = contents.others["t" if head else "c1"]
    assert f"a.csv:{at + 1}: {words.strip(',')!r} in column" in fault
    assert "nothing in the line is a number: delete it" in fault


def test_words_above_several_lines_of_numbers_in_other_columns_name_columns(tmp_path: Path) -> None:
    for preamble in ("rate,2e6\nwidth,512\nheight,512\n", "width,height\n512,512\n", "1 camera\n2 lenses\n3 lamps\n"):
        (tmp_path / "a.csv").write_text(f"Camera,X\n{preamble}t,R\n0,1\n1,2\n", encoding="utf-8")
        assert [*read_contents(tmp_path / "a.csv").columns] == ["t", "R"]


def test_columns_without_names_go_on_below_words(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("0,1\n1,2\n2,3\nsecond buffer\n3,4\n4,5\n", encoding="utf-8")
    fault = read_contents(tmp_path / "a.csv").others["c1"]
    assert "a.csv:4: 'second buffer' in column 'c1' is not a number; nothing in the line is a number" in fault


def test_rows_below_the_readings(tmp_path: Path) -> None:
    """They are advised to be deleted only where there are more readings."""
    for readings, below in (("0,1\n1,2\n2,3\n", True), ("0,1\n", False)):
        (tmp_path / "a.csv").write_text(f"t,R\n{readings}mean,2\nstd,1\n", encoding="utf-8")
        assert ("below the readings" in read_contents(tmp_path / "a.csv").others["t"]) == below


def test_diameters_in_pixels_need_half_the_size_of_a_pixel(tmp_path: Path) -> None:
    text = rows("t_us,Diameter [px]\n", 2 * radii() / 2.76)
    code, output = told(tmp_path, text)
    assert code == 2
    assert "(half the size of one, since 'Diameter [px]' seems to hold diameters, e.g. '1.38 um'; or" in output
    code, output = told(tmp_path, text, "--pixel", "2.76 um")
    assert "'Diameter [px]' seems to hold diameters; if so, 2.76*um must be half the size of a pixel: is it?" in output
    _, output = told(tmp_path, text, "--radius-unit", "0.5*um", "--force")
    assert "seems to hold diameters" not in output
    _, output = told(tmp_path, text, "--radius-unit", "um", "--force")
    assert "give --pixel with half the size of one instead of a unit" in output
    assert "--radius-unit" not in output.partition("warning")[2]
    _, output = told(tmp_path, text.replace(" [px]", ""), "--force")
    assert "add --radius-unit UNIT (e.g. 0.5*um, since 'Diameter' seems to hold diameters)" in output


def test_areas_are_no_radii(tmp_path: Path) -> None:
    """As ImageJ writes them unless it is told otherwise: "unit 'um^2' cannot be converted to 'm'" was all."""
    text, words = rows("t_us,Area\n", np.pi * radii() ** 2), "of an area the radius is √(area/π): write a column of it"
    code, output = told(tmp_path, text, "--radius-column", "Area", "--radius-unit", "um^2")
    assert (code, words in output) == (2, True)
    _, output = told(tmp_path, text, "--radius-column", "Area", "--radius-unit", "um", "--force")
    assert f"'Area' seems to hold areas; {words}" in output
    assert all(map(AREA.match, ("area_um2", "Bubble Area", "Fläche [px]", "Blasenflaeche_um2")))
    assert not any(map(AREA.match, ("Area_R_um", "area_equivalent_radius", "Area eq. diameter", "Radius_area")))


def test_a_comment_that_states_its_unit_tells_as_much_as_one_without(tmp_path: Path) -> None:
    """Of ``Req_um`` and ``dt_us`` the proposal knew nothing, but of ``Req`` and ``dt``."""
    head = "# Req: 0.03 mm\n# dt: 1.6 us\nR_um\n"
    code, output = told(tmp_path, head + "".join(f"{R:.3f}\n" for R in radii()))
    assert code == 0, output
    text = (tmp_path / "b.yaml").read_text(encoding="utf-8")
    assert "R_eq: {from_file: Req_mm, unit: mm}" in text
    assert "time: {step: dt_us, unit: us}" in text
    assert proposed(tmp_path / "b.yaml")
    _, output = told(tmp_path, rows("# Req: 3 mm\n# dt: 2.0 us\nt_us,R_um\n", radii()), "--force")
    assert "warning: Req_mm 3 of the file is not used: in mm it is no plausible R_eq\n" in output
    assert "the times are 1.6 us apart, but dt_us of the file is 2" in output


def test_diameters_in_german(tmp_path: Path) -> None:
    code, output = told(tmp_path, rows("Zeit_us;Durchmesser_um\n", 2 * radii(), "{:.3f};{:.3f}\n"))
    assert code == 0, output
    assert "'Durchmesser_um' seems to hold diameters" in output


def test_diameters_behind_another_word(tmp_path: Path) -> None:
    text = rows("t_us,bubble diameter (um)\n", 2 * radii())
    code, output = told(tmp_path, text)
    assert code == 0, output
    assert "'bubble diameter (um)' seems to hold diameters; if so, give half their unit" in output
    _, output = told(tmp_path, text, "--radius-unit", "0.5*um", "--force")
    assert "bubble diameter (um)' s" not in output  # neither "seems to" nor "says"


def test_a_radius_at_rest_beside_diameters_is_not_halved(tmp_path: Path) -> None:
    path = write(tmp_path / "film.csv", "# Req = 22\nt_us,D_um", scale=2.0)
    done = call("init", "--data", path, "--out", tmp_path / "film.yaml", "--radius-unit", "0.5*um")
    assert done.exit_code == 0, done.output
    proposed(tmp_path / "film.yaml")
    assert "R_eq: {from_file: Req, unit: um}" in (tmp_path / "film.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(("glare", "when"), [([1], "reading at 3.2 us is"), ([0, 1], "2 readings at 1.6, 3.2 us are")])
def test_glare_in_the_first_readings_is_left_out(tmp_path: Path, glare: list[int], when: str) -> None:
    values = radii()
    values[glare] = 390
    code, output = told(tmp_path, rows("t_us,R_um\n", values))
    assert code == 0, output
    assert f"the {when} too far from the neighbours, and left out" in output
    assert "outliers: leave out" in (tmp_path / "b.yaml").read_text(encoding="utf-8")


def test_no_first_reading_of_a_bubble_is_glare() -> None:
    """Whatever of its growth was seen, and however steep it was."""
    for seed in range(15):
        for since in range(25):
            t, R = TIMES[since:], radii(seed)[since:]
            assert not outlying(t, R, scatter_of(t, R))[:3].any()


def test_a_placeholder_is_named(tmp_path: Path) -> None:
    values = radii()
    values[[16, 30, 31]] = 999
    code, output = told(tmp_path, rows("t_us,R_um\n", values))
    assert code == 0, output
    assert "3 readings at 27.2, 49.6, 51.2 us are one number again and again, far above all others" in output
    values[50:54] = 999
    _, output = told(tmp_path, rows("t_us,R_um\n", values), "--force")
    assert "the 7 readings at 27.2, 49.6, 51.2, 81.6, 83.2, 84.8 … us are one number again" in output
    assert not placeholders(np.full(9, 5.0)).any()
    assert not placeholders(np.array([1.0, 2, 3, 9] * 3)).any()  # a step
    assert not placeholders(np.array([1.0, 2, 3, 2, 1, 9])).any()  # once


def test_growth_and_collapse_alone_may_be_of_a_laser(tmp_path: Path) -> None:
    text = rows("t_us,R_um\n", radii() - 100)
    code, output = told(tmp_path, "".join(text.splitlines(keepends=True)[:29]))
    assert code == 0, output
    assert "give --start laser" in output


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["al_1", "al_2", "pa_1", "pa_2"], "names begin with al (2) or pa (2): if these are two gels, write a table "),
        (["al_1", "pa_1", "pa_2", "pa_3"], ""),  # one of a kind is no gel
        (["al_1", "al_2", "pa_1", "pa_2", "q_1", "q_2"], ""),
        (["b1", "b2", "b3", "b4"], ""),
    ],
)
def test_files_of_two_kinds_of_names_may_be_of_two_gels(names: list[str], told: str) -> None:
    words = ends_with("folder", {}, names)
    assert words.startswith("at its end the run estimates their one gel")
    assert told in words
    assert ("add --groups gels.csv" in words) == bool(told)


@pytest.mark.usefixtures("own_folder")
def test_the_truths_of_a_simulated_campaign_are_no_data_set(tmp_path: Path) -> None:
    """Whatever the table is called, for a folder, a pattern and the run; a table that only has its name is one."""
    twin, folder = Path(__file__).resolve().parents[2] / "configs" / "data" / "agarose_twin", tmp_path / "twin"
    folder.mkdir()
    (folder / "answers.csv").write_text((twin / "truth.csv").read_text())
    shutil.copy(twin / "agarose_03_01.csv", folder / "truth.csv")
    for data in (folder, folder / "*.csv"):
        done = call("init", "--data", data, "--out", "twin.yaml", "--force")
        assert done.exit_code == 0, done.stderr
        lines = [line for line in done.stderr.splitlines() if "answers" in line]
        assert lines == ["twin/answers.csv: the truths of a simulated campaign are no data set, and left out"]
        assert [*data_files(inverse_plan(load_config("twin.yaml")))] == ["truth"]
    done = call("init", "--data", folder / "answers*.csv", "--out", "none.yaml")
    assert (done.exit_code, "no file matches" in done.stderr) == (2, True)


def test_units_tell_two_columns_whose_names_are_in_any_language(tmp_path: Path) -> None:
    code, output = told(tmp_path, rows("時間 [us],半径 [um]\n", radii()))
    assert code == 0, output
    code, output = told(tmp_path, rows("半径 [um],時間 [um]\n", radii()), "--force")
    assert code == 2
    assert "units are never guessed: add --time-column NAME" in output


@pytest.mark.usefixtures("own_folder")
def test_a_folder_whose_files_have_other_units_says_what_to_do(tmp_path: Path) -> None:
    folder = tmp_path / "gel"
    folder.mkdir()
    for name, head in (("a", "t_us,R_um\n"), ("b", "Zeit [us],Radius [um]\n"), ("c", "t [us],radius (um)\n")):
        (folder / f"{name}.csv").write_text(rows(head, radii()), encoding="utf-8")
    done = call("init", "--data", folder)
    assert done.exit_code == 0, done.output
    assert "c.csv: no column 'R_um'; the columns are: t [us], radius (um)" in done.stderr
    assert "2 of 3 files are left out" in done.stderr
    assert "here 't_us' and 'R_um'; write the others under these names, in the same units" in done.stderr
