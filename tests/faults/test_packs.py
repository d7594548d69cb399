"""Whatever happens to the pack of a campaign: each data set is given as it was or missed by name; --resume mends."""

import csv
import io
import random
import shutil
from contextlib import suppress

import pytest
from click.testing import CliRunner
from rows import row
from run_files import assert_same_results, configuration, make_campaign

from en4dvar import report
from en4dvar.cli import main
from en4dvar.report.compare import compare_runs
from en4dvar.report.export import export_table
from en4dvar.results.pack import PACK, Pack
from en4dvar.results.provenance import IDENTITY
from en4dvar.results.run_results import MOST_NAMES, LackingError
from en4dvar.runs.engine import write_report
from en4dvar.runs.finished import finished
from en4dvar.runs.rerun import rerun
from en4dvar.runs.runner import run_campaign

SETS = {f"set{i}" for i in range(4)}


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, 4)
    run_campaign(configuration(path, folder / "run", executor="serial"))
    return path, folder / "run"


def flip(content, draw):
    place = draw.randrange(len(content))
    return content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :]


def flip_in_a_line(content, draw):
    lines = [place for place in range(len(content)) if content.startswith(b"\nen4dvar-pack ", place)]
    place = draw.choice(lines) + draw.randrange(300)
    return content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :]


def cut(content, draw):
    return content[: draw.randrange(len(content))]


def zero(content, draw):
    place, n = draw.randrange(len(content)), draw.choice([1, 64, 4096, 20_000])
    return content[:place] + bytes(len(content[place : place + n])) + content[place + n :]


def take_out(content, draw):
    place = draw.randrange(len(content))
    return content[:place] + content[place + draw.choice([1, 64, 4096, 20_000]) :]


def rows_of(text):
    return {line["dataset"]: line for line in csv.DictReader(io.StringIO(text))}


def exported(run):
    """The rows by data set, and what is said of the others."""
    try:
        return rows_of(export_table(run)), ""
    except LackingError as error:
        return rows_of(error.rest or ""), str(error)


def require_all_told(run, whole):
    """Every reader gives a data set as it was, or names it."""
    rows, told = exported(run)
    assert all(line == whole[name] for name, line in rows.items())
    missed = SETS - rows.keys()
    assert all(f"{name} (" in told for name in missed), (missed, told)
    assert bool(missed) == bool(told)
    if not missed:
        assert len(finished([run], False, None)[1]) == 4
        write_report(run)
        return missed
    assert row("pack-damaged").told(told)
    with suppress(LackingError):  # told in the same words as by export
        page = write_report(run)
        pytest.fail(f"{page} without a word")
    assert not rows or all(name in (run / "report.html").read_text() for name in SETS)
    with pytest.raises(LackingError, match=" ") as refused:  # of joint and population
        finished([run], False, None)
    assert all(f"{name} (" in str(refused.value) for name in missed)
    return missed


def require_mended(path, run, undamaged):
    assert run_campaign(configuration(path, run, executor="serial"), resume=True).exit_code == 0
    assert_same_results(run, undamaged)
    assert exported(run) == exported(undamaged)


def besieged(quiet, folder, monkeypatch, damages, seed, many):
    path, undamaged = quiet
    monkeypatch.setattr(report, "draw", lambda *_, **__: [])
    monkeypatch.setattr(report, "_write_page", lambda *_: None)
    content, whole, draw = (undamaged / PACK).read_bytes(), exported(undamaged)[0], random.Random(seed)
    hit = 0
    for i in range(many):
        run = folder / f"run{i}"
        shutil.copytree(undamaged, run)
        damage = damages[i % len(damages)]
        (run / PACK).write_bytes(damage(content, draw))
        if i % 3 == 0:  # a campaign that has not come to its end
            (run / "posterior.nc").unlink()
        hit += bool(require_all_told(run, whole))
        require_mended(path, run, undamaged)
        shutil.rmtree(run)
    return hit


@pytest.mark.slow
@pytest.mark.fault("pack-damaged")
def test_no_set_vanishes_from_a_damaged_pack(quiet, tmp_path, monkeypatch):
    assert besieged(quiet, tmp_path, monkeypatch, (flip_in_a_line, flip, cut, zero, take_out), 1, 5)


