"""Ctrl-C at a terminal, where every process of the run gets it, and what is left of workers without a main process."""

import fcntl
import itertools
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from contextlib import suppress

import psutil
import pytest
from rows import row
from run_files import assert_same_results, command, configuration, environment, make_campaign, run_cli

from en4dvar.cli import Commands, main
from en4dvar.results.run_results import result_files
from en4dvar.runs import interrupt
from en4dvar.runs.interrupt import heeded, terminate_as_interrupt
from en4dvar.runs.runner import run_campaign

CTRL_C = b"\x03"


class Terminal:
    """A command at a terminal of its own; ``told`` is what it has shown."""

    def __init__(self, words, **variables):
        self.end, theirs = pty.openpty()
        self.told = ""

        def take_over():
            fcntl.ioctl(0, termios.TIOCSCTTY)
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which tests run under nohup ignore, and so would it

        self.process = subprocess.Popen(
            words, stdin=theirs, stdout=theirs, stderr=theirs, env=environment(TERM="xterm", **variables),
            start_new_session=True, preexec_fn=take_over,
        )  # fmt: skip
        os.close(theirs)

    def read_until(self, pattern):
        """Until ``pattern`` is shown, or to the end."""
        while not re.search(pattern, self.told):
            try:
                more = os.read(self.end, 1 << 16)
            except OSError:  # the other end is closed
                return False
            self.told += more.decode("utf-8", "replace")
        return True

    def read_until_logged(self, log, words):
        """Until the file ``log`` holds ``words``: what is shown is one data set's last record, whichever came last."""
        while self.process.poll() is None and not (log.exists() and words in log.read_text()):
            if select.select([self.end], [], [], 0.01)[0]:
                self.told += os.read(self.end, 1 << 16).decode("utf-8", "replace")
        return self.process.poll() is None

    def press(self, keys):
        os.write(self.end, keys)

    def close(self):
        self.read_until(r"$^")
        os.close(self.end)
        return self.process.wait()


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """The campaign that all tests here run, undisturbed."""
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, 4, "execution_models:Waits")
    go_on(path, folder / "run", resume=False)
    return folder / "run"


def go_on(path, out, resume=True):
    """Here, and not in a process of its own: what is tested has ended."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EN4DVAR_TEST_FLAG", str(path))  # which is there: nothing waits
        assert run_campaign(configuration(path, out, executor="serial"), resume=resume).exit_code == 0


def words(path, out, kind):
    return ["run", path, "--out", out, "--no-report", "--set", f"execution.executor={kind}", "--workers", 2]


@pytest.mark.parametrize(
    ("kind", "presses"),
    [("serial", 1)]
    + [
        pytest.param(*case, marks=pytest.mark.slow)
        for case in itertools.product(("serial", "threads", "processes", "dask"), (1, 2))
        if case != ("serial", 1)
    ],
)
@pytest.mark.fault("interrupt")
def test_ctrl_c_at_a_terminal(quiet, tmp_path, kind, presses):
    """Pressed twice it is no worse; when all is said, the second one may end the interpreter."""
    path, out = make_campaign(tmp_path, 4, "execution_models:Waits"), tmp_path / "run"
    flag = tmp_path / "go on"
    again = words(path, out, kind)
    terminal = Terminal(command(*again), EN4DVAR_TEST_FLAG=flag)
    if kind == "serial":  # of several data sets at once what was told last is shown, perhaps that of another one
        assert terminal.read_until(r"set\d iteration 2: J [\d.]+, χ²/K [\d.e-]+, step 1")
    assert terminal.read_until(r"set\d (start|iteration)")
    assert terminal.read_until_logged(out / "run.log", "iteration  2")
    for _ in range(presses):
        terminal.press(CTRL_C)
        time.sleep(0.2)
    if kind == "threads":  # they end with their iteration
        flag.touch()
    code = terminal.close()
    assert code == int(row("interrupt").exit_code) or (presses, code) == (2, -signal.SIGINT), terminal.told
    assert "Traceback" not in terminal.told
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.told).splitlines()
    assert row("interrupt").told("\n".join(line.strip() for line in shown)), terminal.told
    if (kind, presses) == ("serial", 1):
        done = run_cli(*again, "--resume", EN4DVAR_TEST_FLAG=path)
        assert done.returncode == 0, done.stderr
    else:
        go_on(path, out)
    assert_same_results(out, quiet)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.fault("interrupt")
def test_compiled_code_that_answers_no_signal(tmp_path, number):
    """Python would hear of it when that call returns, in hours; it is ended where it stands, and loses nothing."""
    path, out, flag = make_campaign(tmp_path, 3, "execution_models:Deaf", large=2), tmp_path / "run", tmp_path / "flag"
    again = ["run", path, "--out", out, "--no-report", "--set", "execution.executor=serial"]
    code, told, seconds = stopped(number, flag, *again, EN4DVAR_TEST_FLAG=flag)
    assert seconds < 10  # of a busy machine; 1 s is left to the program
    assert code == int(row("interrupt").exit_code)
    assert "2 of 3 data sets are done" in told
    assert row("interrupt").told(told)
    assert "Traceback" not in told
    done = run_cli(*again, "--resume", EN4DVAR_TEST_FLAG=flag)
    assert done.returncode == 0, done.stderr
    assert len(result_files(out)) == 3


def heed():
    """A test run in the background of a shell has been told to ignore it, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def stopped(number, flag, *words, **variables):
    """Exit code, standard error, and seconds from a signal that is sent once a file is there to the end."""
    process = subprocess.Popen(
        command(*words), stderr=subprocess.PIPE, text=True, env=environment(**variables), preexec_fn=heed
    )
    while process.poll() is None and not (flag.exists() and flag.stat().st_size):
        time.sleep(0.01)
    begin = time.monotonic()
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    return process.returncode, told, time.monotonic() - begin


