"""Tables as laboratories have them: thousands apart, units below the names, glare, placeholders, German words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.inputs.implausible import outlying, placeholders, scatter_of
from en4dvar.inputs.parts import Layout, read_contents

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
    assert read_contents(tmp_path / "c.csv").units == {}


def test_diameters_in_german(tmp_path: Path) -> None:
    code, output = told(tmp_path, rows("Zeit_us;Durchmesser_um\n", 2 * radii(), "{:.3f};{:.3f}\n"))
    assert code == 0, output
    assert "'Durchmesser_um' seems to hold diameters" in output


@pytest.mark.parametrize(("glare", "when"), [([1], "reading at 3.2 us is"), ([0, 1], "2 readings at 1.6, 3.2 us are")])
def test_glare_in_the_first_readings_is_left_out(tmp_path: Path, glare: list[int], when: str) -> None:
    values = radii()
    values[glare] = 390
    code, output = told(tmp_path, rows("t_us,R_um\n", values))
    assert code == 0, output
    assert f"the {when} none of the bubble by the neighbours, and left out" in output
    assert "outliers: leave out" in (tmp_path / "b.yaml").read_text(encoding="utf-8")


def test_no_first_reading_of_a_bubble_is_glare() -> None:
    """Whatever of its growth was seen, and however steep it was."""
    for seed in range(50):
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
    text = rows("t_us,R_um\n", radii() - 60)
    code, output = told(tmp_path, "".join(text.splitlines(keepends=True)[:29]))
    assert code == 0, output
    assert "give this collapse time: is the driving that of your experiment? If a laser made the bubble, say" in output
