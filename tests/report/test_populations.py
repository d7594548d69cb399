"""``en4dvar compare`` of runs that end with populations: springs of two kinds, and what their files hold."""

from __future__ import annotations

import csv
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import make_campaign
from toy_config import csv_text

import en4dvar
from en4dvar.cli import main
from en4dvar.estimation.population import Effort
from en4dvar.estimation.population.contrast import StraightLine
from en4dvar.inputs.members import read_members
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.report.populations import (
    Difference,
    PopulationsCompared,
    _sentence,
    compare_populations,
    figure,
    medians_table,
    sentences,
)
from en4dvar.report.text import with_symbols
from en4dvar.results.declared import Names
from en4dvar.results.together import load_population
from en4dvar.runs.design_run import run_design
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import population

STIFFER = 1.3
SMALL = Effort(hyper_walkers=32, draws=1500)


@pytest.fixture(scope="module")
def gels(tmp_path_factory):
    """Four oscillators whose springs are 1.6 to 2.05, and four of stiffer ones: runs, and folders of populations."""
    folders = []
    for name, stiffer in (("soft", 1.0), ("stiff", STIFFER)):
        folder = tmp_path_factory.mktemp(name)
        path = make_campaign(folder, 4, "execution_models:Swift")
        for i in range(4):
            (folder / "data" / f"set{i}.csv").write_text(csv_text(k=stiffer * (1.6 + 0.15 * i)))
        run = run_campaign(path, overrides={"output.report": False, "output.directory": str(folder / name)}).directory
        with pytest.MonkeyPatch.context() as patch:  # fresh draws of an emulator say nothing more
            patch.setattr("en4dvar.estimation.population.own._emulated", lambda *of: None)
            population([run], ["k"], folder / f"{name}_only", effort=SMALL)
        folders.append(folder)
    return folders


def only(gels):
    return [gels[0] / "soft_only", gels[1] / "stiff_only"]


def test_a_population_that_is_not_to_be_trusted_is_a_ring_without_a_bar():
    quoted = {"k": np.array([[1.0, 3.0], [2.0, 4.0], [3.0, 5.0]])}
    parameters = {"k": en4dvar.Parameter("k", "N/m")}
    compared = PopulationsCompared(("soft", "stiff"), parameters, {}, quoted, (), (), doubted={"k": ["stiff"]})
    ((panel,),) = (row.panels for row in figure(compared).rows)
    drawn = {(mark.colour, mark.kind): mark.x[np.isfinite(mark.x)].tolist() for mark in panel.marks}
    assert drawn == {
        ("posterior", "line"): [1.0, 3.0], ("posterior", "dots"): [2.0], ("centre", "rings"): [4.0],
    }  # fmt: skip


@pytest.mark.slow
def test_how_much_stiffer_and_how_surely(gels):
    found = en4dvar.compare_populations({"soft": only(gels)[0], "stiff": only(gels)[1]})
    (d,) = found.differences
    assert (d.parameter, d.first, d.second) == ("k", "soft", "stiff")
    medians = [load_population(f / "population.nc").group("posterior")["k_median"].values.ravel() for f in only(gels)]
    ratio, logs = np.median(medians[0]) / np.median(medians[1]), np.log(d.ratio)
    assert d.ratio[1] == pytest.approx(ratio, rel=0.1)
    assert d.ratio[1] == pytest.approx(1 / STIFFER, rel=0.15)
    expected = np.hypot(*(np.log(m).std() for m in medians))
    assert (logs[2] - logs[0]) / 3.29 == pytest.approx(expected, rel=0.35)  # nothing is common, and no pull is left
    assert d.greater < 0.1
    assert found.common == ()
    assert "times that of stiff" in str(found)
    assert len(found.plot().axes) == 1


def test_the_command_its_page_and_tables(gels, tmp_path):
    out = tmp_path / "compared"
    asked = ["compare", *map(str, only(gels)), "--out", str(out), "--against", "5,10"]
    result = CliRunner().invoke(main, asked)
    assert result.exit_code == 0, result.output
    assert "times that of stiff_only" in result.output
    assert "smaller with probability" in result.output
    page = (out / "compare.html").read_text()
    assert "times that of stiff_only" in page
    assert 'id="populations"' in page
    assert "Evidence and fit" not in page
    (row,) = csv.DictReader((out / "differences.csv").read_text().splitlines())
    assert float(row["ratio_q05"]) < float(row["ratio_q50"]) < float(row["ratio_q95"]) < 1
    (of_line,) = csv.DictReader((out / "lines.csv").read_text().splitlines())
    assert float(of_line["slope_q50"]) == pytest.approx(-np.log(float(row["ratio_q50"])) / 5, rel=0.02)