@pytest.mark.parametrize("kind", ["processes", "serial"])
@pytest.mark.fault("interrupt")
@pytest.mark.slow
def test_a_terminal_that_is_gone(quiet, tmp_path, kind):
    """SIGHUP comes when it is closed, and nothing can be told any more: the exit code and the run say it."""
    path, out = make_campaign(tmp_path, 4, "execution_models:Waits"), tmp_path / "run"
    again = words(path, out, kind)
    terminal = Terminal(command(*again), EN4DVAR_TEST_FLAG=tmp_path / "never")
    assert terminal.read_until_logged(out / "run.log", "iteration  2")
    os.close(terminal.end)
    assert terminal.process.wait(300) == int(row("interrupt").exit_code)
    assert "interrupted" in (out / "run.log").read_text()
    assert not (out / ".en4dvar-lock").exists()
    go_on(path, out)
    assert_same_results(out, quiet)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files that other systems refuse")
def test_a_terminal_and_a_log_obey_no_name(tmp_path):
    path, out = make_campaign(tmp_path, 3), tmp_path / "run"
    for i, name in enumerate(("a\x1b[2J\x07", "b\x9b2J\x1b]0;title\x07")):
        (tmp_path / "data" / f"set{i}.csv").rename(tmp_path / "data" / f"{name}.csv")
    (tmp_path / "data" / "c\x1b[2J.csv").write_text("no,table\n")
    terminal = Terminal(command("run", path, "--out", out, "--no-report"))
    terminal.read_until("(?!)")  # to its end
    assert terminal.close() == 1
    written = [(out / name).read_text(encoding="utf-8") for name in ("run.log", "summary.csv")]
    for text in (terminal.told, *written):
        assert not re.search(r"\x1b\[2J|[\x07\x9b]|\x1b\]", text)
        assert all(name in text for name in (r"a\x1b[2J\x07", r"b\x9b2J\x1b]0;title\x07", r"c\x1b[2J"))


def test_nohup_stays_in_force():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with terminate_as_interrupt():
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGTERM) != signal.SIG_DFL
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


class Ends:
    """Its end is where a signal arrives."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)


def _end_and_wait(number):
    Ends(number)
    for _ in range(500):
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.fault("interrupt")
def test_a_stop_where_nothing_can_be_raised_is_raised_behind_it(number):
    """Python tells of an exception at the end of an object, and of one in some compiled code, and goes on."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with heeded(print), terminate_as_interrupt(), pytest.raises(KeyboardInterrupt):
            _end_and_wait(number)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_stop_that_was_answered_ends_no_later_command(monkeypatch):
    """Of two commands in one process the second did, where the thread that waits for signals came late to see it."""
    ended, listen = [], interrupt._listen
    monkeypatch.setattr(interrupt, "PATIENCE", 0.05)
    monkeypatch.setattr(interrupt, "_listen", lambda *of: (time.sleep(0.1), listen(*of)))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with suppress(KeyboardInterrupt), heeded(ended.append):
            signal.raise_signal(signal.SIGINT)
        with heeded(ended.append):
            time.sleep(0.2)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not ended


def test_compiled_code_that_ignores_a_stop_prints_no_traceback(capfd):
    """Cython gives what it ignores to ``sys.excepthook`` first."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with heeded(print):
            sys.excepthook(KeyboardInterrupt, KeyboardInterrupt("stop"), None)
            sys.excepthook(ValueError, ValueError("of something else"), None)
    finally:
        signal.signal(signal.SIGINT, before)
    told = capfd.readouterr().err
    assert "of something else" in told
    assert "KeyboardInterrupt" not in told


@pytest.mark.fault("interrupt-early")
def test_a_stop_before_a_command_has_begun(monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Commands, "parse_args", stopped)
    with pytest.raises(SystemExit) as ended:
        main(["models"])
    assert ended.value.code == 130


@pytest.mark.parametrize("kind", ["processes", "dask"])
@pytest.mark.fault("kill-workers")
@pytest.mark.slow
def test_workers_end_with_the_main_process(tmp_path, kind):
    path, out = make_campaign(tmp_path, 4, "execution_models:Waits"), tmp_path / "run"
    process = subprocess.Popen(
        command(*words(path, out, kind)),
        stderr=subprocess.DEVNULL,
        env=environment(EN4DVAR_TEST_FLAG=tmp_path / "never"),
    )
    log = out / "run.log"
    while process.poll() is None and not (log.exists() and "iteration  2" in log.read_text()):
        time.sleep(0.01)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    assert len(workers) >= 2
    assert psutil.wait_procs(workers, timeout=300)[1] == []
