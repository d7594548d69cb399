"""An interrupted run continues to the same bits; a changed one, and damaged checkpoints, are named and not used."""

import math
import random
import re
import signal
import time

import pytest
from execution_models import Stops
from run_files import assert_same_results, configuration, interrupt, make_campaign, run_and_signal, run_cli
from toy_config import write_toy

from en4dvar.plumbing.errors import OutputError
from en4dvar.results.pack import PACK, Pack
from en4dvar.runs.interrupt import Interrupted
from en4dvar.runs.runner import run_campaign


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, 2, "execution_models:Stops")
    Stops.calls, Stops.stop_at = 0, 0
    assert run_campaign(configuration(path, folder / "run")).exit_code == 0
    return path, folder / "run", Stops.calls


@pytest.mark.slow
def test_interrupted_at_any_forecast(quiet, tmp_path):
    path, run, n_calls = quiet
    told = []
    for call in range(1, n_calls + 1):
        out = tmp_path / str(call)
        told.append(
            re.search(rf"(\d) of 2 data sets are done and kept in {re.escape(str(out))}", interrupt(path, out, call))[1]
        )
        Stops.calls = 0
        campaign = run_campaign(configuration(path, out), resume=True)
        # A started data set repeats its prior forecast, the runs that show that the model repeats itself, the one
        # call or two of the round that was interrupted, and in a search the last linearisation of the descent before.
        assert Stops.calls <= n_calls - call + 5
        assert campaign.notices == ()
        assert_same_results(out, run)
    first = told.index("1")
    assert told == ["0"] * first + ["1"] * (len(told) - first)
    assert 0.3 < first / len(told) < 0.7


def test_interrupted_again_and_again(quiet, tmp_path):
    path, run, _ = quiet
    reason = interrupt(path, tmp_path / "run", 3)
    for _ in range(20):
        Stops.calls, Stops.stop_at = 0, 7  # the prior forecast, the last linearisation, and a round or an iteration
        try:
            run_campaign(configuration(path, tmp_path / "run"), resume=True)
            break
        except Interrupted as stopped:
            reason = str(stopped)
    else:
        pytest.fail(f"no progress: {reason}")
    Stops.stop_at = 0
    assert_same_results(tmp_path / "run", run)


def test_a_finished_data_set_is_not_computed_again(quiet, tmp_path):
    path, run, n_calls = quiet
    out = tmp_path / "run"
    reason = interrupt(path, out, n_calls - 1)
    assert "1 of 2" in reason
    before = (out / PACK).read_bytes()
    run_campaign(configuration(path, out), resume=True)
    assert (out / PACK).read_bytes().startswith(before)
    written = [(out / name).stat().st_mtime_ns for name in ("posterior.nc", "summary.csv")]
    Stops.calls = 0
    assert run_campaign(configuration(path, out), resume=True).exit_code == 0  # a finished run: nothing left to do
    assert Stops.calls == 0
    assert [(out / name).stat().st_mtime_ns for name in ("posterior.nc", "summary.csv")] == written
    assert_same_results(out, run)


@pytest.mark.parametrize(
    "damaged",
    [
        lambda text: text[:40] + bytes([text[40] ^ 1]) + text[41:],
        lambda text: text[:-1],
        lambda text: text + b"set9,",
        lambda text: b"\xff" + text,
        lambda _: b"",
    ],
    ids=["a bit", "cut", "longer", "no text", "empty"],
)
def test_a_damaged_table_of_a_finished_run_is_written_again(quiet, tmp_path, damaged):
    path, run, _ = quiet
    out = tmp_path / "run"
    run_campaign(configuration(path, out))
    table = (out / "summary.csv").read_bytes()
    (out / "summary.csv").write_bytes(damaged(table))
    run_campaign(configuration(path, out), resume=True)
    assert (out / "summary.csv").read_bytes() == table == (run / "summary.csv").read_bytes()


def changed_seed(path, out):
    path.write_text(path.read_text().replace("seed: 3", "seed: 4"))
    return r"-seed: 3\n\+seed: 4"


def changed_data(path, out):
    data = path.parent / "data" / "set1.csv"
    data.write_text(data.read_text().replace("100,", "101,").replace("# toy", "# other"))
    return r"-set1: [0-9a-f]{64}\n\+set1: [0-9a-f]{64}"


def one_more_file(path, out):
    (path.parent / "data" / "set9.csv").write_text((path.parent / "data" / "set0.csv").read_text())
    return r"\n\+set9: [0-9a-f]{64}"


def other_model(path, out):
    path.write_text(path.read_text().replace("execution_models:Stops", "execution_models:Slow"))
    return r"-  name: execution_models:Stops\n\+  name: execution_models:Slow"


def damaged_identity(path, out):
    file = out / "checkpoints" / "run"
    file.write_bytes(file.read_bytes()[:-5])
    return r"checkpoints/run: damaged or incomplete"


@pytest.mark.parametrize("change", [changed_seed, changed_data, one_more_file, other_model, damaged_identity])
def test_a_changed_run_is_refused_with_the_difference(tmp_path, change):
    path, out = make_campaign(tmp_path, 2, "execution_models:Stops"), tmp_path / "run"
    interrupt(path, out, 9)
    pattern = change(path, out)
    with pytest.raises(OutputError) as refused:
        run_campaign(configuration(path, out), resume=True)
    assert re.search(pattern, str(refused.value)), refused.value
    assert refused.value.exit_code == 2