@pytest.mark.slow
@pytest.mark.parametrize("many", [30, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.fault("pack-damaged")
def test_no_set_vanishes_from_many_damaged_packs(quiet, tmp_path, monkeypatch, many):
    assert besieged(quiet, tmp_path, monkeypatch, (flip_in_a_line, flip, cut, zero, take_out), many, many) > many / 2


@pytest.mark.parametrize("gone", [lambda pack: pack.unlink(), lambda pack: pack.write_bytes(b"")])
def test_a_pack_that_is_gone_is_missed_by_all_its_names(quiet, tmp_path, gone):
    run = shutil.copytree(quiet[1], tmp_path / "run")
    gone(run / PACK)
    rows, told = exported(run)
    assert not rows
    assert all(name in told for name in SETS)
    require_mended(quiet[0], run, quiet[1])


def line_of(pack, name):
    """Damage the line of the last record of a data set."""
    held, entry = bytearray(pack.read_bytes()), Pack(pack).entries[name]
    held[entry.begin + 40] ^= 1
    pack.write_bytes(held)


@pytest.mark.parametrize("lost", [(), (IDENTITY,), ("posterior.nc",)])
def test_one_list_of_names_is_enough(quiet, tmp_path, lost):
    run = shutil.copytree(quiet[1], tmp_path / "run")
    for name in lost:
        content = (run / name).read_bytes()
        (run / name).write_bytes(content[: len(content) // 2])
    assert exported(run) == exported(quiet[1])
    line_of(run / PACK, "set2")
    rows, told = exported(run)
    assert (rows.keys(), "set2 (" in told) == (SETS - {"set2"}, True)


def test_without_a_list_it_is_said_that_something_is_lost(quiet, tmp_path):
    shutil.copy(quiet[1] / PACK, tmp_path)
    assert exported(tmp_path)[0].keys() == SETS
    line_of(tmp_path / PACK, "set2")
    rows, told = exported(tmp_path)
    assert rows.keys() == SETS - {"set2"}
    assert "some data set (its name is lost)" in told


def test_the_failure_that_came_before_is_not_taken_for_the_last_word(tmp_path):
    """A set that failed, was mended and estimated has two records."""
    path, run = make_campaign(tmp_path, 4), tmp_path / "run"
    data = tmp_path / "data" / "set2.csv"
    good = data.read_text()
    data.write_text("time,radius\n")
    assert run_campaign(configuration(path, run)).exit_code == 1
    data.write_text(good)
    assert run_campaign(configuration(path, run), resume=True).exit_code == 0
    assert exported(run)[0].keys() == SETS
    line_of(run / PACK, "set2")
    rows, told = exported(run)
    assert (rows.keys(), "set2 (" in told) == (SETS - {"set2"}, True)


def test_one_wrong_bit_is_not_another_version(quiet, tmp_path):
    run = shutil.copytree(quiet[1], tmp_path / "run")
    content = bytearray((run / PACK).read_bytes())
    content[len("\nen4dvar-pack ")] ^= 2  # "1" becomes "3"
    (run / PACK).write_bytes(content)
    rows, told = exported(run)
    assert (rows.keys(), "set0 (" in told) == (SETS - {"set0"}, True)


def test_what_compares_and_repeats_refuses(quiet, tmp_path):
    run = shutil.copytree(quiet[1], tmp_path / "run")
    line_of(run / PACK, "set1")
    for read in (lambda: compare_runs([run, quiet[1]]), lambda: rerun(run)):
        with pytest.raises(LackingError, match=r"set1 \(not there: lost, or not estimated yet\)"):
            read()


def test_the_command_gives_the_others_and_fails(quiet, tmp_path):
    run = shutil.copytree(quiet[1], tmp_path / "run")
    line_of(run / PACK, "set1")
    done = CliRunner().invoke(main, ["export", str(run)])
    assert done.exit_code == 1
    assert rows_of(done.stdout).keys() == SETS - {"set1"}
    assert done.stderr.count("\n") == 1
    assert row("pack-damaged").told(done.stderr)


@pytest.mark.slow
def test_many_names_are_counted(quiet, tmp_path):
    path, run = make_campaign(tmp_path, MOST_NAMES + 4), tmp_path / "run"
    run_campaign(configuration(path, run))
    (run / PACK).write_bytes(b"")
    assert "and 4 more; 'en4dvar run'" in exported(run)[1]
