"""Every slow test is run within sixteen turns, every long one within thirty: the parts are about alike."""

import itertools

import pytest
from parts_in_turn import is_of_part

NAMES = [f"tests/a/test_b.py::test_c[{i}]" for i in range(1500)]


@pytest.mark.parametrize("of", [16, 30])
@pytest.mark.parametrize("now", [0, 20785])
def test_each_test_is_of_one_part(of, now):
    parts = [[name for name in NAMES if is_of_part(name, now + k, of)] for k in range(of)]
    assert sorted(itertools.chain.from_iterable(parts)) == sorted(NAMES)
    assert max(map(len, parts)) < 1.5 * len(NAMES) / of


def test_a_part_is_run_in_turn_or_all(request):
    ci = (request.config.rootpath / ".ci" / "run").read_text()
    assert "\nturn=$(($(date +%s) / 10800))\n" in ci
    assert '[ "$asked" = all ] || slow+=(--turn "$turn")\npytest -n auto "${slow[@]}"' in ci