def test_other_sources_are_refused(tmp_path, monkeypatch):
    path, out = make_campaign(tmp_path, 2, "execution_models:Stops"), tmp_path / "run"
    interrupt(path, out, 9)
    monkeypatch.setattr("en4dvar.results.provenance.source_digest", lambda module: f"another {module}")
    with pytest.raises(OutputError, match=r"\+  toy_models: another toy_models") as refused:
        run_campaign(configuration(path, out), resume=True)
    assert "+  en4dvar: another en4dvar" in str(refused.value)
    assert "+  execution_models: another" in str(refused.value)


@pytest.mark.slow
def test_workers_and_place_may_change(quiet, tmp_path):
    path, run, _ = quiet
    interrupt(path, tmp_path / "run", 9)
    (tmp_path / "run").rename(tmp_path / "moved")
    config = configuration(path, tmp_path / "moved", executor="processes", workers=2)
    assert run_campaign(config, resume=True).exit_code == 0
    assert_same_results(tmp_path / "moved", run)


def cut_short(content):
    return content[:-7]


def altered(content):
    return content[:-90] + bytes([content[-90] ^ 1]) + content[-89:]


def of_an_older_version(content):
    return content.replace(b"en4dvar-checkpoint 4 ", b"en4dvar-checkpoint 0 ", 1)


def of_another_run(content):
    head, rest = content.split(b"\n", 1)
    words = head.split(b" ")
    return b" ".join([*words[:3], b"0" * 64, words[4]]) + b"\n" + rest


def foreign(content):
    return b"PK\x03\x04 something else"


REASONS = {
    cut_short: "damaged or incomplete",
    altered: "damaged or incomplete",
    of_an_older_version: "checkpoint format 0; this version reads 4",
    of_another_run: "belongs to another run",
    foreign: "not a checkpoint of en4dvar",
}


@pytest.mark.parametrize(
    "damage",
    REASONS,
)
def test_a_bad_checkpoint_is_named_and_not_used(quiet, tmp_path, damage):
    file = "checkpoints/set1.iteration"
    path, run, n_calls = quiet
    out = tmp_path / "run"
    interrupt(path, out, n_calls - 1)
    (out / file).write_bytes(damage((out / file).read_bytes()))
    campaign = run_campaign(configuration(path, out), resume=True)
    (notice,) = campaign.notices
    assert REASONS[damage] in notice
    assert f"{file}: " in notice
    assert notice in (out / "run.log").read_text()
    assert_same_results(out, run)


def record(part):
    """Change one bit of a part of the only record there is."""

    def change(pack):
        (entry,) = Pack(pack).entries.values()
        held = bytearray(pack.read_bytes())
        held[{"line": 40, "ending": entry.line + 9, "content": entry.end - 9}[part]] ^= 1
        pack.write_bytes(held)

    return change


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (record("ending"), "datasets.pack/set0: damaged or altered since it was written"),
        (record("content"), "datasets.pack/set0: damaged or altered since it was written"),
        (record("line"), ""),  # nobody knows that it was there
        (lambda pack: pack.unlink(), ""),
        (lambda pack: pack.write_bytes(pack.read_bytes()[:-1]), ""),
        (lambda pack: pack.write_bytes(pack.read_bytes() + pack.read_bytes()[:70]), ""),
        (lambda pack: pack.write_bytes(b"foreign" + pack.read_bytes()), ""),
    ],
)
def test_a_changed_result_is_estimated_again(quiet, tmp_path, change, told):
    path, run, n_calls = quiet
    out = tmp_path / "run"
    interrupt(path, out, n_calls - 1)
    change(out / PACK)
    campaign = run_campaign(configuration(path, out), resume=True)
    assert [told in notice for notice in campaign.notices] == [True] * bool(told)
    assert_same_results(out, run)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.fault("interrupt")
def test_signals_leave_a_run_that_says_how_to_continue(tmp_path, number):
    path, out = write_toy(tmp_path, ("toy_models:Oscillator", "execution_models:Slow")), tmp_path / "run"
    words = ("run", path, "--out", out, "--no-report")
    code, told = run_and_signal(number, out / "run.log", *words, EN4DVAR_TEST_PAUSE=1.0)
    assert code == 130, told
    assert "0 of 1 data sets are done" in told
    assert re.search(r"^to continue: en4dvar run .* --resume$", told, re.MULTILINE)
    assert "Traceback" not in told
    assert run_campaign(configuration(path, out), resume=True).exit_code == 0


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["serial", "threads", "processes"])
def test_killed_at_random_moments(tmp_path, kind, seed):
    """SIGKILL at five random moments of a run, each followed by a resume that may be killed as well.

    The moments are parts of what a whole run takes here and now, the shortest so far: the first may be the slowest by
    far. They are later from kill to kill, for a busy machine.
    """
    path = make_campaign(tmp_path, 4, "execution_models:Slow")
    words = ("run", path, "--no-report", "--set", f"execution.executor={kind}", "--set", "execution.checkpoint_every=0")
    pause = {"EN4DVAR_TEST_PAUSE": 0.01}
    began = time.monotonic()
    quiet = run_cli(*words, "--out", tmp_path / "quiet", **pause)
    assert quiet.returncode == 0, quiet.stderr
    whole = time.monotonic() - began
    draw, kills, finished = random.Random(seed), 0, 0
    while kills < 5 or finished == 0:
        out, resume, longest = tmp_path / f"run{finished}", (), 1.2 * whole
        while True:
            moment = draw.uniform(0.2, 1.0) * longest
            longest *= 1.1
            began = time.monotonic()
            code, told = run_and_signal(signal.SIGKILL, moment, *words, *resume, "--out", out, **pause)
            assert code in (0, -signal.SIGKILL), told
            if code == 0:
                whole = min(whole, math.inf if resume else time.monotonic() - began)
                break
            kills += 1
            resume = ("--resume",) if (out / ".en4dvar-files").exists() else ()
        assert_same_results(out, tmp_path / "quiet")
        finished += 1
