"""The pages of the path and of the how-to section are short; those of the path show what the reader will see."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from doc_pages import ROOT

MOST_WORDS = 1200
LARGEST = 120_000  # bytes of a picture


def section(title: str) -> list[Path]:
    """The pages below a heading of the navigation."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2])
    (pages,) = (entry[title] for entry in nav if title in entry)
    return [ROOT / "docs" / file for page in pages for file in page.values()]


def words(page: Path) -> int:
    return len(page.read_text(encoding="utf-8").split())


def test_the_path_has_six_pages() -> None:
    assert len(section("Start")) == 6


@pytest.mark.parametrize("page", section("Start"), ids=lambda p: p.stem)
def test_a_page_of_the_path_is_short_and_has_a_picture(page: Path) -> None:
    assert words(page) <= MOST_WORDS
    pictures = re.findall(r"!\[[^\]]+\]\((assets/\w+\.png)\)", page.read_text(encoding="utf-8"))
    assert pictures
    for picture in pictures:
        assert (page.parent / picture).stat().st_size < LARGEST


@pytest.mark.parametrize("page", section("How to"), ids=lambda p: p.stem)
def test_a_page_of_the_how_to_is_short(page: Path) -> None:
    assert words(page) <= MOST_WORDS, f"{page.name} has {words(page)} words"
