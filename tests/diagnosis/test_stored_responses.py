"""What a posterior responds to, in files, tables and on the page."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from acting import Acting, acting_problem
from doc_pages import hook
from run_files import add_to_pack

from en4dvar.diagnosis.response.what_if import exclusion
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative
from en4dvar.plumbing.errors import OutputError
from en4dvar.report import write_pages
from en4dvar.report.responses import StoredShift, exceeding, sentence, shift_text, stored_ledger, stored_shifts
from en4dvar.report.result import Result, load_result
from en4dvar.results.campaign_file import save_campaign
from en4dvar.results.pack import PACK, Pack
from en4dvar.results.provenance import provenance
from en4dvar.results.store import load_stored
from en4dvar.schemes.settings import AssimilationSettings

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference_netcdf.md"
TIMES = [0.6, 0.7, 0.8, 1.0, 1.4]


def analyse():
    model = Acting()
    model.alternatives = (
        Alternative("clock", "time <ran> 0.1 % slower", times=1.001),
        Alternative("scale", "all were 30 % larger", values=1.3),
        Alternative("other", "it were other", model=None, values=np.nan),
    )
    return assimilate(acting_problem(TIMES, model, std=0.02), AssimilationSettings(members=12), 1)


@pytest.fixture(scope="module")
def analysis():
    return analyse()


@pytest.fixture(scope="module")
def run_dir(analysis, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    Result.from_analysis(analysis, provenance("name: test\n")).save(folder / "posterior.nc")
    write_pages(folder)
    return folder


def lines(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_shifts_are_read_back_the_largest_first(analysis, run_dir):
    rows = stored_shifts(load_stored(run_dir / "posterior.nc"))
    assert (
        [row[0].alternative for row in rows]
        == [shift.name for shift in analysis.what_if]
        == ["scale", "other", "clock"]
    )
    for row, shift in zip(rows, analysis.what_if, strict=True):
        np.testing.assert_array_equal([s.change for s in row], shift.change)
        np.testing.assert_array_equal([s.in_std for s in row], shift.in_std)
        assert {s.reason for s in row} == {shift.reason}


def test_the_ledger_is_read_back(analysis, run_dir):
    ((u, x),) = stored_ledger(load_stored(run_dir / "posterior.nc"))
    assert (u.parameter, u.quantity, u.label, x.quantity) == ("theta", "u", "input", "x")
    np.testing.assert_array_equal([u.low, u.median, u.high], analysis.ledger.quantiles[0, 0])


def test_tables_hold_every_line(run_dir):
    shifts, entries = lines(run_dir / "what_if.csv"), lines(run_dir / "ledger.csv")
    assert len(shifts) == 3 * 2
    assert shifts[0]["alternative"] == "scale"
    assert abs(float(shifts[0]["change_in_std"])) > 1
    assert [e["quantity"] for e in entries] == ["u", "x"]


def test_the_page_shows_both_and_escapes_words(run_dir):
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    assert "If all were 30 % larger, " in page
    assert "times its error bar" in page
    assert "time &lt;ran&gt; 0.1 % slower" in page
    assert "only a fit with it shows this" in page
    assert page.index("More than the error bar") < page.index("<h2>More")
    assert 'id="ledger"' in page


@pytest.mark.slow
def test_a_page_without_them_is_silent(run_dir, tmp_path):
    model = Acting()
    model.path_quantities = ()
    plain = assimilate(acting_problem(TIMES, model), AssimilationSettings(members=12), 1)
    Result.from_analysis(plain, provenance("name: test\n")).save(tmp_path / "posterior.nc")
    write_pages(tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "what-if" not in page.split("</style>")[1]
    assert not (tmp_path / "what_if.csv").exists()


def test_a_campaign_keeps_them(run_dir, tmp_path):
    for name in ("a_1", "b"):
        add_to_pack(tmp_path, name, load_result(run_dir / "posterior.nc"))
    path = save_campaign(tmp_path / "posterior.nc", Pack(tmp_path / PACK), {"a 1": "a_1", "b": "b"}, {}, {})
    with netCDF4.Dataset(path) as file:
        stats = file["sample_stats"]
        assert stats["what_if_change"].dimensions == ("dataset", "alternative", "parameter")
        assert list(stats["alternative"][:]) == ["clock", "scale", "other"]
        np.testing.assert_allclose(np.sum(stats["ledger_weight"][:], axis=-1), 1.0)
    for place in (tmp_path, path):
        with pytest.raises(OutputError, match=r"a campaign of 2 data sets; give the address .*datasets\.pack/a_1, or"):
            load_result(place)
    with pytest.raises(OutputError, match=r"a campaign of 2 data sets; give the address .*datasets\.pack/a_1$"):
        load_result(tmp_path / PACK)
    assert load_result(tmp_path / PACK / "a_1").parameters


def test_every_variable_is_documented(run_dir):
    page = hook("result_files").with_tables(PAGE.read_text(encoding="utf-8"))
    words = set(re.findall(r"`([\w]+)`", page))
    stats = load_result(run_dir / "posterior.nc").sample_stats
    present = {str(name) for name in stats.data_vars if str(name).startswith(("what_if_", "ledger_"))}
    of_quantities = {name for name in present if re.fullmatch(r"ledger_(u|x)(_quantiles)?", name)}
    assert len(of_quantities) == 4
    assert present - of_quantities <= words
    assert {name for name in words if name.startswith("what_if_")} - {"what_if_runs"} <= present


@pytest.mark.parametrize(
    ("change", "relative", "in_std", "words"),
    [
        (0.012, 0.1269, 2.41, "+12.7 %"),
        (-0.055, np.nan, -1.37, "−0.055 µs"),
        (5.9, 2.8, 1.3, "× 3.8"),  # however wide its interval
        (-0.8, -0.62, -0.9, "× 0.38"),
        (0.0, 0.0, 0.0, "0.000 %"),
        (np.nan, np.nan, np.nan, "–"),
    ],
)
def test_a_shift_is_as_fine_as_its_error_bar(change, relative, in_std, words):
    shift = StoredShift("a", "…", "t", "us", change, relative, in_std, 0.0, "", "$t$")
    assert shift_text(shift) == words


def test_a_value_that_doubles_at_least_is_told_as_a_factor():
    shift = StoredShift("wall", "a wall were near", "G", "kPa", 5.9, 2.8, 1.34, 0.0, "", "$G$")
    assert "would be 3.8 times as large (1.3 times its error bar)" in sentence([shift])
    assert "would be 42 % higher" in sentence([shift._replace(relative=0.42, change=0.9)])


def test_an_alternative_that_the_readings_exclude_has_its_misfit_instead_of_shifts():
    """45 readings fitted to χ² of 36, or of 180 where their errors are stated too small."""
    assert exclusion(0.8, 45, 3438.7) == "the readings exclude it: χ² is 6913 for 45 readings"
    assert exclusion(0.8, 45, 20.0) == exclusion(4.0, 45, 40.0) == exclusion(np.nan, 0, np.nan) == ""
    shift = StoredShift("gas", "heat flowed", "G", "kPa", 5.9, 2.8, 26.0, 3438.7, "", "$G$", exclusion(0.8, 45, 3438.7))
    assert exceeding([[shift]]) == []
    assert exceeding([[shift._replace(excluded="")]])
