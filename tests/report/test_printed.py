"""A number that cannot be trusted is printed as such, and warnings come along, in every output."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import add_to_pack

from en4dvar.cli import main
from en4dvar.commands.run import _tell
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.diagnosis.influence import Influence
from en4dvar.estimation.summary import INTERVAL, results_table
from en4dvar.plumbing.caution import caution
from en4dvar.report import write_pages
from en4dvar.report.compare import compare_runs, comparison_table, estimates_table, write_comparison
from en4dvar.report.export import export_table
from en4dvar.report.responses import influence, reading_words
from en4dvar.report.result import Result
from en4dvar.report.text import number_like, plus_minus
from en4dvar.results.provenance import provenance
from en4dvar.results.store import load_stored
from en4dvar.runs.campaign import Campaign, DatasetOutcome

AT_BOUND = caution("at-bound", "half of the members of G pile up", parameters=("G",))
LITTLE = caution("not-informed", "R0 is hardly informed by the data", parameters=("R0",))
MISFIT = caution("misfit", "χ² of the residuals is 400 where about 38 is expected")


def written(folder, analysis, *cautions, name=None):
    """The run directory of a single result, or of a campaign with one of that ``name``."""
    folder.mkdir(parents=True, exist_ok=True)
    result = Result.from_analysis(replace(analysis, cautions=cautions), provenance("name: test\n"))
    result.save(folder / "posterior.nc") if name is None else add_to_pack(folder, name, result)
    return folder


@pytest.fixture
def bounded(tmp_path, analysis):
    """G is not to be trusted, R0 is hardly informed, the rest is fine."""
    return written(tmp_path / "bounded", analysis, AT_BOUND, LITTLE)


def text_of(html):
    html = re.sub(r"<svg.*?</svg>|<style.*?</style>", "", html, flags=re.S)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", html)).split())


def test_of_several_modes_quantiles_are_printed_everywhere(tmp_path, one_figure, analysis):
    """And mean ± std nowhere; what is not apart keeps them."""
    words = "the posterior has 2 modes, G = 2 and 8 kPa, of weights 0.60 and 0.40; members are drawn from all of them"
    run = written(tmp_path / "modes", analysis, caution("several-modes", words, parameters=("G",)))
    alive = np.delete(analysis.posterior, 3, axis=0)
    low, high = member_quantiles(alive[:, 0], (0.05, 0.95)) / 1e3
    mean, std = alive[:, 0].mean() / 1e3, alive[:, 0].std(ddof=1) / 1e3
    page = text_of(write_pages(run).read_text(encoding="utf-8"))
    assert f"G = {number_like(low, std)} to {number_like(high, std)} kPa of several modes" in page
    assert plus_minus(mean, std) not in page
    other = plus_minus(alive[:, 1].mean(), alive[:, 1].std(ddof=1))
    assert f"{other} Pa·s" in page
    latex = export_table(run, "latex")
    assert f"${number_like(low, std)}$ to ${number_like(high, std)}$\\textsuperscript{{a,b}}" in latex
    assert "5 to 95 \\% of a posterior of several modes" in latex
    assert f"{number_like(mean, std)} \\pm" not in latex
    (row,) = (row for row in csv.DictReader(export_table(run).splitlines()) if row["name"] == "G")
    assert (row["mean"], row["std"]) == ("", "")
    assert float(row["q05"]) == pytest.approx(low)
    assert "several modes" in row["informed"]
    table = results_table({"set": [r for r in load_stored(run / "posterior.nc").rows if r.name == "G"]})
    assert table.splitlines()[-1].split()[3:5] == ["-", "-"]


def test_page_prints_a_value_without_interval(bounded, one_figure, analysis):
    text = text_of(write_pages(bounded).read_text(encoding="utf-8"))
    assert "G = 2.8 kPa not to be trusted at bound" in text
    assert "not to be trusted: at bound" in text
    alive = np.delete(analysis.posterior, 3, axis=0)
    assert f"± {alive[:, 0].std(ddof=1) / 1e3:.2f} kPa" not in text
    assert f"{plus_minus(alive[:, 1].mean(), alive[:, 1].std(ddof=1))} Pa·s" in text
    assert "data say little" in text
    assert "DFS share (degrees of freedom for signal): the share of the prior variance that the data removed" in text
    assert "– not known, because intervals are not to be trusted" in text


def test_csv_leaves_the_interval_out(bounded):
    rows = {row["name"]: row for row in csv.DictReader(export_table(bounded).splitlines())}
    assert all(rows["G"][key] == "" for key in INTERVAL)
    assert float(rows["G"]["mean"]) > 0
    assert (rows["G"]["untrusted"], rows["G"]["informed"]) == ("at-bound", "")
    assert all(float(rows["mu"][key]) for key in INTERVAL)
    assert (rows["mu"]["untrusted"], rows["mu"]["informed"]) == ("", "determined by the data")
    assert rows["R0"]["informed"] == "data say little"
    assert {row["warnings"] for row in rows.values()} == {"at-bound not-informed"}
    members = list(csv.DictReader(export_table(bounded, "members").splitlines()))
    assert {row["warnings"] for row in members} == {"at-bound not-informed"}


def test_latex_has_footnotes_and_no_interval(bounded):
    lines = export_table(bounded, "latex").splitlines()
    cells = {line.split("&")[0].strip(): line for line in lines if line.count("&") == 4}
    assert re.search(r"& \$2\.8\d?\$\\textsuperscript\{a,b\} & -- \\\\", cells["$G$"])
    assert re.search(r"\^\{\+0\.028\}_\{-0\.009\}\$\\textsuperscript\{c\}", cells[r"$\mu$"])
    assert r"\pm" in cells["$t_s$"].split("&")[3]
    assert cells["$R_0$"].split("&")[3].endswith(r"\textsuperscript{d} ")
    end = lines.index(r"  \bottomrule")
    notes = [re.sub(r".*textsuperscript\{(.)\} (.*)\} \\\\", r"\1 \2", line) for line in lines[end + 1 : -1]]
    assert notes[:2] == ["a not to be trusted: at bound", "b half of the members of G pile up"]
    assert "skewed" in notes[2]
    assert notes[3].startswith("d the data say little about it")


def test_latex_of_a_campaign_marks_single_numbers(tmp_path, analysis, renamed):
    for name, cautions in (("one", (MISFIT,)), ("two", ())):
        written(tmp_path, renamed(analysis, name), *cautions, name=name)
    one, two = (line for line in export_table(tmp_path, "latex").splitlines() if line.startswith(("  one", "  two")))
    assert one.startswith(r"  one\textsuperscript{a} &")
    assert one.count(r"\textsuperscript{b}") == 4
    assert r"\pm" not in one
    assert (two.count(r"\pm"), two.count("^{+")) == (2, 2)  # of what is skewed the sides differ


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX here")
def test_latex_compiles(bounded, tmp_path):
    document = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n"
    (tmp_path / "t.tex").write_text(f"{document}{export_table(bounded, 'latex')}\\end{{document}}\n", encoding="utf-8")
    subprocess.run(["pdflatex", "-interaction=nonstopmode", "t.tex"], cwd=tmp_path, check=True, capture_output=True)


def test_terminal_prints_a_value_without_interval(bounded):
    table = results_table({"A": compare_result(bounded).rows})
    head, first, second = table.splitlines()[:3]
    assert head.endswith("not to be trusted")
    assert first.split()[3:] == ["2.8", "-", "-", "-", "-", "at-bound"]
    assert len(second.split()) >= 8


def compare_result(folder):
    from en4dvar.report.result import load_result

    return load_result(folder / "posterior.nc")


def test_terminal_tells_the_worst_first(tmp_path, capsys):
    outcomes = (
        DatasetOutcome("a", warnings=(LITTLE, AT_BOUND)), DatasetOutcome("b", warnings=(MISFIT,)),
    )  # fmt: skip
    _tell(Campaign(tmp_path, outcomes), with_report=False)
    told = re.findall(r"\[([a-z-]+)\]", capsys.readouterr().err)
    assert told == ["misfit", "at-bound", "not-informed"]


def test_page_and_index_stand_in_the_same_order(tmp_path, analysis, renamed, one_figure):
    mixed = (LITTLE, AT_BOUND, MISFIT)  # as a file of anybody might hold them
    written(tmp_path, renamed(analysis, "mixed"), *mixed, name="mixed")
    written(tmp_path, renamed(analysis, "mild"), LITTLE, name="mild")
    index = write_pages(tmp_path).read_text(encoding="utf-8")
    page = (tmp_path / "pages" / "mixed.html").read_text(encoding="utf-8")
    expected = ["misfit", "at-bound", "not-informed"]
    assert re.findall(r"<code>(misfit|at-bound|not-informed)</code>", page) == expected
    assert re.findall(r"(misfit|at bound|not informed) in 1 data set|(not informed) in 2 data sets", index) == [
        ("misfit", ""), ("at bound", ""), ("", "not informed"),
    ]  # fmt: skip
    assert "(?)" not in index + page
    assert ", not to be trusted" in index
    assert 'title="not to be trusted: misfit, at bound"' in index


def test_comparison_carries_warnings(tmp_path, analysis, bounded):
    fine, bad = written(tmp_path / "fine", analysis), written(tmp_path / "bad", analysis, MISFIT)
    comparison = compare_runs([fine, bad, bounded])
    assert [(c.run, c.caution.code) for c in comparison.cautions] == [
        ("bad", "misfit"), ("bounded", "at-bound"), ("bounded", "not-informed"),
    ]  # fmt: skip
    terminal = comparison_table(comparison)
    assert "warning: bad: A_E2_synthetic: χ² of the residuals" in terminal
    rows = [line for line in estimates_table(comparison).splitlines() if line.startswith("G ")]
    assert [line.split()[-1] for line in rows[1:]] == ["misfit", "at-bound"]
    assert rows[1].split()[-4:-1] == ["-", "-", "-"]
    page = write_comparison(comparison, tmp_path / "out").read_text(encoding="utf-8")
    assert "bad, A_E2_synthetic: χ² of the residuals" in unescape(page)
    assert "not to be trusted: misfit" in page
    with (tmp_path / "out" / "estimates.csv").open(encoding="utf-8") as file:
        estimates = {(row["run"], row["name"]): row for row in csv.DictReader(file)}
    assert estimates["bad", "mu"]["std"] == ""
    assert estimates["bad", "mu"]["warnings"] == "misfit"
    assert float(estimates["fine", "mu"]["std"]) > 0
    with (tmp_path / "out" / "evidence.csv").open(encoding="utf-8") as file:
        assert {row["run"]: row["warnings"] for row in csv.DictReader(file)} == {
            "fine": "", "bad": "misfit", "bounded": "at-bound not-informed",
        }  # fmt: skip


def test_a_verdict_between_runs_that_warn_is_not_to_be_trusted(tmp_path, analysis):
    runs = [
        written(tmp_path / "fine", analysis),
        written(tmp_path / "bad", replace(analysis, log_evidence=5.0), MISFIT),
    ]
    Result.from_analysis(replace(analysis, log_evidence=1.0), provenance("name: test\n")).save(runs[0] / "posterior.nc")
    verdict = compare_runs(runs).verdict("A_E2_synthetic")
    assert verdict.startswith("bad is preferred")
    assert verdict.endswith("not to be trusted before the warnings of bad (misfit) are settled")


def test_export_command_carries_them(bounded):
    done = CliRunner().invoke(main, ["export", str(bounded), "--latex"])
    assert done.exit_code == 0
    assert "not to be trusted: at bound" in done.output


def influenced(analysis):
    in_std = np.zeros((4, 40))
    in_std[1, 7] = -0.82
    change = in_std * analysis.posterior[np.arange(24) != 3].std(axis=0, ddof=1)[:, None]
    shape = np.zeros(40)
    how = np.ones(40, dtype=int)
    how[30:] = 2
    return replace(analysis, influence=Influence(change, in_std, shape, how))


def test_page_names_the_reading_that_decides(tmp_path, analysis):
    marked = influenced(analysis)
    result = Result.from_analysis(marked, provenance("name: test\n"))
    moving, far = map(str, reading_words(result))
    assert "Without the reading at 16 µs on the clock of the data <i>μ</i> would change most" in moving
    assert "0.8 posterior standard deviations" in moving
    size = marked.influence.change[1, 7]
    assert f"by {size:.2g} Pa·s".replace("-", "−") in moving
    assert moving.endswith("For 10 of 40 readings only a fit without them shows this.")
    assert "from what the prior predicts" in far
    panels = [panel for row in influence(result).rows for panel in row.panels]
    assert [panel.ylabel for panel in panels[:2]] == ["$G$", r"$\mu$"]
    assert len(panels) == 5
    drawn = panels[1].marks[-1]
    assert drawn.x[7] == pytest.approx(16.0)
    assert list(drawn.y) == list(marked.influence.in_std[1])


def test_page_says_why_influence_is_not_told(analysis):
    result = Result.from_analysis(analysis, provenance("name: test\n"))
    assert str(reading_words(result)[0]).startswith("The effect of leaving out a reading is not known: too few")
    assert len(influence(result).rows) == 1
