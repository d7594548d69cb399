"""``en4dvar export``: tables that a spreadsheet and LaTeX read; netCDF is ArviZ-ready as it is."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from run_files import add_to_pack

from en4dvar.cli import main
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.plumbing.caution import caution
from en4dvar.plumbing.errors import OutputError
from en4dvar.report.export import escaped, export_table, latex_table, latex_unit
from en4dvar.report.result import Result as Posterior
from en4dvar.report.result import load_result


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["export", *(str(a) for a in arguments)])


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory, analysis: Analysis) -> Path:
    folder = tmp_path_factory.mktemp("one")
    Posterior.from_analysis(analysis, {}).save(folder / "posterior.nc")
    return folder


@pytest.fixture(scope="module")
def two(
    tmp_path_factory: pytest.TempPathFactory, analysis: Analysis, renamed: Callable[[Analysis, str], Analysis]
) -> Path:
    folder = tmp_path_factory.mktemp("two")
    for name in ("a_1", "b&2"):
        add_to_pack(folder, name[0], Posterior.from_analysis(renamed(analysis, name), {}))
    return folder


def test_summary_as_csv_keeps_every_digit(one: Path) -> None:
    done = call(one)
    assert done.exit_code == 0, done.output
    assert call(one, "--csv").output == done.output
    rows = list(csv.DictReader(done.output.splitlines()))
    for row, summary in zip(rows, load_result(one / "posterior.nc").rows, strict=True):
        assert (row["dataset"], row["name"], row["unit"]) == ("A_E2_synthetic", summary.name, summary.unit)
        assert [float(row[k]) for k in ("mean", "std", "q05", "q95")] == [
            summary.mean, summary.std, summary.q05, summary.q95,
        ]  # fmt: skip


def test_members_without_those_that_were_lost(one: Path, two: Path) -> None:
    rows = list(csv.DictReader(call(one, "--members").output.splitlines()))
    assert list(rows[0]) == ["dataset", "member", "G (kPa)", "mu (Pa s)", "R0 (um)", "t_s (us)", "warnings"]
    assert [int(row["member"]) for row in rows] == [i for i in range(24) if i != 3]
    result = load_result(one / "posterior.nc")
    stored = 1e-3 * result.posterior["G"].values[0]
    assert [float(row["G (kPa)"]) for row in rows] == pytest.approx(list(stored[np.isfinite(stored)]), rel=1e-12)
    assert len(export_table(two, "members").splitlines()) == 1 + 2 * 23


def numbers(cell: str) -> list[float]:
    return [float(text) for text in re.findall(r"-?\d+\.?\d*", cell)]


def lines_of_table(run: Path) -> list[str]:
    """Without the comments that carry the warnings."""
    return ["", *(line for line in call(run, "--latex").output.splitlines() if not line.startswith("%"))]


def test_latex_of_one_data_set(one: Path) -> None:
    lines = lines_of_table(one)
    assert lines[1:4] == [
        r"\begin{tabular}{llrrr}",
        r"  \toprule",
        r"  parameter & unit & prior & posterior\textsuperscript{a} & 5--95\,\% \\",
    ]
    *lines, bottom, note, skew, end = lines
    assert skew.endswith(r"\textsuperscript{b} median and 5 to 95 \%: the posterior is skewed} \\")
    assert (bottom, end) == (r"  \bottomrule", r"\end{tabular}")
    assert r"\textsuperscript{a} 1 of 24 members failed in the posterior forecast" in note
    summaries = load_result(one / "posterior.nc").rows
    for line, summary, head in zip(
        lines[5:], summaries, (r"$G$ & kPa", r"$\mu$ & Pa\,s", r"$R_0$ & $\mu$m", r"$t_s$ & $\mu$s"), strict=True
    ):
        assert line.startswith(f"  {head} & $")
        assert line.endswith(r" \\")
        cells = line.removesuffix(r" \\").split(" & ")
        assert len(cells) == 5
        middle, *sides = numbers(cells[3].removesuffix(r"\textsuperscript{b}"))
        if len(sides) == 2:
            quantiles = [summary.q50, summary.q95 - summary.q50, summary.q05 - summary.q50]
            assert [middle, *sides] == pytest.approx(quantiles, abs=0.06 * summary.std)
        else:
            assert middle == pytest.approx(summary.mean, abs=0.06 * summary.std)
            assert sides == pytest.approx([summary.std], rel=0.05)


def test_latex_of_a_campaign(two: Path) -> None:
    lines = lines_of_table(two)
    assert lines[3] == r"  data set & $G$ (kPa) & $\mu$ (Pa\,s) & $R_0$ ($\mu$m) & $t_s$ ($\mu$s) \\"
    mark = r"\textsuperscript{a}"
    assert [line.split(" & ")[0] for line in lines[5:-4]] == [rf"  a\_1{mark}", rf"  b\&2{mark}"]
    assert {line.count(" & ") for line in lines[3:-4] if "rule" not in line} == {4}


def test_a_skewed_posterior_stands_as_its_median_with_unequal_sides(analysis: Analysis) -> None:
    row = Posterior.from_analysis(analysis, {}).rows[0]
    even = replace(row, q05=0.9, q50=1.0, q95=1.1, mean=1.0, std=0.1)
    skew = replace(even, q95=1.5, mean=1.1)
    assert r"$1.00 \pm 0.10$" in latex_table([("x", (even,), ())])
    table = latex_table([("x", (skew,), ())])
    assert r"$1.00^{+0.50}_{-0.10}$\textsuperscript{a}" in table
    assert "the posterior is skewed" in table
    about = caution("not-informed", "it is the prior's", "caution", (row.name,))
    assert r"\textsuperscript{a} it is the prior's" in latex_table([("x", (even,), (about,))])


def test_each_footnote_has_letters_of_its_own(analysis: Analysis) -> None:
    """The 27th note was an a, as the first is."""
    rows = Posterior.from_analysis(analysis, {}).rows
    table = latex_table([(f"gel {i}", rows, (caution("misfit", f"off by {i}"),)) for i in range(60)])
    notes = re.findall(r"textsuperscript\{(\w+)\} off by (\d+)", table)
    assert len(notes) == len(dict(notes)) == 60
    assert all(rf"gel {i}\textsuperscript{{{letters}}}" in table for letters, i in notes)


def test_what_latex_would_not_print_is_escaped() -> None:
    assert escaped("G < 1 | > 2") == r"G \textless{} 1 \textbar{} \textgreater{} 2"
    assert escaped(r"50 % of_{a}\b") == r"50 \% of\_\{a\}\textbackslash{}b"
    assert escaped("χ² is −1 ± 2 µm – less …") == r"$\chi$$^2$ is $-$1 $\pm$ 2 $\mu$m -- less \dots{}"
    assert latex_unit("J/m^2") == r"J/m$^{2}$"


def test_netcdf_is_there_already(one: Path) -> None:
    before = sorted(one.iterdir())
    done = call(one, "--netcdf", "--out", one / "x.nc")
    assert done.exit_code == 0
    assert f"{one / 'posterior.nc'} follows the ArviZ schema as it is" in done.output
    assert sorted(one.iterdir()) == before


def test_files_and_faults(one: Path, tmp_path: Path) -> None:
    out = tmp_path / "table.tex"
    assert call(one, "--latex", "--out", out).output == f"table: {out}\n"
    assert out.read_text(encoding="utf-8") == export_table(one, "latex")
    assert (call(one, "--latex", "--out", out).exit_code, call(one, "--out", out, "--force").exit_code) == (2, 0)
    kept = (one / "posterior.nc").read_bytes()
    over = call(one, "--out", one / "posterior.nc", "--force")
    assert (over.exit_code, "is what the command reads, and is not replaced" in over.stderr) == (2, True)
    assert (one / "posterior.nc").read_bytes() == kept
    for flag in ("--csv", "--netcdf"):
        done = call(tmp_path / "nowhere", flag)
        assert (done.exit_code, done.stderr.count("no such file or directory")) == (2, 1)
    (tmp_path / "joint.nc").write_bytes(b"")
    where = f"and no posterior.nc of an estimate; its numbers are in {tmp_path / 'joint.csv'}; it is read by"
    assert call(tmp_path).stderr == f"{tmp_path}: holds a run of the kind joint, {where} en4dvar report\n"
    with pytest.raises(OutputError, match=re.escape(where)):
        load_result(tmp_path)
