"""Every slow test is run within eight days, every long one within twenty: the parts are about alike."""

import itertools

import pytest
from parts_by_day import is_of_day

NAMES = [f"tests/a/test_b.py::test_c[{i}]" for i in range(500)]


@pytest.mark.parametrize("of", [8, 20])
@pytest.mark.parametrize("today", [0, 20785])
def test_each_test_is_of_one_day(of, today):
    days = [[name for name in NAMES if is_of_day(name, today + k, of)] for k in range(of)]
    assert sorted(itertools.chain.from_iterable(days)) == sorted(NAMES)
    assert max(map(len, days)) < 1.5 * len(NAMES) / of


def test_a_part_is_run_by_date_or_all(request):
    ci = (request.config.rootpath / ".ci" / "run").read_text()
    assert "\nday=$(($(date +%s) / 86400))\n" in ci
    assert '[ "$asked" = all ] || slow+=(--day "$day")\npytest -n auto "${slow[@]}"' in ci
