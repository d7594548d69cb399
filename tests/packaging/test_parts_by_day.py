"""Every slow test is run within four days, every long one within ten: each is of one of parts that are about alike."""

import itertools
import re
import subprocess
import time

import pytest
from parts_by_day import is_of_part

NAMES = [f"tests/a/test_b.py::test_c[{i}]" for i in range(500)]


@pytest.mark.parametrize("of", [4, 10])
def test_each_test_is_of_one_part(of):
    parts = [[name for name in NAMES if is_of_part(name, k, of)] for k in range(of)]
    assert sorted(itertools.chain.from_iterable(parts)) == sorted(NAMES)
    assert max(map(len, parts)) < 1.5 * len(NAMES) / of


@pytest.mark.parametrize(("marked", "of"), [('"slow and not long"', 4), ("long", 10)])
def test_a_part_is_run_by_date_or_all(request, marked, of):
    ci = (request.config.rootpath / ".ci" / "run").read_text()
    assert f'-m {marked} --part "$(part {of})"' in ci
    (told,) = re.findall(r"^day=.*\npart\(\) .*$", ci, re.MULTILINE)
    for asked, wanted in (("all", "0/1"), ("", f"{int(time.time()) // 86400 % of}/{of}")):
        done = subprocess.run(["bash", "-c", f"asked={asked}\n{told}\npart {of}"], capture_output=True, text=True)
        assert done.stdout.strip() == wanted
