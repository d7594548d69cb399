"""The page on result files against a result file: every group, variable and attribute of a run is on it."""

from __future__ import annotations

import re

import pytest
from doc_pages import ROOT, blocks, hook

from en4dvar.report.result import Result
from en4dvar.results.provenance import provenance

PAGE = ROOT / "docs" / "reference_netcdf.md"


@pytest.fixture(scope="module")
def page():
    """The page as the site shows it."""
    return hook("result_files").with_tables(PAGE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def result(analysis):
    """A result whose parameters and observable have the names that stand for all on the page, where they can."""
    return Result.from_analysis(analysis, {})


def named(result, text):
    """A name of the file as the page writes it: G stands for every parameter, radius for the observable."""
    stem, _, rest = str(text).partition("_")
    if text in result.posterior or str(text).removesuffix("_centre") in result.posterior:
        return "G_centre" if str(text).endswith("_centre") else "G"
    return f"radius_{rest}" if rest and stem == result.observable else "radius" if stem == result.observable else text


def test_every_variable_and_attribute_is_on_the_page(result, page):
    words = set(re.findall(r"`/?([\w]+)`", page))
    coordinates = {"chain", "draw", "time", "path_time", "iteration", "parameter", "time_column"}
    for node in result.tree.subtree:
        group = node.path.strip("/")
        assert not group or group in words, group
        if group == "constant_data":
            continue
        missing = {named(result, v) for v in node.dataset.variables} - words - coordinates
        assert missing == set(), f"{group}: {sorted(missing)}"
    assert set(result.sample_stats.attrs) - words == set()


def test_what_repeats_a_run_is_on_the_page(page):
    assert provenance("", None).keys() - set(re.findall(r"`(\w+)`", page)) == set()


def test_the_page_names_nothing_that_is_not_there(result, page):
    held = page[: page.index("| coordinates |")]
    rows = re.findall(r"^\|\s*(`/[^|]*)?\| ([^|]+)\| ([^|]*)\|", held, re.M)
    assert len(rows) > 60
    sometimes = {"radius_correlation", "radius_huber_weight", "R_eq", "G_pieces"}
    sometimes |= {f"radius_{word}" for word in ("whitened_residual", "studentised", "leverage")}
    sometimes |= {"radius_place", "radius_place_index", "radius_place_share", "wall_mach_reached"}
    sometimes |= {"radius_discrepancy", "radius_discrepancy_std"}
    sometimes |= {f"variance_from_{source}" for source in ("errors", "discrepancy", "prior")}
    groups: list[str] = []
    for head, names, dims in rows:
        groups = re.findall(r"`/(\w+)`", head) or groups
        for group in (g for g in groups if g not in ("fields", "withheld", "posterior_draws")):
            there = {named(result, v): set(map(str, d.dims)) for v, d in result.dataset(group).data_vars.items()}
            for name in set(re.findall(r"`(\w+)`", names)) - sometimes:
                if name.startswith(("what_if_", "ledger_", "influence_", "ln_T")):  # where they can be told
                    continue
                assert name in there, f"{group}: {name}"
                assert there[name] == set(re.findall(r"\w+", dims)), f"{group}: {name} has {there[name]}"


def test_every_row_of_a_series_has_the_words_of_its_meaning_and_unit(page):
    rows = {
        row[0].strip("| "): row[1:]
        for row in re.findall(r"^\|[^|]*\| (`\w+`) \|[^|]*\| ([^|]*) \| ([^|]*) \|", page, re.M)
    }
    assert rows["`analysis_mean`"] == ("its own: coordinate `units`", "mean of the analysis ensemble")
    assert rows["`predicted_mean`"][0] == "its own: coordinate `observation_units`"
    assert (rows["`symbol`"][0], rows["`evidence`"][0]) == ("", "1")
    assert not [row for row in page.splitlines() if "the its" in row]


def test_the_example_reads_a_file(result, tmp_path, monkeypatch):
    (example,) = (b for b in blocks(PAGE) if b.language == "python")
    (tmp_path / "runs" / "quickstart").mkdir(parents=True)
    result.save(tmp_path / "runs" / "quickstart" / "posterior.nc")
    monkeypatch.chdir(tmp_path)
    exec(compile(example.body, str(PAGE), "exec"), {})
