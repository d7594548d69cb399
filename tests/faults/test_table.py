"""The page of faults and the tests that prove it say the same."""

from rows import PAGE, ROWS, proofs, rendered


def test_every_row_has_its_test_and_every_test_its_row():
    assert set(proofs()) == {r.name for r in ROWS}
    assert len({r.name for r in ROWS}) == len(ROWS)


def test_the_page_is_up_to_date():
    page = PAGE.read_text(encoding="utf-8")
    assert rendered(page) == page, "run: python tests/faults/rows.py"