def test_the_numbers_to_quote_are_those_of_each_population_by_itself_unless_known_ones_calibrate_them(gels, tmp_path):
    """The median that the population's own page gives, not the one that its neighbours move."""
    own = {f.name: load_population(f / "population.nc").group("posterior")["k_median"].values for f in only(gels)}
    expected = np.stack([np.quantile(x, (0.05, 0.5, 0.95)) for x in own.values()], axis=1)
    found = en4dvar.compare_populations(only(gels))
    np.testing.assert_allclose(found.quoted["k"], expected, rtol=0.01)
    assert "each population's own median: the numbers to quote" in found.caption
    assert "For a single population quote its own median" in str(found)
    told = dict(line.split("  k ") for line in medians_table(found).splitlines()[1:])
    for name, middle in zip(own, expected[1], strict=True):
        assert float(told[f"{name:10}"].split()[-2]) == pytest.approx(middle, abs=0.02)
    known = en4dvar.compare_populations(only(gels), known={"stiff_only": {"k": "2 ± 0.001 N/m"}})
    np.testing.assert_allclose(known.quoted["k"][:, 1], np.quantile(known.medians["k"][:, 1], (0.05, 0.5, 0.95)), 0.01)
    assert "calibrated by what is known" in known.caption
    assert "quote its own median" not in str(known)


def test_a_known_median_is_taken_as_it_is_and_compared_with_the_data(gels):
    """Nothing is common, so that it tells of its own population alone: the draws of a normal reading."""
    before = en4dvar.compare_populations(only(gels)).medians["k"]
    value = float(np.median(before[:, 1]))
    found = en4dvar.compare_populations(only(gels), known={"stiff_only": {"k": f"{value} ± 0.001 N/m"}})
    assert found.medians["k"][:, 1].std() == pytest.approx(0.001, rel=0.1)
    assert np.median(found.medians["k"][:, 1]) == pytest.approx(value, abs=0.001)
    np.testing.assert_array_equal(found.medians["k"][:, 0], before[:, 0])
    assert any("k of stiff_only is known" in note for note in found.notes)
    assert "Nothing is common" in str(found)


@pytest.mark.parametrize("slip", [1000, 0.001])
def test_a_known_median_far_from_its_own_data_calibrates_nothing(gels, slip):
    """A slip of unit, however wide what is known is said to be: all numbers are those without it."""
    without = en4dvar.compare_populations(only(gels))
    far = en4dvar.compare_populations(only(gels), known={"stiff_only": {"k": f"{2.4 * slip} ± {0.8 * slip} N/m"}})
    np.testing.assert_array_equal(far.medians["k"], without.medians["k"])
    np.testing.assert_array_equal(far.quoted["k"], without.quoted["k"])
    assert not far.calibrated
    assert "std away: it calibrates nothing (is its unit right?)" in str(far)


def test_runs_of_two_gels_are_compared_by_their_populations_and_by_nothing_else(gels, tmp_path):
    runs = [tmp_path / "soft", tmp_path / "stiff"]
    for run, gel, held in zip(runs, gels, only(gels), strict=True):
        shutil.copytree(gel / run.name, run)
        shutil.copy(held / "population.nc", run)
    out = tmp_path / "compared"
    result = CliRunner().invoke(main, ["compare", *map(str, runs), "--stored", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "times that of stiff" in result.output
    page = (out / "compare.html").read_text()
    assert "times that of stiff" in page
    for useless in ("vidence", "estimates.csv", 'id="posteriors"'):  # of bubbles that share nothing but file names
        assert useless not in page
    assert "log-evidence" not in result.output
    assert not (out / "evidence.csv").exists()
    laws = CliRunner().invoke(
        main, ["compare", str(runs[0]), str(shutil.copytree(runs[0], tmp_path / "law")), "--stored"]
    )
    assert laws.exit_code == 0, laws.output
    assert "populations are not compared: compare: soft and law hold the same readings" in laws.output
    assert "log-evidence" in laws.output


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--against", "5"], "2 numbers are needed"),
        (["--against", "5,5"], "not all the same"),
        (["--against", "5;6"], "no list of numbers"),
        (["--apart", "rho"], "rho: not common to the data sets of any population"),
        (["--known", "stiff_only:k"], "is no median such as"),
        (
            ["--known", "stiff_only:k=3 ± 1 N/m", "--known", "stiff_only:k=4 ± 1 N/m"],
            "stiff_only:k is given two values",
        ),
        (["--known", "stif_only:k=3 ± 0.1"], "stif_only, of which something is known: no such run"),
        (["--known", "stiff_only:G=3 ± 0.1"], "G: not a parameter of the population of stiff_only"),
        (["--known", "stiff_only:k=3 N/m"], "say how well it is known"),
        (["--known", "stiff_only:k=3 ± 1 kPa"], "k of stiff_only: "),
    ],
)
def test_bad_questions(gels, tmp_path, more, words):
    result = CliRunner().invoke(main, ["compare", *map(str, only(gels)), "--out", str(tmp_path / "out"), *more])
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output


