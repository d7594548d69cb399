"""The cache of compiled code where processes start at once, or are killed."""

import pytest

from en4dvar_bubble.solver import driver, integrate

assert driver  # which puts its own cache in place of numba's


@pytest.fixture
def processes(tmp_path):
    """What several processes have in hand that share a cache; each with its stamp."""
    kind = type(integrate.integrate._cache._cache_file)
    return lambda stamp="today": kind(str(tmp_path), "kernel", stamp)


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
