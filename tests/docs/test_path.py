"""The pages of the path and of the how-to section are short, and show what the reader will see."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from doc_pages import ROOT
from PIL import Image

MOST_WORDS = 1200
LARGEST = 120_000  # bytes of a picture
PICTURE = r"!\[[^\]]+\]\((assets/\w+\.png)\)"
FROM = re.compile("synthetic|simulate|measured", re.I)  # what a caption says of the data


def section(title: str) -> list[Path]:
    """The pages below a heading of the navigation."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2])
    (pages,) = (entry[title] for entry in nav if title in entry)
    return [ROOT / "docs" / file for page in pages for file in page.values()]


def words(page: Path) -> int:
    return len(page.read_text(encoding="utf-8").split())


def test_the_path_has_six_pages() -> None:
    assert len(section("Start")) == 6


SHORT = [*section("Start"), *section("How to")]


@pytest.mark.parametrize("page", SHORT, ids=lambda p: p.stem)
def test_a_page_is_short(page: Path) -> None:
    assert words(page) <= MOST_WORDS, f"{page.name} has {words(page)} words"


@pytest.mark.parametrize("page", SHORT, ids=lambda p: p.stem)
def test_a_page_has_a_picture_that_exists(page: Path) -> None:
    pictures = re.findall(PICTURE, page.read_text(encoding="utf-8"))
    assert pictures
    for picture in pictures:
        with Image.open(page.parent / picture) as opened:
            opened.verify()
        assert (page.parent / picture).stat().st_size < LARGEST


@pytest.mark.parametrize("page", section("How to"), ids=lambda p: p.stem)
def test_a_caption_says_where_the_data_of_a_picture_come_from(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    captions = re.findall(rf"(?:{PICTURE}\n)+\n\*(?P<caption>(?:.+\n)+?)(?=\n|$)", text)
    below = re.split(rf"(?:{PICTURE}\n)+", text)[2::2]
    assert len(captions) == len(below), "a picture has no caption in italics below it"
    for _, caption in captions:
        assert FROM.search(caption), caption


def test_pictures_that_a_script_made_are_shown() -> None:
    shown = {name for page in SHORT for name in re.findall(PICTURE, page.read_text(encoding="utf-8"))}
    made = {f"assets/{p.name}" for p in (ROOT / "docs" / "assets").glob("howto_*.png")}
    assert made <= shown