def test_folders_that_cannot_be_compared(gels, tmp_path):
    with pytest.raises(OutputError, match="at least two"):
        en4dvar.compare_populations(only(gels)[:1])
    with pytest.raises(OutputError, match="holds no population"):
        en4dvar.compare_populations([only(gels)[0], tmp_path])
    with pytest.raises(OutputError, match="the same readings"):
        en4dvar.compare_populations({"one": only(gels)[0], "law": only(gels)[0]})


def grouped(gels, folder):
    """What a run with two groups leaves: a population of each in a folder of its own."""
    for number, (gel, of) in enumerate(zip(only(gels), ("soft gel", "stiff"), strict=True), 1):
        shutil.copytree(gel, folder / "groups" / f"{number}_{of}")
    return folder


@pytest.mark.parametrize("more", [[], ["--against", "3,8"], ["--known", "soft:k=3 ± 0.1"]])
def test_one_run_with_groups_is_told_where_these_are_compared(gels, tmp_path, more):
    run = grouped(gels, tmp_path / "run")
    result = CliRunner().invoke(main, ["compare", str(run), *more])
    assert result.exit_code == 2
    assert "compares its 2 groups itself" in result.output
    assert "population.known" in result.output
    folders = shlex.split(result.output.partition("compare the folders ")[2])
    again = CliRunner().invoke(main, ["compare", *folders, "--against", "3,8", "--out", str(tmp_path / "compared")])
    assert again.exit_code == 0, again.output


def test_what_to_measure_next_follows_from_a_population_and_not_from_a_campaign(gels, tmp_path):
    """The prior of the next data set's spring is what the population says of one; damping belongs to each."""
    plan = tmp_path / "plan.yaml"
    plan.write_text((gels[0] / "toy.yaml").read_text())
    options = {"design.about": ["k"], "design.times": {"from": "0.1 s", "to": "2 s", "step": "0.2 s"}}
    options |= {"design.method": "linear", "output.report": False, "parameters.A": "100 um"}
    before, _ = run_design(plan, overrides=options, out=tmp_path / "before")
    after, _ = run_design(plan, overrides=options, out=tmp_path / "after", after=only(gels)[0])
    assert after.rows[0].result.gain < before.rows[0].result.gain - 0.5
    members = read_members(only(gels)[0] / "population.nc", {"k": ("N/m", "")})["k"]
    stored = load_population(only(gels)[0] / "population.nc")
    np.testing.assert_array_equal(members, stored.group("posterior")["k_next"].values.ravel())
    with pytest.raises(ConfigError, match="a campaign of 4 data sets without a population; give the run of one data"):
        run_design(plan, overrides=options, out=tmp_path / "no", after=gels[0] / "soft")
    with pytest.raises(ConfigError, match=r"several populations; give the folder of one of them: .*1_soft gel"):
        run_design(plan, overrides=options, out=tmp_path / "no", after=grouped(gels, tmp_path / "run"))


def test_words_of_a_difference():
    d = Difference("G", "a", "b", "kPa", (2.0, 3.0, 4.0), (4.0, 5.0, 6.0), 0.9996, (1.5, 3.0, 6.0))
    assert _sentence(d) == (
        "G of a is 3.00 (5–95 %: 2.00 … 4.00) times that of b, and 5.00 (4.00 … 6.00) kPa more; it is larger with "
        "probability over 0.999 (were nothing common: 1.5 … 6.0 times)."
    )
    shift = replace(
        d, ratio=(np.nan,) * 3, difference=(-6.0, -5.0, -4.0), greater=0.02, untrusted="chain-not-converged"
    )
    assert _sentence(shift).startswith("G of a is 5.00 (4.00 … 6.00) kPa less than that of b; it is smaller with")
    assert _sentence(shift).endswith("not to be trusted: chain-not-converged.")


@pytest.mark.parametrize(("sign", "chance"), [(1, "0.999"), (-1, "0.001")])
def test_a_trend_is_no_surer_downwards_than_upwards(gels, sign, chance):
    """No number of draws says more than 0.999 of a rise; of a fall it said 0.000."""
    of = compare_populations(only(gels))
    slope = sign * np.linspace(1.0, 2.0, 50)
    of = replace(of, lines={"k": StraightLine(slope, slope, 0.0, 0)})
    assert any(f"it rises with probability {chance}" in words for words in sentences(of))


def test_a_page_writes_parameters_by_their_symbols_and_the_terminal_by_their_names(gels):
    """The page of one bubble says μ where that of its population said mu."""
    of = compare_populations(only(gels), known={"soft_only": {"k": "1.8 ± 0.1 N/m"}})
    of = replace(of, symbols=Names({"k": r"$\kappa$", "c": "$c_1$"}), common=("c",))
    plain, written = list(sentences(of)), list(sentences(of, of.symbols))
    assert plain[0].startswith("k of soft_only")
    assert "alike: c." in plain[1]
    assert written[0].startswith(r"$\kappa$ of soft_only")
    assert "alike: $c_1$." in written[1]
    (note,) = [words for words in written if "is known" in words]
    assert note.startswith(r"$\kappa$ of soft_only is known")
    assert with_symbols(note).startswith("<i>κ</i> of soft_only")
