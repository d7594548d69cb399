"""The page of faults and the tests that prove it say the same."""

from rows import FINDINGS, PAGE, ROWS, functions_in, proofs, rendered


def test_every_row_has_its_test_and_every_test_its_row():
    assert set(proofs()) == {r.name for r in ROWS}
    assert len({r.name for r in ROWS}) == len(ROWS)


def test_the_page_is_up_to_date():
    page = PAGE.read_text(encoding="utf-8")
    assert rendered(page) == page, "run: python tests/faults/rows.py"


def test_every_finding_has_its_tests():
    named = [test.split("::") for _, tests in FINDINGS for test in tests.split()]
    assert [f"{file}::{name}" for file, name in named if name not in functions_in(file)] == []
