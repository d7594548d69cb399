"""Every long test is run within ten days: each is of one tenth, and the tenths are about alike."""

import itertools
import re

from tenths import is_of_tenth


def test_each_test_is_of_one_tenth():
    names = [f"tests/a/test_b.py::test_c[{i}]" for i in range(500)]
    tenths = [[name for name in names if is_of_tenth(name, k)] for k in range(10)]
    assert sorted(itertools.chain.from_iterable(tenths)) == sorted(names)
    assert max(map(len, tenths)) < 100


def test_a_tenth_is_run_by_date(request):
    ci = (request.config.rootpath / ".ci" / "run").read_text()
    assert re.search(r"-m long --tenth \$\(\(\$\(date \+%s\) / 86400 % 10\)\)", ci)
