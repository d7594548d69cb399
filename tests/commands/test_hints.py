"""What is suggested for a word that is unknown, and files in the order people count them."""

from __future__ import annotations

from pathlib import Path

import pytest

from en4dvar.assembly.reading import find_files
from en4dvar.plumbing.hints import beside, suggest

LAWS = {
    "fung-kelvin-voigt": "Fung exponential Kelvin–Voigt",
    "neo-hookean-kelvin-voigt": "neo-Hookean Kelvin–Voigt (NHKV)",
    "newtonian": "Newtonian liquid",
    "zener-neo-hookean": "standard linear solid (Zener), neo-Hookean spring",
}


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("neohookean", "'neo-hookean-kelvin-voigt'"),
        ("Neo Hookean", "'neo-hookean-kelvin-voigt'"),
        ("NHKV", "'neo-hookean-kelvin-voigt'"),
        ("fung", "'fung-kelvin-voigt'"),
        ("kelvinvoigt", "'fung-kelvin-voigt' or 'neo-hookean-kelvin-voigt'"),
        ("standard linear solid", "'zener-neo-hookean'"),
        ("newtonain", "'newtonian'"),
    ],
)
def test_a_name_is_found_by_its_parts_and_by_what_it_means(word: str, meant: str) -> None:
    assert suggest(word, LAWS) == f"; did you mean {meant}?"


def test_what_nothing_resembles_is_answered_with_all_names() -> None:
    assert suggest("e", ["mu", "alpha"]) == "; known: mu, alpha"


def test_hidden_files_are_not_offered(tmp_path: Path) -> None:
    for name in (".listing", "notes"):
        (tmp_path / name).write_text("")
    assert beside(tmp_path / "zzz") == "no such file; the folder holds notes"


def test_files_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("b10", "b2", "b1", "b", "a", "b01"):
        (tmp_path / f"{name}.csv").write_text("t,x\n")
    for path in (".", "*.csv"):
        assert list(find_files(tmp_path, [path])) == ["a", "b", "b01", "b1", "b2", "b10"]
