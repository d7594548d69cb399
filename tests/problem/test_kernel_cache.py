"""The cache of compiled code where processes start at once, or are killed."""

import fcntl
import subprocess
import sys

import pytest
from run_files import environment

from en4dvar.plumbing import compiled


@pytest.fixture
def processes(tmp_path):
    """What several processes have in hand that share a cache; each with its stamp."""
    return lambda stamp="today": compiled.SignatureFiles(str(tmp_path), "kernel", stamp)


def test_what_two_processes_save_at_once_is_not_mixed_up(processes, monkeypatch):
    one, two = processes(), processes()
    write = one._save_index

    def in_between(overloads):
        write(overloads)
        monkeypatch.setattr(two, "_load_index", dict)  # read before the other wrote
        two.save("signature 2", "code 2")

    monkeypatch.setattr(one, "_save_index", in_between)
    one.save("signature 1", "code 1")
    later = processes()
    assert later.load("signature 2") == "code 2"
    assert later.load("signature 1") in (None, "code 1")


def test_a_kill_leaves_no_index_to_code_of_other_sources(processes, monkeypatch):
    processes("yesterday").save("signature", "old code")
    killed = processes()
    monkeypatch.setattr(killed, "_save_data", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        killed.save("signature", "new code")
    assert processes().load("signature") is None
    processes().save("signature", "new code")
    assert processes().load("signature") == "new code"


FIRST_USE = """
import time
from en4dvar.plumbing.compiled import compilations, kernel

@kernel
def twice(x):
    return 2 * x

compile_ = twice._compiler.compile
twice._compiler.compile = lambda *types: time.sleep(0.5) or compile_(*types)
print("ready", flush=True)
input()
assert twice(1.5) == 3.0
print(compilations())
"""


@pytest.mark.slow
def test_of_processes_that_start_at_once_one_compiles(tmp_path):
    (tmp_path / "first_use.py").write_text(FIRST_USE)
    started = [
        subprocess.Popen(
            [sys.executable, tmp_path / "first_use.py"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=environment(NUMBA_CACHE_DIR=tmp_path / "cache"),
        )
        for _ in range(3)
    ]  # fmt: skip
    for process in started:
        assert process.stdout.readline() == "ready\n"
    for process in started:
        process.stdin.write("\n")
        process.stdin.flush()
    assert sorted(process.communicate()[0] for process in started) == ["0\n", "0\n", "1\n"]


def test_a_process_that_never_ends_its_compilation_is_not_waited_for_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "PATIENCE", 0.1)
    with (tmp_path / "kernel.lock").open("w") as stopped:
        fcntl.flock(stopped, fcntl.LOCK_EX)
        with compiled._held(tmp_path / "kernel.lock"):
            pass
